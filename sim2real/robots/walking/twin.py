"""A walking robot on C MuJoCo, the judge of policies: every geom collides, and timing and parameters are hidden."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np

from sim2real.emulation.body import HiddenTwin, LeggedBody
from sim2real.graph.base import GraphState, StepState
from sim2real.policy.runner import Runner
from sim2real.robots.loop import AGENT, DELAYS, SENSOR
from sim2real.robots.messages import States
from sim2real.robots.nodes import in_numpy
from sim2real.robots.walking.drive import BodyReading, gravity_of, into_base
from sim2real.robots.walking.world import FRICTION, MOTOR_STRENGTH, PAYLOAD, STRENGTH

if TYPE_CHECKING:
    from sim2real.robots.walking.robot import ComposedRobot

_mj: Any = mujoco
STEP_S = 0.002
"""Time step of the twin's physics, shorter than that of training [s]."""
_REACH_M = 30.0
"""Half the width of the rough ground: the length of an episode's way, with pushes [m]."""
_SETTLED_S, _PUSHED_S = 1.0, 5.0
"""Time after a new command or a push that does not count; time from push to push [s]."""


class Walked(NamedTuple):
    """An episode on a twin.

    Attributes:
        fell_s: When the robot fell [s]; None: it did not fall.
        error_m_s: Mean error of the forward and sideways velocity, each averaged over a step of the gait [m/s].
        error_rad_s: Mean error of the yaw rate [rad/s].
        qpos: Shape ``(N, nq)``: positions at each policy step.
    """

    fell_s: float | None
    error_m_s: float
    error_rad_s: float
    qpos: np.ndarray


