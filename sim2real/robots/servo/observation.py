"""The policy of a robot of servos: its observation, entry by entry, and its actions."""

import math
from collections.abc import Callable
from typing import Unpack

import numpy as np

from sim2real.arrays import namespace
from sim2real.graph.node import NodeOptions
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.agent import AgentParams, GoalAgent
from sim2real.robots.loop import AGENT
from sim2real.robots.messages import EpisodeStart, JointReading
from sim2real.robots.robot import RobotAgent
from sim2real.robots.servo.servos import Servos
from sim2real.robots.servo.task import NO_AIM, Aim
from sim2real.types import Array, PyTree

Feature = tuple[str, tuple[str, ...]] | tuple[str, tuple[str, ...], float]
"""Name and units of a term of the observation, and its largest magnitude [the units] where there is one."""
Observe = Callable[[JointReading, Array, Array], Array]
"""Returns the present part of the observation: (reading, goals ``(joints,)`` [rad], aim ``(k,)``) -> ``(features,)``.

In training it gets arrays of JAX, on the robot of NumPy: ``namespace(goals)`` of ``sim2real.arrays`` is the matching
module. ``jax.numpy`` works too, but is slower on the robot."""

_MARGIN_RAD, _SPEED_FACTOR, _FASTEST_RAD_S = math.pi, 5.0, 1e3
"""Bounds of measurements: distance from the goals' bounds; factor on the servo's speed without load; and the speed
where the data sheet has no damping."""


class ServoAgent(RobotAgent):
    """Speeds of the goals from positions, velocities, goals, the aim and a short history.

    Args:
        features: Names, units and largest magnitudes of the present part of the observation; None: positions,
            velocities, goals and aim.
        observe: Makes that part; see ``Observe``.
    """

    def __init__(
        self,
        servos: Servos,
        aim: Aim = NO_AIM,
        features: tuple[Feature, ...] | None = None,
        observe: Observe | None = None,
        history: int = 3,
    ) -> None:
        self._servos, self._aim, self.history = servos, aim, history
        self.observe = observe or observe_all
        self.observation = servo_terms(servos, aim.entries, features, history)
        speed, names = servos.speed, servos.names
        self.action = tuple(ActionTerm(f"speed of {name}'s goal", "rad/s", -speed, speed) for name in names)
        ends = {"lowest": servos.low, "highest": servos.high}
        self.limits = {f"{end} goal of {n}": v for end, vs in ends.items() for n, v in zip(names, vs, strict=True)}
        self.units = {f"aim[{i}]": unit for i, (_, unit) in enumerate(aim.entries)}

    def make(self, rate_hz: float, **options: Unpack[NodeOptions]) -> GoalAgent:
        """Return the policy's node."""
        s, aim = self._servos, self._aim
        return GoalAgent(AGENT, rate_hz, s.low, s.high, self.observe, self.history, len(aim.draw(0)), aim.at, **options)

    def params(self, start: EpisodeStart, policy: PyTree) -> AgentParams:
        """Return the node's parameters: goals start at the joints' positions."""
        return AgentParams(
            policy=policy, aim=start.aim, start=namespace(start.position).asarray(start.position, np.float32)
        )


def observe_all(reading: JointReading, goal: Array, aim: Array) -> Array:
    """Return positions, velocities, goals and aim."""
    return namespace(goal).concatenate([reading.position, reading.velocity, goal, aim])


def servo_terms(
    servos: Servos, aim: tuple[tuple[str, str], ...], features: tuple[Feature, ...] | None, history: int
) -> tuple[ObservationTerm, ...]:
    """Return the terms of the observation that ``GoalAgent`` makes.

    Args:
        aim: Names and units of the aim's entries.
        features: Terms of the present; None: positions, velocities, goals and aim.
    """
    # Bounds of the measurements: the goals' range with a margin, and the servos' largest speed.
    n, sheet = len(servos.joints), servos.sheet
    free = _SPEED_FACTOR * sheet.stall / sheet.damping if sheet.damping else _FASTEST_RAD_S
    fast = tuple(free / gear for gear in servos.gears)
    position, velocity, goal = (
        (tuple(v - _MARGIN_RAD for v in servos.low), tuple(v + _MARGIN_RAD for v in servos.high)),
        (tuple(-v for v in fast), fast),
        (servos.low, servos.high),
    )
    # The present part of the observation.
    if features is None:
        measured = (("position", "rad", position), ("velocity", "rad/s", velocity), ("goal", "rad", goal))
        present = [ObservationTerm(name, (unit,) * n, 1, *bounds) for name, unit, bounds in measured]
        if aim:
            present.append(ObservationTerm("aim", tuple(unit for _, unit in aim)))
    else:
        present = [ObservationTerm.within(f[0], f[1], f[2] if len(f) > 2 else math.inf) for f in features if f[1]]
    # The history.
    if history:
        units = ("rad",) * n + ("rad/s",) * n + ("rad",) * n
        low, high = (position[i] + velocity[i] + goal[i] for i in (0, 1))
        # Before there is a history, it is 0.
        bounds = tuple(min(v, 0.0) for v in low), tuple(max(v, 0.0) for v in high)
        present.append(ObservationTerm("past position, velocity, goal", units, history, *bounds))
    return tuple(present)
