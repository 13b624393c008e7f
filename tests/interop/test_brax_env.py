"""A robot as a brax environment: actions, starts and ends of episodes under brax's own wrappers, and brax's own PPO."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("brax", reason="the extra interop")
from brax.envs.wrappers.training import wrap

from sim2real.interop import brax_env


@pytest.fixture(scope="module")
def played(pendulum):
    """Two episodes of two copies, under the wrappers with which brax's learners train."""
    env = brax_env(pendulum)
    wrapped = wrap(env, episode_length=env.max_episode_length)

    def run(keys):
        def step(state, _):
            state = wrapped.step(state, jnp.full((2, 1), 0.5))
            kept = {n: state.info[n] for n in ("truncation", "steps")}
            return state, {"obs": state.obs, "done": state.done, "reward": state.reward, **kept, **state.metrics}

        first = wrapped.reset(keys)
        return first.obs, jax.lax.scan(step, first, length=50)[1]

    first, rows = jax.jit(run)(jax.random.split(jax.random.PRNGKey(0), 2))  # brax knows no typed keys
    return env, np.asarray(first), jax.tree.map(np.asarray, rows)


def test_brax_sees_a_time_limit_as_a_truncation(played):
    _, first, rows = played
    assert [np.flatnonzero(rows["done"][:, i]).tolist() for i in range(2)] == [[23, 47]] * 2
    np.testing.assert_array_equal(rows["truncation"], rows["done"])
    assert np.isfinite(rows["reward"]).all()
    # Every episode starts somewhere else; metrics are those of the whole episode, where it ends.
    starts = np.concatenate([first, rows["obs"][23], rows["obs"][47]])
    assert len(np.unique(starts[:, :2], axis=0)) == 6
    np.testing.assert_allclose(rows["return"][23], rows["reward"][:24].sum(axis=0), rtol=1e-4)
    assert not rows["return"][:23].any()
    assert set(rows) >= {"success"}
    np.testing.assert_allclose(rows["obs"][5][:, 15], 1.0)  # actions span the bounds: half of 2 V


def test_past_the_time_limit_there_is_no_reward_to_learn_from(pendulum):
    env = brax_env(pendulum)

    @jax.jit
    def run(key):
        state = env.reset(key)
        state = state.replace(info={**state.info, "steps": jnp.float32(0)})  # as under brax's EpisodeWrapper
        play = lambda state, _: (new := env.step(state, jnp.zeros(1)), (new.reward, new.done))  # noqa: E731
        return jax.lax.scan(play, state, length=25)[1]

    reward, done = run(jax.random.PRNGKey(0))
    assert np.isnan(reward).tolist() == [False] * 24 + [True]
    assert not done.any()


@pytest.mark.night
def test_braxs_own_ppo_trains_on_it(pendulum, monkeypatch):
    from brax.training.agents.ppo import train as ppo

    # brax 0.14.2 calls it, and JAX 0.10 has it no more: see docs/guides/interop.md.
    replicated = lambda tree, devices: jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)  # noqa: E731
    monkeypatch.setattr(jax, "device_put_replicated", replicated, raising=False)
    env, curve = brax_env(pendulum), []
    ppo.train(
        environment=env,
        num_timesteps=256,
        episode_length=env.max_episode_length,
        num_envs=8,
        num_eval_envs=8,
        num_evals=2,
        unroll_length=4,
        batch_size=4,
        num_minibatches=2,
        normalize_observations=True,
        progress_fn=lambda steps, metrics: curve.append((steps, float(metrics["eval/episode_return"]))),
    )
    assert [steps > 0 for steps, _ in curve] == [False, True]
    assert np.isfinite([value for _, value in curve]).all()
