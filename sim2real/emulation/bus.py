"""Emulated motors on a half-duplex line: settings, faults and timing; all times are computed, nothing waits.

An instruction of n bytes that arrives at t is complete at max(t, wire free) + n * 10 / baud. It reads values of one
sensing latency earlier, and its commands take effect one actuation latency later.
"""

from __future__ import annotations

import heapq
import random
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from sim2real.emulation.plant import Plant, PlantClock
from sim2real.emulation.robot import NUMBERS, Emulation, PlannedRobot, VirtualChannel, VirtualTime
from sim2real.emulation.truth import Kind, TruthLog
from sim2real.errors import HardwareLost
from sim2real.hardware.bus.port import CUT, EMULATED, Port, Queries, take_torque_off
from sim2real.hardware.clock import Clock
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.safety.guardian import Guardian, Motors


@dataclass(frozen=True)
class BusEmulation(Emulation):
    """Settings of an emulated bus and its motors; see `Emulation` for the others.

    Args:
        baud_rate: Bits per second; a byte takes 10 bits.
        sensing_jitter_s: Half-width of the uniform variation of the sensing latency [s]; at most the latency.
        return_delay_us: The servos' Return Delay Time at power-up [us].
        plant_step_s: Time step of the plant, at which commands take effect [s]; at most 1 ms.
        wild: Probability that a read returns an impossible position, with a correct checksum.
        frozen_after_s: Time from which reads return the position of that time, and no velocity [s]; None: never.
        unplugged_after_s: Time at which the port goes away, as with a pulled USB plug [s]; None: never.
    """

    baud_rate: int = 1_000_000
    sensing_jitter_s: float = 0.0
    return_delay_us: int = 500
    plant_step_s: float = 0.0005
    wild: float = 0.0
    frozen_after_s: float | None = None
    unplugged_after_s: float | None = None

    def robot(self, physics: Plant, truth_path: Path | None) -> VirtualRobot:
        return VirtualRobot(physics, self, truth_path)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(
            {
                "baud_rate": (1, 10_000_000),
                "sensing_jitter_s": (0.0, self.sensing_latency_s),
                "return_delay_us": (0, 508),
                "wild": (0.0, 1.0),
                "plant_step_s": (1e-5, 1e-3),
            }
        )


_STALE_PACKET_NS: Final = 5_000_000  # an incomplete packet is dropped after a longer pause [ns]

Sample = tuple[int, tuple[float, float, float]]
"""Time of the sample [ns], and position [rad], velocity [rad/s] and load."""


@dataclass
class Request:
    """A received instruction.

    Attributes:
        t_ns: Time at which it was complete on the wire [ns].
        t_host_ns: Time at which its last bytes had reached the emulator [ns].
        actuation_ns: Delay until its commands take effect, the same for all motors [ns]; None until it is drawn.
    """

    packet: Any
    t_ns: int
    t_host_ns: int
    actuation_ns: int | None = None


class Firmware(Protocol):
    """Registers and firmware of one motor, as far as `PlannedBus` needs them; `ServoFirmware` explains the methods."""

    servo_id: int
    heard_ns: int
    watchdog_stops: bool

    def command(self) -> tuple[int, float]: ...
    def controller(self) -> tuple[int, int, float]: ...
    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int) -> None: ...
    def watchdog_deadline_ns(self) -> int | None: ...
    def trip_watchdog(self) -> None: ...


B = TypeVar("B", bound=BusEmulation)