class Twin:
    """A robot on C MuJoCo, stepped by ``advance`` from one policy step to the next.

    Observations and targets are delayed as in ``hidden``, rounded to physics steps.

    Args:
        seed: Seed of noise, pushes and ground.
        roughness_m: Difference between the lowest and the highest point of the ground [m]; 0: the model's floor.

    Attributes:
        sent: Last targets that were sent, ``(joints,)`` [rad].
        energy_j: Integral of the absolute power of all motors since the start [J].
    """

    def __init__(
        self, robot: ComposedRobot, hidden: HiddenTwin | None = None, seed: int = 0, roughness_m: float = 0.0
    ) -> None:
        self.robot, self.hidden = robot, hidden or HiddenTwin()
        self._rng = np.random.default_rng(seed)
        self._rough = robot.terrain.even(roughness_m, seed, _REACH_M) if roughness_m else None
        bumps_m = 0.0 if self._rough is None else float(self._rough.heights.max())
        how: dict[str, Any] = {"step_s": STEP_S, "settle_s": 0.0, "ground": self._rough}
        height_m = robot.height_m + bumps_m
        self.body = LeggedBody(robot.mjcf, robot.feet, robot.stance, height_m, self.hidden, **how)
        self.model, self.data, self.energy_j = self.body.model, self.body.data, 0.0
        self._drive(np.asarray(robot.stance))
        late = round(self.hidden.sensing_s / STEP_S)
        self._past = deque([self._measured()] * (late + 1), maxlen=late + 1)
        self._coming: deque[tuple[float, np.ndarray]] = deque()

    def read(self) -> BodyReading:
        """Return the measurement that has arrived, with noise."""
        reading, noise = self._past[0], {n: size for n, (size, _) in self.robot.noise.items()}
        exact = {n: np.asarray(getattr(reading, n)) for n in noise}
        return reading.replace(**{n: x + noise[n] * self._rng.normal(size=len(x)) for n, x in exact.items()})

    def send(self, goal: np.ndarray) -> None:
        """Send joint targets ``(joints,)`` [rad], which arrive later."""
        self.sent = np.asarray(goal, np.float64)
        self._coming.append((self.data.time + self.hidden.acting_s, self.sent))

    def advance(self, seconds: float) -> None:
        """Step the physics."""
        for _ in range(round(seconds / STEP_S)):
            while self._coming and self._coming[0][0] <= self.data.time + 1e-9:
                self._drive(self._coming.popleft()[1])
            self.body.step()
            self.energy_j += STEP_S * float(np.abs(self.data.actuator_force * self.data.qvel[6:]).sum())
            self._past.append(self._measured())

    def push(self, size_m_s: float) -> None:
        """Change the base's horizontal velocity by ``size_m_s`` in a random direction."""
        angle = self._rng.uniform(0.0, 2.0 * np.pi)
        self.data.qvel[:2] += size_m_s * np.array([np.cos(angle), np.sin(angle)])

    def fallen(self) -> bool:
        """Return whether the robot lies on its side, or its base on the ground."""
        ground_m = 0.0 if self._rough is None else float(self._rough.at(self.data.qpos[:2]))
        low = self.data.qpos[2] - ground_m < 0.4 * self.robot.height_m
        return bool(low or gravity_of(self.data.qpos[3:7])[2] > -0.5)

    def links(self, qpos: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return both ends ``(3,)`` of each link at positions ``(nq,)`` [m]."""
        data = _mj.MjData(self.model)
        data.qpos[:] = qpos
        _mj.mj_kinematics(self.model, data)
        base = int(self.model.jnt_bodyid[0])
        moved = [b for b in range(base + 1, self.model.nbody) if self.model.body_parentid[b] != 0]
        links = [(data.xpos[self.model.body_parentid[b]].copy(), data.xpos[b].copy()) for b in moved]
        sites = [self.model.site(name).id for name in self.robot.feet]
        return links + [(data.xpos[self.model.site_bodyid[s]].copy(), data.site_xpos[s].copy()) for s in sites]

    def _drive(self, goal: np.ndarray) -> None:
        self.sent, (kp, kd) = goal, self.robot.gains
        none = np.zeros_like(goal)
        self.body.drive(np.stack([goal, none, none + kp, none + kd, none], axis=1))

    def _measured(self) -> BodyReading:
        q, v = self.data.qpos, self.data.qvel
        return BodyReading(q[7:] + self.hidden.bias_rad, v[6:].copy(), q[3:7].copy(), v[3:6].copy())


def walk(
    twin: Twin,
    runner: Callable[[np.ndarray], np.ndarray],
    command: Callable[[float], np.ndarray],
    seconds: float,
    push_m_s: float = 0.0,
    shown: Callable[[Twin, float], None] | None = None,
) -> Walked:
    """Let a bundle's runner walk on a twin, in numpy, as the agent's node does.

    Args:
        command: Time -> commanded velocity ``(3,)``.
        push_m_s: Size of a push every 5 s [m/s].
        shown: Called after each policy step.
    """
    robot, period_s = twin.robot, 1.0 / twin.robot.drive.rate_hz
    steps = round(seconds * robot.drive.rate_hz)
    node: Any = robot.task.make_agent(robot.drive.rate_hz)
    node.aim = lambda step_state: np.asarray(command(step_state.seq * period_s), np.float32)
    params = in_numpy(node.init_params())
    state = in_numpy(node.init_state(None, GraphState(params={AGENT: params})))
    velocity, wanted, qpos = np.zeros((steps, 3)), np.zeros((steps, 3)), np.zeros((steps, twin.model.nq))
    changed_s, fell_s = 0.0, None
    settled = np.zeros(steps, bool)
    for i in range(steps):
        t_s = i * period_s
        heard: Any = {SENSOR: [SimpleNamespace(data=twin.read())]}
        step_state: Any = StepState(state=state, params=params, inputs=heard, seq=i)
        after, decision = node.act(step_state, np.asarray(runner(node.observe(step_state)), np.float32))
        state, wanted[i] = after.state, decision.aim
        twin.send(decision.command)
        twin.advance(period_s)
        # Judge by the true motion; the time after a new command or a push does not count.
        velocity[i, :2] = into_base(twin.data.qpos[3:7], twin.data.qvel[:3])[:2]
        velocity[i, 2] = twin.data.qvel[5]
        qpos[i] = twin.data.qpos
        if i and not np.array_equal(wanted[i], wanted[i - 1]):
            changed_s = t_s
        if push_m_s and (i + 1) % round(_PUSHED_S / period_s) == 0:
            twin.push(push_m_s)
            changed_s = t_s
        settled[i] = t_s - changed_s >= _SETTLED_S
        if shown is not None:
            shown(twin, t_s)
        if twin.fallen():
            fell_s, velocity, wanted, qpos, settled = t_s, velocity[:i], wanted[:i], qpos[:i], settled[:i]
            break
    window = np.ones(round(0.4 * robot.drive.rate_hz)) / round(0.4 * robot.drive.rate_hz)
    error = np.stack([np.convolve(velocity[:, k] - wanted[:, k], window, "same") for k in range(3)], axis=-1)
    error = error[settled] if settled.any() else np.full((1, 3), np.nan)  # the robot did not walk for long enough
    return Walked(fell_s, float(np.hypot(error[:, 0], error[:, 1]).mean()), float(np.abs(error[:, 2]).mean()), qpos)


# -- simulated episodes for comparison with a deployment


def twin_of(robot: ComposedRobot, values: Mapping[str, float], seed: int = 0) -> Twin:
    """Return the twin with parameters and delays by name; the policy's computation delay adds to the actuator's."""
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


def episode(robot: ComposedRobot, policy: Runner, values: Mapping[str, float], trial: int, duration_s: float) -> States:
    """Return a trial up to a fall, with parameters and delays by name."""
    twin, drawn, times, rows = twin_of(robot, values, trial), robot.commands.of_trial(trial), [], []

    def commanded(t_s: float) -> np.ndarray:
        return np.asarray(robot.commands.at(drawn, t_s))

    def shown(twin: Twin, t_s: float) -> None:
        told = {"aim": commanded(t_s), "command": twin.sent}
        columns = {f"{name}[{i}]": float(x) for name, values in told.items() for i, x in enumerate(values)}
        times.append(t_s + 1.0 / robot.drive.rate_hz)
        rows.append({**twin.body.state(), **columns})

    policy.reset()
    walk(twin, policy, commanded, duration_s, shown=shown)
    return np.array(times), {name: np.array([row[name] for row in rows]) for name in rows[0]}
