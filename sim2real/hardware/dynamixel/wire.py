"""A half-duplex bus with emulated servos, computed in planned time.

The times of all events are computed from the times at which the host's bytes arrive, and do not depend on how late the
emulator's process runs: an instruction of n bytes that arrives at t is complete at max(t, wire free) + n * 10 / baud;
the values that it reads are those of one sensing latency earlier, and its commands take effect one actuation latency
later.
"""

from __future__ import annotations

import heapq
import random
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Final

from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.protocol import BROADCAST_ID, Instruction, Packet, Parser, StatusError, build_status
from sim2real.hardware.dynamixel.servo import Servo
from sim2real.hardware.emulation import EmulatorConfig
from sim2real.hardware.plant import OperatingMode, Plant, PlantClock
from sim2real.hardware.truth import Kind, TruthLog

__all__ = ["EmulatedBus", "EmulatorConfig", "truth_header"]

_STALE_PACKET_NS: Final = 5_000_000  # after a longer pause, an incomplete packet is dropped


@dataclass
class _Request:
    """An instruction that was received.

    Attributes:
        packet: The instruction.
        t_ns: When it was complete on the wire.
        t_host_ns: When its last bytes had reached the emulator.
        actuation_ns: Delay until its commands take effect, the same for all servos; None until it is drawn.
    """

    packet: Packet
    t_ns: int
    t_host_ns: int
    actuation_ns: int | None = None


