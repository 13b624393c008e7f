"""The Go2 for the stages: its model, stance and reward."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import jax.numpy as jnp

from sim2real.robots.robot import Embedded
from sim2real.robots.walking.drive import LegMotors, Place
from sim2real.robots.walking.robot import ComposedRobot
from sim2real.robots.walking.task import Moment, Term

from .plant import LEGS, LYING, PARTS, Go2Body, latencies

_BENT = (2.0, 0.5, 0.5) * 4
"""Weights of hip, thigh and calf off the stance."""


def _pose(now: Moment) -> jnp.ndarray:
    """Return how far the joints are from the stance; standing still counts more."""
    return (1.0 - 0.8 * now.moving) * jnp.sum(jnp.array(_BENT) * now.offset**2)


def embedded(place: Place) -> Embedded:
    """Return the emulated Go2, lying on the floor or in a stand, with parameters and latencies that no stage reads."""
    from sim2real.emulation.legs import UnitreeEmulation

    seed = 37
    return Embedded(partial(Go2Body, place, seed), UnitreeEmulation(*latencies(seed)))


class Go2(ComposedRobot):
    """A Unitree Go2 that follows velocities."""

    mjcf = Path(__file__).with_name("go2.xml")
    joints = tuple(f"{leg}_{part}" for leg in LEGS for part in PARTS)
    feet = LEGS
    groups = MappingProxyType({part: tuple(range(i, 12, 3)) for i, part in enumerate(PARTS)})
    stance = (-0.1, 0.8, -1.5, 0.1, 0.8, -1.5, -0.1, 1.0, -1.5, 0.1, 1.0, -1.5)
    motors = LegMotors("unitree", LYING, embedded=embedded)
    height_m, touching_m, scale = 0.33, 0.028, 0.6
    noise = MappingProxyType(
        {"position": (0.01, 0.015), "velocity": (0.5, 0.0), "quaternion": (0.01, 0.005), "gyro": (0.1, 0.02)}
    )

    def terms(self) -> Mapping[str, Term]:
        return {
            "velocity": (1.5, Moment.tracks),
            "yaw rate": (0.75, Moment.turns),
            "bounce": (-1.0, lambda now: now.linear[2] ** 2),
            "roll": (-0.05, lambda now: jnp.sum(now.angular[:2] ** 2)),
            "tilt": (-2.5, lambda now: jnp.sum(now.gravity[:2] ** 2)),
            "torque": (-2e-4, lambda now: jnp.sum(now.torque**2)),
            "action rate": (-0.02, Moment.action_rate),
            "pose": (-0.5, _pose),
            "steps": (8.0, Moment.steps),
            "slip": (-0.25, Moment.slip),
            "standing": (-0.2, Moment.lifted_at_rest),
            "height": (-20.0, lambda now: (now.height - 0.29) ** 2),
            "alive": (0.2, lambda now: 1.0),
            "fall": (-10.0, lambda now: now.falls),
        }


ROBOT = Go2()
