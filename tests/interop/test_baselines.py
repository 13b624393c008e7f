"""A robot as an environment of Stable-Baselines3."""

import importlib.util
import sys
from types import SimpleNamespace

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


class VecEnv:
    """In the place of Stable-Baselines3's, where that is not installed: it brings PyTorch."""

    def __init__(self, num_envs, observation_space, action_space):
        self.num_envs, self.observation_space, self.action_space = num_envs, observation_space, action_space

    def step(self, actions):
        self.step_async(actions)
        return self.step_wait()


@pytest.fixture(scope="module")
def env(pendulum):
    with pytest.MonkeyPatch.context() as patch:
        if importlib.util.find_spec("stable_baselines3") is None:
            patch.setitem(sys.modules, "stable_baselines3.common.vec_env", SimpleNamespace(VecEnv=VecEnv))
        yield baselines_env(pendulum, 4, seed=3)


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
    assert env.get_attr("num_envs", [0, 2]) == [4, 4]
    assert env.env_method("close", indices=1) == [None]
    with pytest.raises(UsageError, match="cannot be set"):
        env.set_attr("num_envs", 3)


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
