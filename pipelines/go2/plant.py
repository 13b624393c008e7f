"""The Go2 of the emulator: a body with hidden parameters, on the floor or on a stand. Imports no JAX."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from sim2real.emulation.body import HiddenTwin, LeggedBody

LEGS, PARTS = ("FR", "FL", "RR", "RL"), ("hip", "thigh", "calf")
LYING = (0.0, 1.36, -2.65) * 4
"""Folded legs, as the Go2 lies [rad]."""


class Go2Body(LeggedBody):
    """A Go2 with folded legs.

    Args:
        place: ``floor``: it lies; ``stand``: its base is fixed, 1 m above the floor.
        seed: Seed of the hidden parameters; None: the nominal ones.
    """

    def __init__(self, place: Literal["floor", "stand"] = "floor", seed: int | None = None) -> None:
        drawn = HiddenTwin() if seed is None else HiddenTwin.draw(np.random.default_rng([seed, 2]), 12)
        # The latencies are the emulator's.
        hidden = replace(drawn, sensing_s=0.0, acting_s=0.0)
        super().__init__(Path(__file__).with_name("go2.xml"), LEGS, LYING, 0.12, hidden, place)

    def truth(self) -> dict[str, object]:
        hidden, motors = self.hidden, [f"{leg}_{part}" for leg in LEGS for part in PARTS]
        each = {"damping": hidden.damping, "friction": hidden.dry, "armature": hidden.armature}
        return {
            "foot_friction": hidden.friction,
            "payload": hidden.load_kg,
            **{f"{part}_{name}": value for part in PARTS for name, value in each.items()},
            **{f"{motor}_strength": float(x) for motor, x in zip(motors, hidden.strength, strict=True)},
            **{f"{motor}_zero": float(x) for motor, x in zip(motors, hidden.bias_rad, strict=True)},
        }


def latencies(seed: int | None) -> tuple[float, float, float]:
    """Return latency of sensing, latency and jitter of actuation of an emulator [s]; None: the nominal ones."""
    if seed is None:
        return 0.004, 0.006, 0.0005
    draw = random.Random(seed)
    return draw.uniform(0.002, 0.007), draw.uniform(0.004, 0.010), draw.uniform(0.0, 0.001)
