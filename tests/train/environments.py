"""Small environments with known answers, and the pendulum that the defaults of PPO were tuned on."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sim2real.training.environment.protocol import Step, TrainingEnvironment


@struct.dataclass
class PendulumState:
    x: Any  # (2,): angle from upright [rad], angular velocity [rad/s]
    command: Any  # (1,): sent, not yet acting [V]
    measured: Any  # (2,): taken, not yet arrived
    observations: Any  # (4, 3)
    actions: Any  # (4, 1)
    upright: Any
    row: Any


def _ode(x, u):
    J, m, length, b, K, R, c = 1.59931e-4, 0.0508582, 0.0415234, 1.43298e-5, 0.0333391, 7.73125, 9.75041e-4
    th, thd = x
    torque = u * K / R + m * 9.81 * length * jnp.sin(th) - b * thd - thd * K * K / R - c * jnp.sign(thd)
    return jnp.stack([thd, torque / J])


def _physics(x, u, dt=0.02, substeps=2):
    h = dt / substeps
    for _ in range(substeps):
        k1 = _ode(x, u)
        k2 = _ode(x + k1 * h / 2, u)
        k3 = _ode(x + k2 * h / 2, u)
        k4 = _ode(x + k3 * h, u)
        x = x + (k1 + 2 * k2 + 2 * k3 + k4) * h / 6
        x = x.at[1].set(jnp.clip(x[1], -40, 40))
    return x


class Pendulum(TrainingEnvironment):
    """Swing-up at 50 Hz for 5 s; a command acts one step late and a measurement arrives one step late."""

    observation_size = 19
    action_low = np.array([-2.0], np.float32)
    action_high = np.array([2.0], np.float32)
    rows = 250

    def reset(self, key):
        th, thd = jax.random.uniform(key, (2,), minval=-1.0) * jnp.array([jnp.pi, 0.0])
        x = jnp.stack([th, thd])
        state = PendulumState(x, jnp.zeros(1), x, jnp.zeros((4, 3)), jnp.zeros((4, 1)), jnp.float32(0), jnp.int32(0))
        return state, self._observe(state)

    def _observe(self, state):
        th, thd = state.measured
        now = jnp.stack([jnp.cos(th), jnp.sin(th), thd])
        return jnp.concatenate([now, state.observations.ravel(), state.actions.ravel()])

    def step(self, state, action, key):
        x = _physics(state.x, state.command[0])
        n = x[0] - 2 * jnp.pi * jnp.floor((x[0] + jnp.pi) / (2 * jnp.pi))
        cost = n**2 + 0.1 * (x[1] / (1 + 10 * jnp.abs(n))) ** 2 + 0.01 * state.command[0] ** 2
        upright = state.upright + jnp.where((jnp.cos(n) > 0.95) & (jnp.abs(x[1]) < 0.5), 1.0, 0.0)
        seen = self._observe(state)[:3]
        new = PendulumState(
            x=x,
            command=action,
            measured=state.x,
            observations=jnp.concatenate([seen[None], state.observations[:-1]]),
            actions=jnp.concatenate([action[None], state.actions[:-1]]),
            upright=upright,
            row=state.row + 1,
        )
        end = new.row >= self.rows
        metrics = {"success": upright / self.rows}
        return Step(new, self._observe(new), -cost, jnp.bool_(False), end, jnp.bool_(True), metrics)


class Bandit(TrainingEnvironment):
    """One row, one decision: the reward is highest at the action that the observation asks for."""

    observation_size = 2
    action_low = np.array([-1.0, 0.0], np.float32)
    action_high = np.array([3.0, 10.0], np.float32)

    def reset(self, key):
        observation = jax.random.uniform(key, (2,), minval=-1.0)
        return {"wanted": observation, "key": key}, observation

    def best(self, observation):
        return jnp.stack([1.0 + observation[0], 5.0 - 2.0 * observation[1]])

    def step(self, state, action, key):
        error = (action - self.best(state["wanted"])) / jnp.array([1.0, 2.5])
        yes = jnp.bool_(True)
        metrics = {"success": jnp.where(jnp.max(jnp.abs(error)) < 0.3, 1.0, 0.0)}
        return Step(state, state["wanted"], -jnp.sum(error**2), yes, ~yes, yes, metrics)


class Coin(TrainingEnvironment):
    """Each row's reward is a coin, tossed at the start, which the policy does not see."""

    observation_size = 1
    action_low = np.array([-1.0], np.float32)
    action_high = np.array([1.0], np.float32)

    def reset(self, key):
        return {"coin": jnp.sign(jax.random.uniform(key, minval=-1.0)), "row": jnp.int32(0)}, jnp.zeros(1)

    def step(self, state, action, key):
        new = {**state, "row": state["row"] + 1}
        no = jnp.bool_(False)
        return Step(new, jnp.zeros(1), state["coin"], no, new["row"] >= 8, ~no, {})

    def privileged(self, state):
        return 1e-4 * jnp.stack([3.0 + state["coin"], 7.0])


