"""The Go2 of the emulator: a body with hidden parameters, on the floor or on a stand. Imports no JAX."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from sim2real.robots.walking.body import LeggedBody
from sim2real.robots.walking.hidden import HiddenTwin

LEGS = ("FR", "FL", "RR", "RL")
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


def latencies(seed: int | None) -> dict[str, float]:
    """Return latencies of the emulator with a seed [s]; None: the nominal ones."""
    if seed is None:
        return {"sensing_latency_s": 0.004, "actuation_latency_s": 0.006, "actuation_jitter_s": 0.0005}
    draw = random.Random(seed)
    return {
        "sensing_latency_s": draw.uniform(0.002, 0.007),
        "actuation_latency_s": draw.uniform(0.004, 0.010),
        "actuation_jitter_s": draw.uniform(0.0, 0.001),
    }
