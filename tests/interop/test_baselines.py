"""A robot as an environment of Stable-Baselines3."""

import sys

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="the extra interop")

from sim2real.errors import Sim2RealError, UsageError
from sim2real.interop import baselines_env, vector_env
from sim2real.interop.baselines import to_baselines


def test_without_it_the_error_says_what_to_install(pendulum, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    with pytest.raises(Sim2RealError, match="Stable-Baselines3 is not installed") as caught:
        baselines_env(pendulum, 2)
    assert "pip install stable-baselines3" in str(caught.value.hint)


def test_copies_that_start_anew_later_are_refused(pendulum):
    with pytest.raises(UsageError, match="this environment's mode is 'NextStep'"):
        to_baselines(vector_env(pendulum, 2))


@pytest.fixture(scope="module")
def env(pendulum):
    pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3 (installs PyTorch)")
    return baselines_env(pendulum, 4, seed=3)


def test_the_time_limit_is_told_with_the_last_observation(env):
    env.seed(3)
    first = env.reset()
    for step in range(1, 25):
        observation, reward, done, infos = env.step(np.ones((4, 1), np.float32))
        assert done.tolist() == [step == 24] * 4
    assert reward.dtype == np.float32
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert {"success", "return", "terminal_observation"} <= infos[0].keys()
    assert not observation[:, 3:].any(), "already the first observation of the next episode"
    assert infos[0]["terminal_observation"][15] == 1.0
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), first)


def test_its_ppo_trains_on_it(env):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    wrapped = VecNormalize(VecMonitor(env))
    model = stable_baselines3.PPO("MlpPolicy", wrapped, n_steps=32, batch_size=64, n_epochs=1, device="cpu", seed=0)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(256)
    assert model.num_timesteps == 256
    assert len(model.ep_info_buffer) == 4 * (256 // 4 // 24)
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
