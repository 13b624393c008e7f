"""What the policy of a robot of servos sees, entry by entry: names, units, and how large it can get."""

from __future__ import annotations

import math

from sim2real.policy.contract import ObservationTerm
from sim2real.robots.servo.servos import Servos

Feature = tuple[str, tuple[str, ...]] | tuple[str, tuple[str, ...], float]
"""Name and units of what a policy sees, and its largest magnitude [its units] where that is known."""

_OVER_RAD, _OVER_SPEED, _FASTEST_RAD_S = math.pi, 5.0, 1e3
"""Bounds of what is measured: so far beyond the goals; so many times as fast as the servo turns without load; and the
speed that is taken where the data sheet knows none."""


def servo_terms(
    servos: Servos, aim: tuple[tuple[str, str], ...], features: tuple[Feature, ...] | None, history: int
) -> tuple[ObservationTerm, ...]:
    """Return the terms of the observation that ``GoalAgent`` makes.

    Args:
        aim: What an episode is about: names and units.
        features: What the policy sees of the present; None: positions, velocities, goals and aim.
        history: Past steps that it sees.
    """
    n, sheet = len(servos.joints), servos.sheet
    free = _OVER_SPEED * sheet.stall / sheet.damping if sheet.damping else _FASTEST_RAD_S
    fast = tuple(free / joint.gear for joint in servos.mounting)
    position, velocity, goal = (
        (tuple(v - _OVER_RAD for v in servos.low), tuple(v + _OVER_RAD for v in servos.high)),
        (tuple(-v for v in fast), fast),
        (servos.low, servos.high),
    )
    if features is None:
        measured = (("position", "rad", position), ("velocity", "rad/s", velocity), ("goal", "rad", goal))
        present = [ObservationTerm(name, (unit,) * n, 1, *bounds) for name, unit, bounds in measured]
        if aim:
            present.append(ObservationTerm("aim", tuple(unit for _, unit in aim)))
    else:
        present = [ObservationTerm.within(f[0], f[1], f[2] if len(f) > 2 else math.inf) for f in features if f[1]]
    if history:
        units = ("rad",) * n + ("rad/s",) * n + ("rad",) * n
        low, high = (position[i] + velocity[i] + goal[i] for i in (0, 1))
        # Before there is a history, it is 0.
        bounds = tuple(min(v, 0.0) for v in low), tuple(max(v, 0.0) for v in high)
        present.append(ObservationTerm("past position, velocity, goal", units, history, *bounds))
    return tuple(present)
