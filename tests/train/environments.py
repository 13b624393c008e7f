"""Small environments with known answers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.training.environment.protocol import Step, TrainingEnvironment


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


class Growing(Bandit):
    """Rewards with the share of the differences that the episode was started with."""

    curriculum = (0.2, 0.7)

    def reset(self, key, width=None):
        width = jnp.float32(self.curriculum[1]) if width is None else width
        state, observation = super().reset(key)
        return {**state, "width": width}, observation

    def step(self, state, action, key):
        made = super().step(state, action, key)
        return made._replace(reward=state["width"] + 0.0 * jnp.sum(action))


class Following(Growing):
    """Episodes are successful as long as they have less than half of the differences."""

    follow = 0.5

    def step(self, state, action, key):
        made = super().step(state, action, key)
        return made._replace(metrics={**made.metrics, "success": (state["width"] < 0.5).astype(jnp.float32)})
