"""A training that was interrupted and went on is the one that was not."""

import dataclasses

import jax
import numpy as np
import pytest
from environments import Bandit, Constant, Following, Growing, Sign

from sim2real.errors import Sim2RealError, UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.ppo.checkpoint import TrainingIdentity, load_checkpoint
from sim2real.training.ppo.trainer import train

CONFIG = PPOConfig(
    num_seeds=2, num_envs=8, minibatches=2, rollout_steps=4, total_steps=256, hidden=(4,), evaluations=4, eval_steps=3,
    epochs=1,
)  # fmt: skip
KEY = jax.random.key(3)


def interrupted(path, after, env, config):
    def stop(progress):
        if progress.evaluation == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(env, config, KEY, stop, checkpoint=path)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    interrupted(path, 2, Bandit(), CONFIG)
    return path


@pytest.mark.night
@pytest.mark.parametrize(
    ("env", "change"),
    [(Bandit(), {}), (Sign(), {"network": "gru", "eval_steps": 8}), (Growing(), {}), (Following(), {})],
    ids=["bandit", "memory in the middle of episodes", "differences that grow", "differences that follow success"],
)
def test_what_is_resumed_ends_as_if_it_had_never_been_interrupted(env, change, tmp_path):
    config, seen = dataclasses.replace(CONFIG, **change), []
    whole = train(env, config, KEY)
    interrupted(tmp_path / "first", 2, env, config)
    found = train(env, config, KEY, seen.append, checkpoint=tmp_path / "next", resume=tmp_path / "first")
    assert [progress.evaluation for progress in seen] == [1, 2, 3, 4]
    jax.tree.map(np.testing.assert_array_equal, (found.policies, found.best), (whole.policies, whole.best))
    assert found.history.keys() == whole.history.keys()
    for name, values in whole.history.items():
        np.testing.assert_array_equal(found.history[name], values)
    assert found.best_seed == whole.best_seed
    assert found.env_steps.tolist() == whole.env_steps.tolist()
    assert (np.diff(found.elapsed_s) > 0).all()
    again = train(env, config, KEY, resume=tmp_path / "next")
    np.testing.assert_array_equal(again.best.log_std, whole.best.log_std)


@pytest.mark.night
def test_the_target_alone_may_be_another(saved):
    found = train(Bandit(), dataclasses.replace(CONFIG, target=1e-9), KEY, resume=saved)
    assert len(found.env_steps) in (2, 3, 4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"config": dataclasses.replace(CONFIG, gamma=0.5)}, "other settings: gamma = 0.99 there and 0.5 here"),
        ({"key": jax.random.key(4)}, "a training with another seed"),
        ({"env": Constant(length=3)}, "of another program"),
    ],
)
def test_another_training_is_refused(saved, change, message):
    asked = {"env": Bandit(), "config": CONFIG, "key": KEY} | change
    with pytest.raises(UsageError, match=rf"{message}[\s\S]*hint: "):
        train(**asked, resume=saved)


def test_any_damage_is_noticed_before_training_goes_on(saved, tmp_path):
    """A flipped bit of a weight, above all: the format of the file has no check of its own."""
    whole, rng, file = saved.read_bytes(), np.random.default_rng(0), tmp_path / "bent"
    begin = 8 + int.from_bytes(whole[:8], "little")
    identity = TrainingIdentity({}, [], "")
    for i in range(60):
        bent = bytearray(whole)
        if i % 3:
            low, high = ((0, begin), (begin, len(whole)))[i % 3 - 1]
            bent[rng.integers(low, high)] ^= int(rng.integers(1, 256))
        else:
            del bent[rng.integers(len(whole)) :]
        file.write_bytes(bent)
        with pytest.raises(Sim2RealError, match=r"cannot continue from .*bent[\s\S]*hint: train again"):
            load_checkpoint(file, identity, None, None)
    with pytest.raises(Sim2RealError, match=r"cannot continue from .*missing[\s\S]*hint: train again"):
        load_checkpoint(tmp_path / "missing", identity, None, None)
