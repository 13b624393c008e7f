"""DYNAMIXEL servos on an emulated bus: what each instruction does."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.protocol import BROADCAST_ID, Instruction, Parser, StatusError, build_status
from sim2real.hardware.dynamixel.servo import EmulatedServo
from sim2real.hardware.planned import BusEmulation, PlannedBus, Request, Sample
from sim2real.hardware.plant import Plant
from sim2real.hardware.truth import TruthLog


class EmulatedBus(PlannedBus):
    """Emulated DYNAMIXEL servos on a bus, driving a plant; see `PlannedBus`.

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
        self._wild = config.wild
        self.servos = {
            i: EmulatedServo(
                i, config.model_number, config.return_delay_us, config.encoder_counts, config.watchdog_stops
            )
            for i in sorted(plant.servo_ids)
        }
        self._handlers: dict[int, Callable[[Request], None]] = {
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
        super().__init__(plant, config, truth, send, start_ns, now_ns, Parser(), self.servos)

    def execute(self, request: Request) -> None:
        """Carry out an instruction that is complete on the wire, and reply to it."""
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

    def _targets(self, request: Request) -> list[EmulatedServo]:
        """Return the servos that a request addresses, ordered by id."""
        if request.packet.servo_id == BROADCAST_ID:
            return list(self.servos.values())
        servo = self.servos.get(request.packet.servo_id)
        return [servo] if servo is not None else []

    def _ping(self, request: Request) -> None:
        for servo in self._targets(request):
            identity = reg.MODEL_NUMBER.encode(servo.get(reg.MODEL_NUMBER)) + bytes((servo.get(reg.FIRMWARE_VERSION),))
            self._reply(servo, request, StatusError.NONE, identity)

    def _read(self, request: Request) -> None:
        parameters = request.packet.parameters
        if request.packet.servo_id == BROADCAST_ID:
            return
        servo = self.servos[request.packet.servo_id]
        if len(parameters) != 4:
            self._acknowledge(servo, request, StatusError.DATA_LENGTH)
            return
        self._answer_read(servo, request, _word(parameters, 0), _word(parameters, 2))

    def _sync_read(self, request: Request) -> None:
        parameters = request.packet.parameters
        if len(parameters) < 5:
            return
        for servo_id in parameters[4:]:
            if servo_id in self.servos:
                self._answer_read(self.servos[servo_id], request, _word(parameters, 0), _word(parameters, 2))

    def _bulk_read(self, request: Request) -> None:
        parameters = request.packet.parameters
        for i in range(0, len(parameters) - 4, 5):
            if parameters[i] in self.servos:
                servo = self.servos[parameters[i]]
                self._answer_read(servo, request, _word(parameters, i + 1), _word(parameters, i + 3))

    def _write(self, request: Request) -> None:
        address, data = _word(request.packet.parameters, 0), request.packet.parameters[2:]
        for servo in self._targets(request):
            self._acknowledge(servo, request, self._write_servo(servo, request, address, data))

    def _sync_write(self, request: Request) -> None:
        parameters = request.packet.parameters
        address, length = _word(parameters, 0), _word(parameters, 2)
        for i in range(4, len(parameters) - length, length + 1):
            servo = self.servos.get(parameters[i])
            if servo is not None:
                self._write_servo(servo, request, address, parameters[i + 1 : i + 1 + length])

    def _reg_write(self, request: Request) -> None:
        address, data = _word(request.packet.parameters, 0), request.packet.parameters[2:]
        for servo in self._targets(request):
            self._acknowledge(servo, request, servo.register_write(address, data))

    def _action(self, request: Request) -> None:
        for servo in self._targets(request):
            self.measure(servo, request.t_ns)
            error, moves = servo.action()
            self.configure(servo)
            if moves:
                self.actuate(servo, request)
            self._acknowledge(servo, request, error)

    def _reboot(self, request: Request) -> None:
        for servo in self._targets(request):
            self._acknowledge(servo, request, StatusError.NONE)
            servo.reboot()
            self.configure(servo)
            self.actuate(servo, request)

    def _write_servo(self, servo: EmulatedServo, request: Request, address: int, data: bytes) -> StatusError:
        self.measure(servo, request.t_ns)
        error, moves = servo.write(address, data)
        self.configure(servo)
        if moves:
            self.actuate(servo, request)
        return error

    def _answer_read(self, servo: EmulatedServo, request: Request, address: int, length: int) -> None:
        sample = self.measure(servo, request.t_ns)
        if self.happens(self._wild):
            servo.put(reg.PRESENT_POSITION, self.random.randrange(1 << 24, 1 << 31))
        error, data = servo.read(address, length)
        if servo.get(reg.STATUS_RETURN_LEVEL) >= 1:
            measured = address < reg.PRESENT_POSITION.end and address + length > reg.PRESENT_PWM.address
            self._reply(servo, request, error, data, sample if measured else None)

    def _acknowledge(self, servo: EmulatedServo, request: Request, error: StatusError) -> None:
        if request.packet.servo_id != BROADCAST_ID and servo.get(reg.STATUS_RETURN_LEVEL) >= 2:
            self._reply(servo, request, error)

    def _reply(
        self,
        servo: EmulatedServo,
        request: Request,
        error: StatusError,
        data: bytes = b"",
        sample: Sample | None = None,
    ) -> None:
        answer = build_status(servo.servo_id, error | servo.alert, data)
        self.reply(servo.servo_id, request, answer, servo.get(reg.RETURN_DELAY_TIME) * reg.RETURN_DELAY_UNIT_S, sample)


def _word(data: bytes, position: int) -> int:
    return int.from_bytes(data[position : position + 2], "little")


@dataclass(frozen=True)
class EmulatorConfig(BusEmulation):
    """Settings of emulated DYNAMIXEL servos on their bus; see `Emulation` for the others.

    Args:
        model_number: The servos' model number; their firmware behaves as that of the model.
        watchdog_stops: Whether a tripped bus watchdog stops the motor; None: as in the model's firmware.
    """

    model_number: int = 1060
    watchdog_stops: bool | None = None

    def bus(self, plant: Plant, truth: TruthLog, send: Callable[[bytes], bool], start_ns: int) -> PlannedBus:
        """Return the emulated bus with these settings.

        Args:
            plant: The mechanism.
            truth: Log of true states and latencies.
            send: Called with an answer's bytes when the host is to get them; returns False if it cannot take them.
            start_ns: Time 0 of the plant, CLOCK_MONOTONIC [ns].
        """
        return EmulatedBus(plant, self, truth, send, start_ns)
