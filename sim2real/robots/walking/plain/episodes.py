"""Episodes of a policy on the twin, for the comparison with a deployment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.policy.runner import Runner
from sim2real.robots.loop import DELAYS
from sim2real.robots.robot import Robot
from sim2real.robots.walking.joints import STRENGTH as MOTOR_STRENGTH
from sim2real.robots.walking.messages import into_base
from sim2real.robots.walking.model import FRICTION, STRENGTH
from sim2real.robots.walking.plain.hidden import HiddenTwin
from sim2real.robots.walking.robot import ComposedRobot
from sim2real.robots.walking.twin import Twin, walk
from sim2real.robots.walking.world import PAYLOAD


def plain_episodes(
    robot: Robot, policy: Runner, values: Mapping[str, float] | None, trials: Sequence[int], duration_s: float
) -> list[tuple[np.ndarray, dict[str, np.ndarray]]] | None:
    """Return episodes of a policy: times ``(N,)`` [s] and columns ``(N,)``; None for a robot that does not walk.

    The graph of a walking robot takes more than ten minutes to compile on a processor, so C MuJoCo simulates it.

    Args:
        values: Parameters and delays by name; None: nominal ones.
        trials: The trial of each episode.
    """
    if not isinstance(robot, ComposedRobot):
        return None
    return [episode(robot, policy, {**robot.nominal(), **(values or {})}, n, duration_s) for n in trials]


def twin_of(robot: ComposedRobot, values: Mapping[str, float], seed: int = 0) -> Twin:
    """Return the twin with parameters and delays by name; the policy's computation adds to the actuator's delay."""
    joints = robot.model.joints
    hidden = HiddenTwin(
        friction=values[FRICTION],
        load_kg=values[PAYLOAD],
        strength=np.asarray(values[STRENGTH] * joints.of_motor(values, MOTOR_STRENGTH)),
        damping=np.asarray(joints.of_group(values, "damping")),
        dry=np.asarray(joints.of_group(values, "friction")),
        armature=np.asarray(joints.of_group(values, "armature")),
        sensing_s=values[DELAYS[0]],
        acting_s=values[DELAYS[1]] + robot.drive.expected_delay_s[1],
        bias_rad=np.zeros(len(robot.joints)),
    )
    return Twin(robot, hidden, seed)


def episode(
    robot: ComposedRobot, policy: Runner, values: Mapping[str, float], trial: int, duration_s: float
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return times ``(N,)`` [s] and columns ``(N,)`` of a trial, up to a fall."""
    twin, drawn = twin_of(robot, values, trial), robot.commands.of_trial(trial)
    times, rows = [], []

    def shown(twin: Twin, t_s: float) -> None:
        q, v = twin.data.qpos, twin.data.qvel
        aim = np.asarray(robot.commands.at(drawn, t_s))
        times.append(t_s + 1.0 / robot.rate_hz)
        rows.append((q[7:], v[6:], q[3:7], v[3:6], into_base(q[3:7], v[:3]), q[:3], aim, twin.sent))
        rows[-1] = tuple(np.array(x) for x in rows[-1])

    policy.reset()
    walk(twin, policy, lambda t_s: np.asarray(robot.commands.at(drawn, t_s)), duration_s, shown=shown)
    names = ("position", "velocity", "quaternion", "gyro", "linear", "base", "aim", "command")
    fields = dict(zip(names, (np.stack(parts) for parts in zip(*rows, strict=True)), strict=True))
    columns = {f"{name}[{i}]": column for name, values in fields.items() for i, column in enumerate(values.T)}
    return np.array(times), columns
