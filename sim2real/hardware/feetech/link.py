"""Transactions with Feetech STS servos, and the alarms that these report."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.errors import SafetyStop
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.packets import Answer
from sim2real.hardware.bus.port import LinkConfig
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.protocol import PROTOCOL, describe_alarms


@dataclass(frozen=True)
class StsConfig(LinkConfig):
    """Port and time limits of a bus of Feetech servos; see `LinkConfig`. They have no watchdogs."""

    family = "Feetech"
    baud_rates = reg.BAUD_RATES


class StsLink(ServoLink):
    """Owner of the port of Feetech servos; see `ServoLink`."""

    form = PROTOCOL
    table = reg.TABLE

    def require_fine(self, answer: Answer, what: str) -> None:
        """Raise SafetyStop, as the error byte holds alarms.

        Args:
            what: Description of the instruction, for errors.
        """
        del what
        raise SafetyStop(
            f"servo {answer.servo_id} reports an alarm: {describe_alarms(answer.error)}",
            hint="remove the cause, then switch its power off and on; does the supply's voltage fit the servo?",
        )