class Constant(TrainingEnvironment):
    """Reward 1 per policy step, spread over ``rows_per_step`` rows; ends after ``length`` policy steps."""

    observation_size = 1
    action_low = np.array([-1.0], np.float32)
    action_high = np.array([1.0], np.float32)

    def __init__(self, length=8, ends="truncated", rows_per_step=1, nan_at=None, wrong=None):
        self.length, self.ends, self.rows_per_step = length, ends, rows_per_step
        self.nan_at, self.wrong = nan_at, wrong

    def reset(self, key):
        return {"row": jnp.int32(0), "acted": jnp.float32(0)}, jnp.zeros(1)

    def step(self, state, action, key):
        row = state["row"] + 1
        valid = state["row"] % self.rows_per_step == 0
        end = row >= self.length * self.rows_per_step
        no = jnp.bool_(False)
        bad = jnp.where(row == self.nan_at, jnp.nan, 0.0) if self.nan_at else 0.0
        observation = jnp.zeros(1) + (bad if self.wrong == "observation" else 0.0)
        reward = 1.0 / self.rows_per_step + (bad if self.wrong == "reward" else 0.0)
        acted = state["acted"] + jnp.where(valid, 1.0, 0.0)
        return Step(
            {"row": row, "acted": acted},
            observation,
            jnp.float32(reward),
            end if self.ends == "terminated" else no,
            end if self.ends == "truncated" else no,
            valid,
            {"policy_steps": acted},
        )


class Counter(Constant):
    """Observes the start's number plus the rows since then."""

    def reset(self, key):
        start = jnp.floor(1000.0 * jax.random.uniform(key)) * 100.0
        return {"start": start, "row": jnp.int32(0)}, start[None]

    def step(self, state, action, key):
        row = state["row"] + 1
        seen = state["start"] + row
        yes = jnp.bool_(True)
        return Step(
            {**state, "row": row}, seen[None], jnp.float32(2), row >= self.length, ~yes, yes, {"rows": row * 1.0}
        )


class Sign(TrainingEnvironment):
    """A sign is shown at the first of six rows; to be said again in all the others."""

    observation_size = 2
    action_low = np.array([-2.0], np.float32)
    action_high = np.array([2.0], np.float32)

    def reset(self, key):
        sign = jnp.sign(jax.random.uniform(key, minval=-1.0))
        return {"sign": sign, "row": jnp.int32(0), "said": jnp.float32(0)}, jnp.stack([sign, 1.0])

    def step(self, state, action, key):
        error = (action[0] - state["sign"]) ** 2
        late = state["row"] > 0
        said = state["said"] + jnp.where(late & (action[0] * state["sign"] > 0.5), 0.2, 0.0)
        new = {**state, "row": state["row"] + 1, "said": said}
        no = jnp.bool_(False)
        return Step(new, jnp.zeros(2), jnp.where(late, -error, 0.0), no, new["row"] >= 6, ~no, {"success": said})
