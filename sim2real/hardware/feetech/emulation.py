"""Feetech servos on an emulated bus: what each instruction does."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from sim2real.errors import UsageError
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.profile import ProfiledPlant
from sim2real.hardware.feetech.protocol import BROADCAST_ID, StsInstruction, StsParser, build
from sim2real.hardware.feetech.servo import StsServo
from sim2real.hardware.planned import BusEmulation, Firmware, PlannedBus, Request, Sample
from sim2real.hardware.plant import Plant
from sim2real.hardware.truth import TruthLog

_WILD_COUNTS = (8192, 32768)


class StsBus(PlannedBus):
    """Emulated STS3215 servos on a bus, driving a plant; see `PlannedBus`.

    An instruction with a wrong checksum is not answered, as their protocol has no way to say so; nor is a ping of all
    servos if there are several, whose answers would collide.

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
        config: StsEmulation,
        truth: TruthLog,
        send: Callable[[bytes], bool],
        start_ns: int,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._faults = config
        self._profiles = ProfiledPlant(plant)
        self.servos = {
            i: StsServo(
                i, config.model_number, config.return_delay_us, config.encoder_counts, config.goal_wakes, config.alarms
            )
            for i in sorted(plant.servo_ids)
        }
        for servo in self.servos.values():
            servo.put(reg.HOMING_OFFSET, config.homing_offset)
        self._handlers: dict[int, Callable[[Request, list[StsServo]], None]] = {
            StsInstruction.PING: self._ping,
            StsInstruction.READ: self._read,
            StsInstruction.WRITE: self._write,
            StsInstruction.REG_WRITE: self._reg_write,
            StsInstruction.ACTION: self._action,
            StsInstruction.RESTART: self._restart,
            StsInstruction.SYNC_READ: self._sync_read,
            StsInstruction.SYNC_WRITE: self._sync_write,
        }
        super().__init__(self._profiles, config, truth, send, start_ns, now_ns, StsParser(), self.servos)

    def execute(self, request: Request) -> None:
        """Carry out an instruction that is complete on the wire, and reply to it."""
        packet = request.packet
        broadcast = packet.servo_id == BROADCAST_ID
        targets = [s for i, s in self.servos.items() if broadcast or i == packet.servo_id]
        handler = self._handlers.get(packet.code)
        if targets and packet.checksum_ok and handler is not None:
            handler(request, targets)

    def configure(self, servo: Firmware) -> None:
        """Tell the plant a servo's controller settings if they have changed."""
        super().configure(servo)
        self._profiles.accelerate(servo.servo_id, self.servos[servo.servo_id].acceleration_rad_s2())

    def _ping(self, request: Request, targets: list[StsServo]) -> None:
        if len(targets) == 1:
            self._reply(targets[0], request)

    def _read(self, request: Request, targets: list[StsServo]) -> None:
        parameters = request.packet.parameters
        if request.packet.servo_id != BROADCAST_ID and len(parameters) == 2:
            self._answer_read(targets[0], request, *parameters)

    def _sync_read(self, request: Request, targets: list[StsServo]) -> None:
        del targets
        parameters = request.packet.parameters
        for servo_id in parameters[2:]:
            if servo_id in self.servos:
                self._answer_read(self.servos[servo_id], request, parameters[0], parameters[1])

    def _write(self, request: Request, targets: list[StsServo]) -> None:
        for servo in targets:
            self._carry_out(servo, request, request.packet.parameters)
            self._acknowledge(servo, request)

    def _sync_write(self, request: Request, targets: list[StsServo]) -> None:
        del targets
        parameters = request.packet.parameters
        address, length = parameters[:2]
        for i in range(2, len(parameters) - length, length + 1):
            if parameters[i] in self.servos:
                data = bytes((address,)) + parameters[i + 1 : i + 1 + length]
                self._carry_out(self.servos[parameters[i]], request, data)

    def _reg_write(self, request: Request, targets: list[StsServo]) -> None:
        for servo in targets:
            servo.register_write(request.packet.parameters[0], request.packet.parameters[1:])
            self._acknowledge(servo, request)

    def _action(self, request: Request, targets: list[StsServo]) -> None:
        for servo in targets:
            self._carry_out(servo, request, None)
            self._acknowledge(servo, request)

    def _restart(self, request: Request, targets: list[StsServo]) -> None:
        for servo in targets:
            self._acknowledge(servo, request)
            servo.restart()
            self.configure(servo)
            self.actuate(servo, request)

    def _carry_out(self, servo: StsServo, request: Request, written: bytes | None) -> None:
        """Write an address and the data after it to a servo's registers; None: what it has stored for ACTION."""
        self.measure(servo, request.t_ns)
        moves = servo.action() if written is None else servo.write(written[0], written[1:])
        self.configure(servo)
        if moves:
            self.actuate(servo, request)

    def _answer_read(self, servo: StsServo, request: Request, address: int, length: int) -> None:
        sample = self.measure(servo, request.t_ns)
        if self.happens(self._faults.wild):
            servo.put(reg.PRESENT_POSITION, self.random.randrange(*_WILD_COUNTS))
        measured = address < reg.PRESENT_LOAD.end and address + length > reg.PRESENT_POSITION.address
        self._reply(servo, request, servo.read(address, length), sample if measured else None)

    def _acknowledge(self, servo: StsServo, request: Request) -> None:
        if request.packet.servo_id != BROADCAST_ID and servo.get(reg.RESPONSE_LEVEL):
            self._reply(servo, request)

    def _reply(self, servo: StsServo, request: Request, data: bytes = b"", sample: Sample | None = None) -> None:
        sender = servo.servo_id ^ 0x40 if self.happens(self._faults.wrong_id) else servo.servo_id
        answer = build(sender, servo.alarms, data)
        if self.happens(self._faults.cut):
            answer = answer[:4]
        self.reply(servo.servo_id, request, answer, servo.get(reg.RETURN_DELAY_TIME) * reg.RETURN_DELAY_UNIT_S, sample)


@dataclass(frozen=True)
class StsEmulation(BusEmulation):
    """Settings of emulated STS3215 servos on their bus; see `Emulation` for the others.

    Args:
        model_number: The servos' model number.
        alarms: The alarms that they report from `overload_after_s` on; bits of the error byte.
        wrong_id: Probability that an answer says that it is another servo's.
        cut: Probability that an answer ends after its fourth byte.
        goal_wakes: Whether writing a goal switches the torque on, the worse case for a driver.
        homing_offset: What every servo subtracts from its encoder's count [counts].
    """

    model_number: int = 777
    alarms: int = 32
    wrong_id: float = 0.0
    cut: float = 0.0
    goal_wakes: bool = True
    homing_offset: int = 0

    def __post_init__(self) -> None:
        """Check that all values are in their ranges."""
        super().__post_init__()
        for name, (low, high) in {
            "wrong_id": (0, 1),
            "cut": (0, 1),
            "alarms": (1, 127),
            "homing_offset": (-2047, 2047),
        }.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"emulator: {name} = {getattr(self, name)} is outside [{low}, {high}]")

    def bus(self, plant: Plant, truth: TruthLog, send: Callable[[bytes], bool], start_ns: int) -> PlannedBus:
        """Return the bus with these settings.

        Args:
            plant: The mechanism.
            truth: Log of true states and latencies.
            send: See `Emulation.bus`.
            start_ns: Time 0 of the plant, CLOCK_MONOTONIC [ns].
        """
        return StsBus(plant, self, truth, send, start_ns)
