"""Hidden pendulums for the bench of drift, and a policy written by hand: it pumps energy, then holds them upright."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benches.hidden import randomise
from benches.hidden import robots as hidden

FRICTION, PAYLOAD, DELAY_S = 2.0, 1.3, 0.015
MASS_SHARE = 0.548
"""Of the pendulum's inertia, by its data sheet."""
LIMIT_V = 2.0
PROBE_S = 8.0
"""Length of the log of the small steps by which a deployment measures the delay [s]."""


@dataclass(frozen=True)
class Pendulum:
    """A hidden pendulum: ``robot`` now, and ``before``, when its policy was made."""

    robot: hidden.Hidden
    before: hidden.Hidden
    number: int
    pipeline: ClassVar[str] = "pendulum"
    defaults: ClassVar[dict[str, float]] = {
        "record_s": 40.0, "seconds": 10.0, "episodes": 2, "generations": 80,
        "steps": 1_000_000, "envs": 256,
    }  # fmt: skip
    causes: ClassVar[dict[str, str]] = {"friction": "friction", "payload": "payload", "delay": "round_trip_delay"}

    @staticmethod
    def draw(number: int) -> Pendulum:
        """Draw a robot."""
        robot = hidden.Hidden.draw(number)
        return Pendulum(robot, robot, number)

    @property
    def truth(self) -> dict[str, Any]:
        """Its parameters, for the report."""
        return vars(self.robot)

    def changed(self, change: str) -> Pendulum:
        """Return the robot after a change; ``none``: no change."""
        robot = self.robot
        if change == "friction":
            robot = replace(robot, friction=FRICTION * robot.friction)
        if change == "delay":
            robot = replace(robot, acting=robot.acting + DELAY_S)
        if change == "payload":  # at the mass, so the inertia grows, too
            inertia = 1.0 + (PAYLOAD - 1.0) * MASS_SHARE
            others = {n: getattr(robot, n) / inertia for n in ("gain", "damping", "friction")}
            robot = replace(robot, gravity=PAYLOAD * robot.gravity / inertia, **others)
        return replace(self, robot=robot)

    def record(self, path: Path, seconds: float, session: int) -> None:
        """Write the log of an excitation; ``session`` is the seed of jitter and losses."""
        hidden.write(path, hidden.play(self.robot, hidden.excited(seconds, self.number), seconds, session))

    def probe(self, path: Path, session: int) -> None:
        """Write the log of the small steps before a deployment."""
        hidden.write(path, hidden.play(self.robot, hidden.probed(), PROBE_S, session))

    def deploy(self, path: Path, seconds: float, session: int) -> float:
        """Write the log of an episode of the policy written by hand; return the share of success."""
        played = hidden.play(self.robot, swing_up(self.before), seconds, session)
        hidden.write(path, played)
        return float((np.cos(played.angle) > 0.95)[len(played.t) // 2 :].mean())

    def success(self, bundle: Any, options: Any) -> list[float]:
        """Return the success of each deployment of a trained policy: see ``randomise``."""
        motions = [randomise.played(self.robot, bundle, options, 100 + trial) for trial in range(options.trials)]
        return [randomise.upright(*motion, randomise.STILL_RAD_S) for motion in motions]


def swing_up(robot: hidden.Hidden) -> hidden.Controller:
    """Return a policy that pumps energy until the pendulum comes up, and holds it there; it predicts over the delay."""
    gravity, late, parts = robot.gravity, robot.sensing + robot.acting, 8
    last = 0.0

    def act(angle: float, speed: float) -> float:
        nonlocal last
        for _ in range(parts):
            pushed = robot.gain * last + gravity * math.sin(angle) - robot.damping * speed
            speed += late / parts * pushed
            angle += late / parts * speed
        off = math.atan2(math.sin(angle), math.cos(angle))
        energy = 0.5 * speed**2 + gravity * (math.cos(off) - 1.0)
        if abs(off) < 0.5 and abs(speed) < 6.0:
            wanted = -(1.5 * gravity * off + 1.2 * math.sqrt(gravity) * speed) / robot.gain
        elif math.cos(off) < -0.9 and abs(speed) < 0.3:  # it hangs: any voltage moves it
            wanted = LIMIT_V
        else:
            wanted = -math.copysign(LIMIT_V, energy * speed) if abs(energy) > 0.05 * gravity else 0.0
        last = min(max(wanted, -LIMIT_V), LIMIT_V)
        return last

    return act
