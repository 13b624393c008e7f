"""A robot as a gymnasium vector environment, and as one of Stable-Baselines3: spaces, seeds, ends, and refusals."""

import importlib.util
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="the extra interop")
from gymnasium.utils.env_checker import check_env  # noqa: E402

from sim2real.errors import Sim2RealError, UsageError  # noqa: E402
from sim2real.interop import baselines_env, robot_environment, vector_env  # noqa: E402
from sim2real.interop.baselines import to_baselines  # noqa: E402
from sim2real.policy.contract import observation_size  # noqa: E402
from sim2real.stages.load import load_robot  # noqa: E402

COPIES = 3


@pytest.fixture(scope="module")
def env(pendulum):
    return vector_env(pendulum, COPIES)


@pytest.fixture(scope="module")
def same_step(pendulum, env):
    made = vector_env(pendulum, COPIES, "SameStep")
    made._step, made._start, made._restart = env._step, env._start, env._restart  # compiled once
    return made


def actions_of(seed, steps, env):
    space = env.single_action_space
    return np.random.default_rng(seed).uniform(space.low, space.high, (steps, env.num_envs, *space.shape))


def play(env, seed, steps):
    """Reset, and step with random actions; return all that came."""
    rows = [(env.reset(seed=seed)[0], np.zeros(env.num_envs), *np.zeros((2, env.num_envs), bool), {})]
    rows += [env.step(a) for a in actions_of(0, steps, env)]
    return [list(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize("name", ["pendulum", "arm", "so101"])
def test_every_entry_has_a_name_a_unit_and_bounds(name):
    robot = robot_environment(name, "nominal")
    seen, done = robot.observation, robot.action
    assert len(seen) == observation_size(load_robot(name).task.observation)
    assert len({e.name for e in seen}) == len(seen)
    assert all(e.unit and math.isfinite(e.low) and e.low < e.high < math.inf for e in (*seen, *done))
    assert len(done) == {"pendulum": 1, "arm": 3, "so101": 6}[name]
    assert {e.unit for e in done} == {"V" if name == "pendulum" else "rad/s"}
    env = vector_env(robot, 2)  # compiles nothing
    assert env.single_observation_space.shape == (len(seen),)
    assert env.single_action_space.high.tolist() == pytest.approx([e.high for e in done])


def test_observations_stay_within_the_space(env):
    observations, rewards, *_ = play(env, 5, 30)
    assert all(env.observation_space.contains(o) for o in observations)
    assert rewards[1].dtype == np.float64
    assert (np.array(rewards)[1:25] < 0).all()


def test_a_seed_reproduces_episodes_and_each_copy_has_its_own(env):
    first, again, other = (play(env, seed, 30)[0] for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    starts = first[0]
    assert len(np.unique(starts, axis=0)) == COPIES
    np.testing.assert_array_equal(other[0][:-1], starts[1:])  # copy i has the seed + i
    assert (first[25] != first[0]).any(axis=1).all()  # another episode
    # A copy's episodes do not depend on the others, and without a seed the next reset goes on.
    np.testing.assert_array_equal(env.reset(seed=[4, 9, 1])[0][[1, 1, 0]], env.reset(seed=[9, 9, 4])[0])
    second = env.reset()[0]
    assert (second != env.reset(seed=[9, 9, 4])[0]).any(axis=1).all()
    np.testing.assert_array_equal(env.reset()[0], second)


def test_the_time_limit_truncates_and_the_next_step_starts_anew(env):
    observations, rewards, terminated, truncated, infos = play(env, 2, 26)
    assert np.array(truncated).all(axis=1).tolist() == [i == 24 for i in range(27)]
    assert not np.any(terminated)
    assert rewards[25].tolist() == [0.0] * COPIES  # the step that starts anew
    assert infos[24]["_success"].tolist() == [True] * COPIES
    np.testing.assert_allclose(infos[24]["return"], np.sum(rewards[:25], axis=0), rtol=1e-4)
    assert "success" not in infos[23]
    history = observations[25][:, 3:]
    assert not history.any(), "an episode's first observation has no history"


def test_in_the_same_step_the_final_observation_is_in_the_infos(env, same_step):
    late, _, _, _, told = play(env, 2, 25)
    seen, _, _, truncated, infos = play(same_step, 2, 25)
    np.testing.assert_array_equal(np.array(truncated)[:, 0].nonzero()[0], [24])
    np.testing.assert_array_equal(np.stack(infos[24]["final_obs"]), late[24])
    np.testing.assert_array_equal(seen[24], late[25])  # the same new episodes, a step earlier
    np.testing.assert_array_equal(infos[24]["final_info"]["return"], told[24]["return"])
    assert infos[24]["_final_obs"].all()
    assert "final_obs" not in infos[23]


def test_wrong_actions_seeds_and_modes_are_refused_in_words(env, pendulum):
    with pytest.raises(UsageError, match=r"step\(\) was called before reset\(\)"):
        vector_env(pendulum, 2).step(np.zeros((2, 1)))
    env.reset(seed=0)
    with pytest.raises(UsageError, match=r"actions have shape \(3,\), 3 copies need \(3, 1\)"):
        env.step(np.zeros(3))
    with pytest.raises(UsageError, match=r"actions of copies \[1\] are not finite"):
        env.step(np.array([[0.0], [np.nan], [1.0]]))
    with pytest.raises(UsageError, match="actions must be real numbers, got <U1"):
        env.step(np.full((3, 1), "a"))
    with pytest.raises(UsageError, match="2 seeds were given for 3 copies"):
        env.reset(seed=[1, 2])
    with pytest.raises(UsageError, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([True, False, False])})
    for mode in ("Never", "Disabled"):
        with pytest.raises(UsageError, match="NextStep, SameStep"):
            vector_env(pendulum, 2, mode)
    with pytest.raises(UsageError, match="num_envs must be at least 1"):
        vector_env(pendulum, 0)


class One(gymnasium.Env):
    """The first copy, for gymnasium's checker, which knows no vector environments."""

    def __init__(self, env):
        self.env, self.metadata, self.render_mode = env, env.metadata | {"render_fps": 50}, None
        self.observation_space, self.action_space = env.single_observation_space, env.single_action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        observation, _ = self.env.reset(seed=seed)
        return observation[0], {}

    def step(self, action):
        observation, reward, terminated, truncated, _ = self.env.step(np.stack([action] * COPIES))
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), {}


def test_gymnasium_s_checker_finds_nothing(env, recwarn):
    check_env(One(env), skip_render_check=True, skip_close_check=True)
    told = [str(w.message) for w in recwarn if "gymnasium" in w.filename or "gym" in str(w.message)]
    assert not [t for t in told if "symmetric and normalized" not in t], told  # actions are in volts


def test_without_it_the_error_says_what_to_install(pendulum, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    with pytest.raises(Sim2RealError, match="Stable-Baselines3 is not installed") as caught:
        baselines_env(pendulum, 2)
    assert "pip install stable-baselines3" in str(caught.value.hint)


def test_copies_that_start_anew_later_are_refused(pendulum, baselines):
    assert baselines_env(pendulum, 2, seed=1).num_envs == 2
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
def baselines(same_step):
    with pytest.MonkeyPatch.context() as patch:
        if importlib.util.find_spec("stable_baselines3") is None:
            patch.setitem(sys.modules, "stable_baselines3.common.vec_env", SimpleNamespace(VecEnv=VecEnv))
        yield to_baselines(same_step, seed=3)


def test_the_time_limit_is_told_with_the_last_observation(baselines):
    baselines.seed(3)
    first = baselines.reset()
    for step in range(1, 25):
        observation, reward, done, infos = baselines.step(np.ones((COPIES, 1), np.float32))
        assert done.tolist() == [step == 24] * COPIES
    assert reward.dtype == np.float32
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert {"success", "return", "terminal_observation"} <= infos[0].keys()
    assert not observation[:, 3:].any(), "already the first observation of the next episode"
    assert infos[0]["terminal_observation"][15] == 1.0
    baselines.seed(3)
    np.testing.assert_array_equal(baselines.reset(), first)
    assert baselines.get_attr("num_envs", [0, 2]) == [COPIES] * 2
    assert baselines.env_method("close", indices=1) == [None]
    with pytest.raises(UsageError, match="cannot be set"):
        baselines.set_attr("num_envs", 4)


def test_its_ppo_trains_on_it(baselines):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    wrapped = VecNormalize(VecMonitor(baselines))
    model = stable_baselines3.PPO("MlpPolicy", wrapped, n_steps=32, batch_size=48, n_epochs=1, device="cpu", seed=0)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(288)
    assert model.num_timesteps == 288
    assert len(model.ep_info_buffer) == COPIES * (288 // COPIES // 24)
    assert any((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
