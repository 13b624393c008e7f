"""The task of a walking robot: follow commanded velocities."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState
from sim2real.robots.loop import AGENT, WORLD, Draw
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotTask
from sim2real.robots.walking.commands import Commands
from sim2real.robots.walking.messages import gravity_of, into_base
from sim2real.robots.walking.moment import Moment
from sim2real.types import Array, Key

_GAIT_S = 0.4
"""A step of the gait, over which a velocity is averaged [s]."""
Term = tuple[float, Callable[[Moment], jax.Array | float]]
"""A weight, and a measure of a moment."""


class WalkingTask(RobotTask):
    """Follow velocities, without a fall.

    Args:
        terms: Name -> weight and measure, whose product is a term of the reward.
        falls: Returns whether a robot has fallen, from height and gravity of a moment.
        close: Largest error of the mean velocity that counts as success [m/s, rad/s].
    """

    def __init__(
        self,
        commands: Commands,
        stance: np.ndarray,
        period_s: float,
        terms: Mapping[str, Term],
        falls: Callable[[Moment], jax.Array],
        close: float = 0.2,
    ) -> None:
        self._commands, self._stance, self._period_s = commands, np.asarray(stance, np.float32), period_s
        self._terms, self._falls, self._close = terms, falls, close

    def random(self, key: Key, draw: Draw) -> tuple[dict, EpisodeStart]:
        """Return parameters, and a start in the stance with random commands."""
        k_values, k_commands = jax.random.split(key)
        stance = jnp.asarray(self._stance)
        return draw(k_values), EpisodeStart(stance, jnp.zeros_like(stance), self._commands.draw(k_commands))

    def at_rest(self, trial: int) -> EpisodeStart:
        """Return the start in the stance with the commands of a trial."""
        return EpisodeStart(self._stance, np.zeros_like(self._stance), self._commands.of_trial(trial))

    def narrowed(self, start: EpisodeStart, share: Array) -> EpisodeStart:
        """Return a start whose commanded velocities are smaller by a share."""
        return start.replace(aim=share * start.aim)

    def judged(self, graph_state: GraphState) -> Moment:
        """Return the moment after a step, from the true state."""
        world, agent = graph_state.state[WORLD], graph_state.state[AGENT]
        data, v = world.data, world.variables
        t_s = (graph_state.step - 1) * self._period_s
        turn, feet = data.qpos[3:7], v["at_m"]
        moment = Moment(
            command=jnp.asarray(self._commands.at(graph_state.params[AGENT].aim, t_s)),
            linear=jnp.asarray(into_base(turn, data.qvel[:3])),
            angular=data.qvel[3:6],
            gravity=jnp.asarray(gravity_of(turn)),
            mean=v["mean"],
            height=data.qpos[2] - jnp.min(feet[:, 2]),
            offset=data.qpos[7:] - self._stance,
            torque=data.actuator_force,
            last=agent.last,
            before=agent.before,
            touches=v["air_s"] == 0.0,
            lands=(v["ground_s"] > 0.0) & (v["ground_s"] < self._period_s + 1e-4) & (v["swing_s"] > 0.0),
            swing_s=v["swing_s"],
            slip_m_s=v["slip_m_s"],
            falls=jnp.bool_(False),
        )
        return moment._replace(falls=self._falls(moment))

    def reward(self, state: Moment, action: jax.Array) -> dict[str, jax.Array]:
        """Return the terms."""
        del action
        return {name: jnp.float32(weight * measure(state)) for name, (weight, measure) in self._terms.items()}

    def success(self, state: Moment) -> jax.Array:
        """Return whether the mean velocity is near the commanded one."""
        return jnp.all(jnp.abs(state.mean - state.command) < self._close)

    def terminated(self, state: Moment) -> jax.Array:
        """Return whether the robot has fallen."""
        return state.falls

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return how well a deployment went: share of the time upright, largest tilt, and errors of the velocity.

        The errors are means over the time, of velocities that are averaged over a step of the gait. Encoders and IMU do
        not measure the linear velocity: its error needs the true states of an emulated robot.
        """
        turn = np.stack([states[f"quaternion[{i}]"] for i in range(4)], axis=-1)
        turn = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
        upright = 1.0 - 2.0 * (turn[:, 1] ** 2 + turn[:, 2] ** 2)
        # The commands change at policy steps, the states have times of their own.
        step = ((t_s - t_s[0]) / self._period_s + 1e-6).astype(int)
        off = []
        for name, aim in (("linear[0]", "aim[0]"), ("linear[1]", "aim[1]"), ("gyro[2]", "aim[2]")):
            wanted = states[aim][np.minimum(step, len(states[aim]) - 1)]
            window = max(1, round(_GAIT_S / max(float(np.median(np.diff(t_s))), 1e-3)))
            gap = states.get(name, np.full(len(t_s), np.nan)) - wanted
            off.append(np.convolve(gap, np.ones(window) / window, "valid"))
        return {
            "success": float((upright > 0.5).mean()),
            "tilt_rad": float(np.arccos(np.clip(upright, -1.0, 1.0)).max()),
            "velocity_error_m_s": float(np.hypot(off[0], off[1]).mean()),
            "yaw_error_rad_s": float(np.abs(off[2]).mean()),
        }
