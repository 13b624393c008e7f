"""Settings of emulated DYNAMIXEL servos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sim2real.hardware.emulation import Emulation
from sim2real.hardware.planned import PlannedBus
from sim2real.hardware.plant import Plant
from sim2real.hardware.truth import TruthLog


@dataclass(frozen=True)
class EmulatorConfig(Emulation):
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
        from sim2real.hardware.dynamixel.wire import EmulatedBus

        return EmulatedBus(plant, self, truth, send, start_ns)