class PlannedBus(PlannedRobot[B]):
    """Emulated motors on a half-duplex line, driving a plant.

    A subclass carries out instructions in `execute`, with the help of `measure`, `actuate`, `configure` and `reply`.

    Args:
        send: Delivers the bytes of an answer to the host; returns False if the host cannot take them.
        parser: A `Parser` of the family's packets.
        servos: Id -> firmware, ordered by id.
    """

    def __init__(
        self,
        plant: Plant,
        config: B,
        truth: TruthLog,
        send: Callable[[bytes], bool],
        parser: Any,
        servos: Mapping[int, Firmware],
    ) -> None:
        super().__init__(config, truth)
        self._send = send
        self.random = random.Random(config.seed)
        self._byte_ns = 1e10 / config.baud_rate
        # The plant, with a history as long as the sensing latency.
        history_s = config.sensing_latency_s + config.sensing_jitter_s
        self._clock = PlantClock(plant, round(config.plant_step_s * 1e9), round(history_s * 1e9), truth)
        self._firmware = servos
        self._controllers: dict[int, tuple[int, int, float]] = {}
        for servo in servos.values():
            self.configure(servo)
        self._last_effect_ns = dict.fromkeys(servos, 0)
        # The state of the wire: its bytes, faults and events.
        self._parser = parser
        self._wire_free_ns = self._last_bytes_ns = self._delivered_ns = 0
        self._frozen: dict[int, tuple[float, float, float]] = {}
        self._events: list[tuple[int, int, Callable[..., None], tuple[Any, ...]]] = []
        self._sequence = 0
        self.begin_faults(0)

    @abstractmethod
    def execute(self, request: Request) -> None:
        """Carry out an instruction that is complete on the wire, and reply to it."""

    def feed(self, chunk: bytes, now_ns: int) -> None:
        """Process bytes that the host has sent; `run_until(now_ns)` must be called next."""
        if self.is_silent(now_ns):
            return
        # After a pause, the rest of an incomplete packet will not come.
        if now_ns - self._last_bytes_ns > _STALE_PACKET_NS:
            self._parser.clear()
        self._last_bytes_ns = now_ns
        # Execute each instruction when its last byte has passed the wire.
        begin_ns = max(now_ns, self._wire_free_ns)
        self._wire_free_ns = begin_ns + round(len(chunk) * self._byte_ns)
        for packet, end in self._parser.feed(chunk):
            t_ns = begin_ns + round(end * self._byte_ns)
            self._at(t_ns, self.execute, Request(packet, t_ns, now_ns))

    def next_due_ns(self) -> int | None:
        due = [deadline for s in self._firmware.values() if (deadline := s.watchdog_deadline_ns()) is not None]
        if self._events:
            due.append(self._events[0][0])
        return min(due, default=None)

    def run_until(self, t_ns: int) -> None:
        while (due_ns := self.next_due_ns()) is not None and due_ns <= t_ns:
            self._clock.advance(due_ns)
            # Watchdogs first: an instruction at the same time is too late.
            for servo in self._firmware.values():
                deadline_ns = servo.watchdog_deadline_ns()
                if deadline_ns is not None and deadline_ns <= due_ns:
                    self._trip_watchdog(servo, deadline_ns)
            while self._events and self._events[0][0] <= due_ns:
                _, _, action, arguments = heapq.heappop(self._events)
                action(*arguments)
        self._clock.advance(t_ns)

    def begin_faults(self, t_ns: int) -> None:
        super().begin_faults(t_ns)
        if self.config.lets_go_after_s is not None:
            ns = t_ns + round(1e9 * self.config.lets_go_after_s)
            self._at(ns, self._stop_motor, self._firmware[self.config.lets_go], ns, OperatingMode.OFF)

    def unplugged(self, t_ns: int) -> bool:
        """Return whether the port is gone at a time [ns]."""
        return self.has(self.config.unplugged_after_s, t_ns)

    def happens(self, probability: float) -> bool:
        """Return whether a fault happens; draws no random number if its probability is 0."""
        return probability > 0.0 and self.random.random() < probability

    def configure(self, servo: Firmware) -> None:
        """Pass a motor's controller settings to the plant if they have changed."""
        controller = servo.controller()
        if self._controllers.get(servo.servo_id) != controller:
            self._controllers[servo.servo_id] = controller
            self._clock.configure(servo.servo_id, *controller)

    def actuate(self, servo: Firmware, request: Request) -> None:
        """Schedule the command of the motor's registers one actuation latency after the request."""
        config = self.config
        if request.actuation_ns is None:
            request.actuation_ns = self._delay_ns(config.actuation_latency_s, config.actuation_jitter_s)
        # Commands take effect in the order in which they were sent.
        planned_ns = max(request.t_ns + request.actuation_ns, self._last_effect_ns[servo.servo_id])
        self._last_effect_ns[servo.servo_id] = planned_ns
        mode, goal = servo.command()
        if servo.servo_id == config.lets_go and self.has(config.lets_go_after_s, request.t_ns):
            mode, goal = OperatingMode.OFF, 0.0
        self._clock.schedule(planned_ns, request.t_host_ns, servo.servo_id, mode, goal)

    def measure(self, servo: Firmware, t_ns: int) -> Sample:
        """Set a motor's present values to those of one sensing latency before `t_ns`, and return the true ones."""
        config = self.config
        sampled_ns = t_ns - self._delay_ns(config.sensing_latency_s, config.sensing_jitter_s)
        values = self._clock.sample(servo.servo_id, sampled_ns)
        reported = values
        if self.has(config.frozen_after_s, t_ns):
            reported = self._frozen.setdefault(servo.servo_id, (values[0], 0.0, values[2]))
        servo.refresh(*reported, tick_ms=t_ns // 1_000_000)
        return sampled_ns, values

    def reply(
        self, servo_id: int, request: Request, answer: bytes, return_delay_s: float, sample: Sample | None = None
    ) -> None:
        """Schedule an answer: sent after the return delay [s] when the wire is free, delivered at its last byte."""
        begin_ns = max(request.t_ns, self._wire_free_ns) + round(return_delay_s * 1e9)
        self._wire_free_ns = begin_ns + round(len(answer) * self._byte_ns)
        # A late answer delays the later ones, as in a USB adapter.
        late_ns = round(self.config.late_s * 1e9) if self.happens(self.config.late) else 0
        self._delivered_ns = max(self._delivered_ns, self._wire_free_ns + late_ns)
        self._at(self._delivered_ns, self._deliver, self._delivered_ns, servo_id, answer, request, sample)

    def _at(self, t_ns: int, action: Callable[..., None], *arguments: Any) -> None:
        self._sequence += 1
        heapq.heappush(self._events, (t_ns, self._sequence, action, arguments))

    def _delay_ns(self, latency_s: float, jitter_s: float) -> int:
        return round(1e9 * (latency_s + self.random.uniform(-jitter_s, jitter_s)))

    def _deliver(self, planned_ns: int, servo_id: int, answer: bytes, request: Request, sample: Sample | None) -> None:
        kind = Kind.REPLY if sample is None else Kind.SAMPLE
        t_ns, values = sample or (request.t_ns, ())
        # Faults of the wire: a corrupted byte, or no answer at all.
        if self.random.random() < self.config.corrupt:
            position = self.random.randrange(len(answer))
            answer = answer[:position] + bytes((answer[position] ^ 0x10,)) + answer[position + 1 :]
        lost = self.is_silent(planned_ns) or self.random.random() < self.config.reply_loss
        if lost or not self._send(answer):
            kind = Kind.LOSS
        self.truth.write(kind, servo_id, request.t_host_ns, t_ns, planned_ns, 0, values)

    def _trip_watchdog(self, servo: Firmware, t_ns: int) -> None:
        self.measure(servo, t_ns)
        servo.trip_watchdog()
        self.truth.write(Kind.WATCHDOG, servo.servo_id, 0, t_ns, t_ns, 0)
        if servo.watchdog_stops:
            self._stop_motor(servo, t_ns, servo.command()[0])

    def _stop_motor(self, servo: Firmware, t_ns: int, mode: int) -> None:
        """Let the firmware stop the motor at once, and drop commands that have not taken effect yet."""
        self._clock.cancel(servo.servo_id)
        self._clock.schedule(t_ns, 0, servo.servo_id, mode, 0.0)


class VirtualRobot(VirtualTime):
    """Emulated servos at `port`, from construction until `stop`.

    Attributes:
        port: The address, which `open_port` knows.
        bus: The emulated bus.
    """

    advice = ""

    def __init__(self, plant: Plant, config: BusEmulation, truth_path: Path | None = None) -> None:
        self.plant: Any = plant
        self._inbox: list[bytes] = []
        super().__init__(plant, config, truth_path, self._take)
        self._baud_rate: int | None = None  # None: no host has opened the port
        self.bus: Any = self.planned
        self.port = f"virtual:{next(NUMBERS)}"
        EMULATED[self.port] = self._open

    def stop(self) -> None:
        EMULATED.pop(self.port, None)
        super().stop()

    # The port

    def _open(self, baud_rate: int) -> Port:
        if self._baud_rate is not None or self.bus.unplugged(self._now_ns):
            raise HardwareLost(f"the port {self.port} cannot be opened: it is in use, or gone")
        self._baud_rate = baud_rate
        return self

    def write(self, data: bytes) -> None:
        self._require_port()
        if self._baud_rate == self.bus.config.baud_rate:
            self.feed(data)

    def read(self, until_ns: int) -> bytes:
        self._require_port()
        data = self.take_until(until_ns)
        self._require_port()
        return data

    def flush(self) -> None:
        self._require_port()
        self._inbox.clear()

    def close(self) -> None:
        self._baud_rate = None
        self._inbox.clear()

    def guardian(self, off: bytes, servos: Queries, silence_s: float, answer_s: float) -> Guardian:
        line = _GuardLine(self)
        motors = Motors(lambda: take_torque_off(line, off, servos, answer_s), self, CUT)
        return Guardian(lambda longest_s: VirtualChannel(self, motors, longest_s), silence_s)

    def feed(self, data: bytes) -> None:
        """Send bytes to the servos, from the host or the guardian."""
        self._require_line()
        self.bus.feed(data, self._now_ns)
        self.bus.run_until(self._now_ns)

    def take_until(self, until_ns: int) -> bytes:
        """Return the bytes that have arrived; wait for them until a time [ns]."""
        self._pass(until_ns, lambda: self._inbox)
        self._require_line()
        data = b"".join(self._inbox)
        self._inbox.clear()
        return data

    def _require_port(self) -> None:
        if self._baud_rate is None or not self.host_lives:
            raise OSError("the port is closed")
        self._require_line()

    def _require_line(self) -> None:
        if self.bus.unplugged(self._now_ns):
            raise OSError("the port is gone")

    def _take(self, answer: bytes) -> bool:
        self._inbox.append(answer)
        return True


class _GuardLine:
    """The port in virtual time, for the guardian's code; a `Line`."""

    def __init__(self, robot: VirtualRobot) -> None:
        self.clock: Clock = robot
        self._robot = robot

    def write(self, data: bytes) -> None:
        self._robot.feed(data)

    def read(self, until_ns: int) -> bytes:
        return self._robot.take_until(max(until_ns, self._robot.now_ns() + 1))  # reading lets time pass
