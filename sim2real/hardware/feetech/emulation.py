"""Feetech servos on an emulated bus: the part that other families do not share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sim2real.errors import UsageError
from sim2real.hardware.emulation.emulated_bus import BusEmulation, Firmware, Request
from sim2real.hardware.emulation.instructions import InstructedBus
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.profile import ProfiledPlant
from sim2real.hardware.feetech.protocol import PROTOCOL
from sim2real.hardware.feetech.servo import StsServo
from sim2real.hardware.plant import Plant


class StsBus(InstructedBus[StsServo, "StsEmulation"]):
    """Emulated STS3215 servos on a bus, driving a plant; see `InstructedBus`.

    They do not answer an instruction with a wrong checksum, for which the protocol has no error; nor several servos a
    broadcast ping, as their answers would collide.
    """

    form = PROTOCOL
    present = (reg.PRESENT_POSITION, reg.PRESENT_LOAD)
    wild_counts = (8192, 32768)

    def __init__(self, plant: Plant, *arguments: Any) -> None:
        self._profiles = ProfiledPlant(plant)
        super().__init__(self._profiles, *arguments)

    def make_servo(self, servo_id: int) -> StsServo:
        """Return a servo with this bus's settings."""
        c = self.config
        servo = StsServo(servo_id, c.model_number, c.return_delay_us, c.encoder_counts, c.goal_wakes, c.alarms)
        servo.put(reg.HOMING_OFFSET, c.homing_offset)
        return servo

    def configure(self, servo: Firmware) -> None:
        """Pass a servo's controller settings to the plant if they have changed."""
        super().configure(servo)
        self._profiles.accelerate(servo.servo_id, self.servos[servo.servo_id].acceleration_rad_s2())

    def _ping(self, request: Request, targets: list[StsServo]) -> None:
        """Answer a ping of one servo."""
        if len(targets) == 1:
            super()._ping(request, targets)

    def _status(self, servo: StsServo, error: int, data: bytes) -> bytes:
        """Return the bytes of an answer, with the faults of the settings."""
        sender = servo.servo_id ^ 0x40 if self.happens(self.config.wrong_id) else servo.servo_id
        answer = PROTOCOL.build_status(sender, error, data)
        return answer[:4] if self.happens(self.config.cut) else answer


@dataclass(frozen=True)
class StsEmulation(BusEmulation):
    """Settings of emulated STS3215 servos on their bus; see `Emulation` for the others.

    Args:
        alarms: The alarms that they report from `overload_after_s` on; bits of the error byte.
        wrong_id: Probability that an answer has the id of another servo.
        cut: Probability that an answer ends after its fourth byte.
        goal_wakes: Whether writing a goal switches the torque on, the worse case for a driver.
        homing_offset: Offset that every servo subtracts from its encoder's count [counts].
    """

    bus_type = StsBus

    model_number: int = 777
    alarms: int = 32
    wrong_id: float = 0.0
    cut: float = 0.0
    goal_wakes: bool = True
    homing_offset: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (low, high) in {
            "wrong_id": (0, 1),
            "cut": (0, 1),
            "alarms": (1, 127),
            "homing_offset": (-2047, 2047),
        }.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"emulator: {name} = {getattr(self, name)} is outside [{low}, {high}]")
