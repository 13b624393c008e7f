"""Settings of emulated Feetech servos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sim2real.errors import UsageError
from sim2real.hardware.emulation import Emulation
from sim2real.hardware.planned import PlannedBus
from sim2real.hardware.plant import Plant
from sim2real.hardware.truth import TruthLog


@dataclass(frozen=True)
class StsEmulation(Emulation):
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
        from sim2real.hardware.feetech.wire import StsBus

        return StsBus(plant, self, truth, send, start_ns)