class EmulatedBus:
    """Emulated servos on a bus, driving a plant; without port and threads. Times are CLOCK_MONOTONIC nanoseconds.

    Args:
        plant: The mechanism.
        config: Behaviour of bus and servos.
        truth: Log of true states and latencies.
        send: Called with an answer's bytes when the host is to get them; returns False if it cannot take them.
        start_ns: Time 0 of the plant.
        now_ns: Clock by which lateness is measured.
    """

    def __init__(
        self,
        plant: Plant,
        config: EmulatorConfig,
        truth: TruthLog,
        send: Callable[[bytes], bool],
        start_ns: int,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._config = config
        self._truth = truth
        self._send = send
        self._start_ns = start_ns
        self._now_ns = now_ns
        self._random = random.Random(config.seed)
        self._byte_ns = 1e10 / config.baud_rate
        history_s = config.sensing_latency_s + config.sensing_jitter_s
        self._clock = PlantClock(plant, round(config.plant_step_s * 1e9), start_ns, round(history_s * 1e9), truth)
        self.servos = {
            i: Servo(i, config.model_number, config.return_delay_us, config.encoder_counts, config.watchdog_stops)
            for i in sorted(plant.servo_ids)
        }
        self._controllers: dict[int, tuple[int, int, float]] = {}
        for servo in self.servos.values():
            self._configure(servo)
        self._last_effect_ns = dict.fromkeys(self.servos, 0)
        self._parser = Parser()
        self._wire_free_ns = start_ns
        self._last_bytes_ns = start_ns
        self._delivered_ns = start_ns
        self._frozen: dict[int, tuple[float, float, float]] = {}
        self._events: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._sequence = 0
        if config.overload_after_s is not None:
            overload_ns = start_ns + round(config.overload_after_s * 1e9)
            self._at(overload_ns, self._overload, overload_ns)
        self._handlers: dict[int, Callable[[_Request], None]] = {
            Instruction.PING: self._ping,
            Instruction.READ: self._read,
            Instruction.WRITE: self._write,
            Instruction.REG_WRITE: self._reg_write,
            Instruction.ACTION: self._action,
            Instruction.REBOOT: self._reboot,
            Instruction.SYNC_READ: self._sync_read,
            Instruction.SYNC_WRITE: self._sync_write,
            Instruction.BULK_READ: self._bulk_read,
        }

    def feed(self, chunk: bytes, now_ns: int) -> None:
        """Process bytes that the host has sent; `run_until(now_ns)` must be called next."""
        if self._silent(now_ns):
            return
        if now_ns - self._last_bytes_ns > _STALE_PACKET_NS:
            self._parser.clear()
        self._last_bytes_ns = now_ns
        begin_ns = max(now_ns, self._wire_free_ns)
        self._wire_free_ns = begin_ns + round(len(chunk) * self._byte_ns)
        for packet, end in self._parser.feed(chunk):
            t_ns = begin_ns + round(end * self._byte_ns)
            self._at(t_ns, self._execute, _Request(packet, t_ns, now_ns))
        # These bytes may have waited because this process was late, which must not trip a servo's watchdog.
        for servo in self.servos.values():
            deadline_ns = servo.watchdog_deadline_ns()
            if deadline_ns is not None and deadline_ns < self._wire_free_ns:
                servo.heard_ns += self._wire_free_ns - deadline_ns + 1

    def next_due_ns(self) -> int | None:
        """Return the time of the next event; None if there is none."""
        due = [deadline for s in self.servos.values() if (deadline := s.watchdog_deadline_ns()) is not None]
        if self._events:
            due.append(self._events[0][0])
        return min(due, default=None)

    def run_until(self, t_ns: int) -> None:
        """Process all events up to `t_ns` in order, and advance the plant to that time."""
        while (due_ns := self.next_due_ns()) is not None and due_ns <= t_ns:
            self._clock.advance(due_ns)
            for servo in self.servos.values():
                deadline_ns = servo.watchdog_deadline_ns()
                if deadline_ns is not None and deadline_ns <= due_ns:
                    self._trip_watchdog(servo, deadline_ns)
            while self._events and self._events[0][0] <= due_ns:
                _, _, action, arguments = heapq.heappop(self._events)
                action(*arguments)
        self._clock.advance(t_ns)

    def _at(self, t_ns: int, action: Callable[..., None], *arguments: Any) -> None:
        self._sequence += 1
        heapq.heappush(self._events, (t_ns, self._sequence, action, arguments))

    def _silent(self, t_ns: int) -> bool:
        after_s = self._config.silent_after_s
        return after_s is not None and t_ns - self._start_ns >= after_s * 1e9

    def _delay_ns(self, latency_s: float, jitter_s: float) -> int:
        return round(1e9 * (latency_s + self._random.uniform(-jitter_s, jitter_s)))

    def _happens(self, probability: float) -> bool:
        """Return whether a fault happens; draws no random number if its probability is 0."""
        return probability > 0.0 and self._random.random() < probability

    def _execute(self, request: _Request) -> None:
        packet = request.packet
        broadcast = packet.servo_id == BROADCAST_ID
        targets = self._targets(request)
        if not targets or packet.instruction == Instruction.STATUS:
            return
        error = StatusError.NONE if packet.crc_ok else StatusError.CRC
        handler = self._handlers.get(packet.instruction)
        if not error:
            for servo in targets:
                servo.heard_ns = request.t_ns
            if handler is not None:
                handler(request)
                return
            error = StatusError.INSTRUCTION
        if not broadcast:
            self._reply(targets[0], request, error)

    def _targets(self, request: _Request) -> list[Servo]:
        """Return the servos that a request addresses, ordered by id."""
        if request.packet.servo_id == BROADCAST_ID:
            return list(self.servos.values())
        servo = self.servos.get(request.packet.servo_id)
        return [servo] if servo is not None else []

    def _ping(self, request: _Request) -> None:
        for servo in self._targets(request):
            identity = reg.MODEL_NUMBER.encode(servo.get(reg.MODEL_NUMBER)) + bytes((servo.get(reg.FIRMWARE_VERSION),))
            self._reply(servo, request, StatusError.NONE, identity)

    def _read(self, request: _Request) -> None:
        parameters = request.packet.parameters
        if request.packet.servo_id == BROADCAST_ID:
            return
        servo = self.servos[request.packet.servo_id]
        if len(parameters) != 4:
            self._acknowledge(servo, request, StatusError.DATA_LENGTH)
            return
        self._answer_read(servo, request, _word(parameters, 0), _word(parameters, 2))

    def _sync_read(self, request: _Request) -> None:
        parameters = request.packet.parameters
        if len(parameters) < 5:
            return
        for servo_id in parameters[4:]:
            if servo_id in self.servos:
                self._answer_read(self.servos[servo_id], request, _word(parameters, 0), _word(parameters, 2))

    def _bulk_read(self, request: _Request) -> None:
        parameters = request.packet.parameters
        for i in range(0, len(parameters) - 4, 5):
            if parameters[i] in self.servos:
                servo = self.servos[parameters[i]]
                self._answer_read(servo, request, _word(parameters, i + 1), _word(parameters, i + 3))

    def _write(self, request: _Request) -> None:
        address, data = _word(request.packet.parameters, 0), request.packet.parameters[2:]
        for servo in self._targets(request):
            self._acknowledge(servo, request, self._write_servo(servo, request, address, data))

    def _sync_write(self, request: _Request) -> None:
        parameters = request.packet.parameters
        address, length = _word(parameters, 0), _word(parameters, 2)
        for i in range(4, len(parameters) - length, length + 1):
            servo = self.servos.get(parameters[i])
            if servo is not None:
                self._write_servo(servo, request, address, parameters[i + 1 : i + 1 + length])

    def _reg_write(self, request: _Request) -> None:
        address, data = _word(request.packet.parameters, 0), request.packet.parameters[2:]
        for servo in self._targets(request):
            self._acknowledge(servo, request, servo.register_write(address, data))

    def _action(self, request: _Request) -> None:
        for servo in self._targets(request):
            self._measure(servo, request.t_ns)
            error, moves = servo.action()
            self._configure(servo)
            if moves:
                self._actuate(servo, request)
            self._acknowledge(servo, request, error)

    def _reboot(self, request: _Request) -> None:
        for servo in self._targets(request):
            self._acknowledge(servo, request, StatusError.NONE)
            servo.reboot()
            self._configure(servo)
            self._actuate(servo, request)

    def _write_servo(self, servo: Servo, request: _Request, address: int, data: bytes) -> StatusError:
        self._measure(servo, request.t_ns)
        error, moves = servo.write(address, data)
        self._configure(servo)
        if moves:
            self._actuate(servo, request)
        return error

    def _configure(self, servo: Servo) -> None:
        """Tell the plant a servo's controller settings if they have changed."""
        controller = servo.controller()
        if self._controllers.get(servo.servo_id) != controller:
            self._controllers[servo.servo_id] = controller
            self._clock.configure(servo.servo_id, *controller)

    def _actuate(self, servo: Servo, request: _Request) -> None:
        config = self._config
        if request.actuation_ns is None:
            request.actuation_ns = self._delay_ns(config.actuation_latency_s, config.actuation_jitter_s)
        planned_ns = request.t_ns + request.actuation_ns
        # Commands take effect in the order in which they were sent.
        planned_ns = max(planned_ns, self._last_effect_ns[servo.servo_id])
        self._last_effect_ns[servo.servo_id] = planned_ns
        self._clock.schedule(planned_ns, request.t_host_ns, servo.servo_id, *servo.command())

    def _measure(self, servo: Servo, t_ns: int) -> tuple[int, tuple[float, float, float]]:
        config = self._config
        sampled_ns = t_ns - self._delay_ns(config.sensing_latency_s, config.sensing_jitter_s)
        values = self._clock.sample(servo.servo_id, sampled_ns)
        shown = values
        if config.frozen_after_s is not None and t_ns - self._start_ns >= config.frozen_after_s * 1e9:
            shown = self._frozen.setdefault(servo.servo_id, (values[0], 0.0, values[2]))
        servo.refresh(*shown, tick_ms=(t_ns - self._start_ns) // 1_000_000)
        return sampled_ns, values

    def _answer_read(self, servo: Servo, request: _Request, address: int, length: int) -> None:
        sample = self._measure(servo, request.t_ns)
        if self._happens(self._config.wild):
            servo.put(reg.PRESENT_POSITION, self._random.randrange(1 << 24, 1 << 31))
        error, data = servo.read(address, length)
        if servo.get(reg.STATUS_RETURN_LEVEL) >= 1:
            measured = address < reg.PRESENT_POSITION.end and address + length > reg.PRESENT_PWM.address
            self._reply(servo, request, error, data, sample if measured else None)

    def _acknowledge(self, servo: Servo, request: _Request, error: StatusError) -> None:
        if request.packet.servo_id != BROADCAST_ID and servo.get(reg.STATUS_RETURN_LEVEL) >= 2:
            self._reply(servo, request, error)

    def _reply(
        self,
        servo: Servo,
        request: _Request,
        error: StatusError,
        data: bytes = b"",
        sample: tuple[int, tuple[float, float, float]] | None = None,
    ) -> None:
        """Schedule a status packet: sent after the return delay when the wire is free, delivered at its last byte."""
        answer = build_status(servo.servo_id, error | servo.alert, data)
        return_delay_ns = round(servo.get(reg.RETURN_DELAY_TIME) * reg.RETURN_DELAY_UNIT_S * 1e9)
        begin_ns = max(request.t_ns, self._wire_free_ns) + return_delay_ns
        self._wire_free_ns = begin_ns + round(len(answer) * self._byte_ns)
        late_ns = round(self._config.late_s * 1e9) if self._happens(self._config.late) else 0
        self._delivered_ns = max(self._delivered_ns, self._wire_free_ns + late_ns)
        self._at(self._delivered_ns, self._deliver, self._delivered_ns, servo.servo_id, answer, request, sample)

    def _deliver(
        self,
        planned_ns: int,
        servo_id: int,
        answer: bytes,
        request: _Request,
        sample: tuple[int, tuple[float, float, float]] | None,
    ) -> None:
        kind = Kind.REPLY if sample is None else Kind.SAMPLE
        t_ns, values = sample or (request.t_ns, ())
        if self._random.random() < self._config.corrupt:
            position = self._random.randrange(len(answer))
            answer = answer[:position] + bytes((answer[position] ^ 0x10,)) + answer[position + 1 :]
        lost = self._silent(planned_ns) or self._random.random() < self._config.reply_loss
        if lost or not self._send(answer):
            kind = Kind.LOSS
        now_ns = self._now_ns()
        self._truth.write(kind, servo_id, request.t_host_ns, t_ns, now_ns, now_ns - planned_ns, values)

    def _trip_watchdog(self, servo: Servo, t_ns: int) -> None:
        self._measure(servo, t_ns)
        servo.trip_watchdog()
        self._truth.write(Kind.WATCHDOG, servo.servo_id, 0, t_ns, t_ns, 0)
        if servo.watchdog_stops:
            self._stop_motor(servo, t_ns, OperatingMode.PWM)

    def _overload(self, t_ns: int) -> None:
        for servo in self.servos.values():
            servo.overload()
            self._stop_motor(servo, t_ns, OperatingMode.OFF)

    def _stop_motor(self, servo: Servo, t_ns: int, mode: OperatingMode) -> None:
        """Stop the motor by the servo's own firmware: at once, dropping commands that have not taken effect yet."""
        self._clock.cancel(servo.servo_id)
        self._clock.schedule(t_ns, 0, servo.servo_id, mode, 0.0)


def truth_header(plant: Plant, config: EmulatorConfig, start_ns: int) -> dict[str, Any]:
    """Return the header of a truth file.

    Args:
        plant: The mechanism.
        config: Behaviour of bus and servos.
        start_ns: Time 0 of the plant [ns].
    """
    return {
        "start_ns": start_ns,
        "config": asdict(config),
        "servo_ids": list(plant.servo_ids),
        "state_names": list(plant.state()),
        "truth": plant.truth(),
    }


def _word(data: bytes, position: int) -> int:
    return int.from_bytes(data[position : position + 2], "little")
