"""DYNAMIXEL servos on an emulated bus: the part that other families do not share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.protocol import PROTOCOL, StatusError
from sim2real.hardware.dynamixel.servo import EmulatedServo
from sim2real.hardware.emulation.emulated_bus import BusEmulation, Request
from sim2real.hardware.emulation.instructions import InstructedBus


class EmulatedBus(InstructedBus[EmulatedServo, "EmulatorConfig"]):
    """Emulated DYNAMIXEL servos on a bus, driving a plant; see `InstructedBus`."""

    form = PROTOCOL
    present = (reg.PRESENT_PWM, reg.PRESENT_POSITION)
    wild_counts = (1 << 24, 1 << 31)

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._handlers[Instruction.BULK_READ] = self._bulk_read

    def make_servo(self, servo_id: int) -> EmulatedServo:
        """Return a servo with this bus's settings."""
        c = self.config
        return EmulatedServo(servo_id, c.model_number, c.return_delay_us, c.encoder_counts, c.watchdog_stops)

    def execute(self, request: Request) -> None:
        """Carry out an instruction that is complete on the wire, and reply to it."""
        if request.packet.code != Instruction.STATUS:
            super().execute(request)

    def _misunderstand(self, servo: EmulatedServo, request: Request) -> None:
        """Answer an instruction with its error."""
        self._answer(servo, request, StatusError.INSTRUCTION if request.packet.intact else StatusError.CRC)

    def _misread(self, servo: EmulatedServo, request: Request) -> None:
        """Answer a READ of a wrong length with an error."""
        self._confirm(servo, request, StatusError.DATA_LENGTH)

    def _bulk_read(self, request: Request, targets: list[EmulatedServo]) -> None:
        del targets
        parameters = request.packet.parameters
        for i in range(0, len(parameters) - 4, 5):
            if parameters[i] in self.servos:
                self._answer_read(self.servos[parameters[i]], request, i + 1)


@dataclass(frozen=True)
class EmulatorConfig(BusEmulation):
    """Settings of emulated DYNAMIXEL servos on their bus; see `Emulation` for the others.

    Args:
        model_number: The servos' model number; their firmware behaves as that of the model.
        watchdog_stops: Whether a tripped bus watchdog stops the motor; None: as in the model's firmware.
    """

    bus_type = EmulatedBus

    model_number: int = 1060
    watchdog_stops: bool | None = None
