"""Transactions with DYNAMIXEL X servos, and the errors that these report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sim2real.errors import SafetyStop, Sim2RealError
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.packets import BROADCAST_ID, Answer, Instruction
from sim2real.hardware.bus.port import LinkConfig
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.protocol import ALERT_BIT, PROTOCOL, StatusError

_REASONS: Final[dict[int, str]] = {
    StatusError.RESULT_FAIL: "it failed to carry it out",
    StatusError.INSTRUCTION: "it does not know the instruction",
    StatusError.CRC: "the instruction arrived with a wrong checksum",
    StatusError.DATA_RANGE: "the value is out of the register's range",
    StatusError.DATA_LENGTH: "the data are shorter than the register",
    StatusError.DATA_LIMIT: "the value is beyond a limit set in the servo",
    StatusError.ACCESS: "the register cannot be written or read now (EEPROM registers: not while torque is on)",
}
_SCAN_S: Final = 0.8
"""How long all answers to a ping of everyone may take: each servo waits 3 ms for each id before its own."""


@dataclass(frozen=True)
class BusConfig(LinkConfig):
    """Port and time limits of a bus of DYNAMIXEL servos; see `LinkConfig`.

    The servos' bus watchdogs are set to `silence_s`, in multiples of 20 ms. What a servo does when it trips depends on
    its model: `sim2real.hardware.dynamixel.models`.
    """

    family = "DYNAMIXEL"
    baud_rates = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
    longest_silence_s = reg.WATCHDOG_MAX_COUNT * reg.WATCHDOG_UNIT_S

    @property
    def watchdog_count(self) -> int:
        """Value of the register Bus Watchdog: `silence_s` in units of 20 ms, at least 1 unless it is 0 (off)."""
        return max(1, round(self.silence_s / reg.WATCHDOG_UNIT_S)) if self.silence_s > 0.0 else 0


class BusLink(ServoLink):
    """Owner of the port of DYNAMIXEL servos; see `ServoLink`."""

    form = PROTOCOL
    table = reg.TABLE
    ping_bytes = 3  # model number and firmware version

    def scan(self) -> list[int]:
        """Return the ids of all servos, which answer a ping of everyone; takes 0.8 s."""
        return self.answering(PROTOCOL.build(BROADCAST_ID, Instruction.PING), _SCAN_S)

    def require_fine(self, answer: Answer, what: str) -> None:
        """Raise the error that an answer reports: SafetyStop if the servo has stopped itself.

        Args:
            what: Description of the instruction, for errors.
        """
        servo_id, error = answer.servo_id, answer.error
        if error & ALERT_BIT:
            bits = self.read(servo_id, reg.HARDWARE_ERROR_STATUS, despite_error=True)
            raise SafetyStop(
                f"servo {servo_id} has stopped itself: {reg.describe_hardware_errors(bits)}",
                hint="remove the cause, then reboot the servo",
            )
        if self.read(servo_id, reg.BUS_WATCHDOG, despite_error=True) == reg.WATCHDOG_TRIPPED:
            raise SafetyStop(*watchdog_message(servo_id))
        raise Sim2RealError(f"servo {servo_id} refused {what}: {_REASONS.get(error, f'error {error}')}")


def watchdog_message(servo_id: int) -> tuple[str, str]:
    """Return the message and the hint for a servo whose bus watchdog has tripped."""
    return (
        f"the bus watchdog of servo {servo_id} has tripped: it heard nothing for longer than silence_s",
        "look for a loop that stalls; switching torque on again clears it",
    )
