"""Settings side by side in one program: each as if it were alone."""

import dataclasses

import jax
import numpy as np
import pytest
from environments import Bandit

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.ppo.trainer import swept_numbers, train
from sim2real.training.sweep import SWEPT, Sweep, format_point

CONFIG = PPOConfig(
    num_seeds=2, num_envs=16, minibatches=2, rollout_steps=4, total_steps=512, hidden=(4,), evaluations=2, eval_steps=3,
    epochs=2, entropy_coef=0.01, schedule="adaptive",
)  # fmt: skip
KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def swept():
    """Two settings, and all others as arguments of the program at the values that they have anyway."""
    values = {name: (getattr(CONFIG, name),) for name in SWEPT}
    return train(Bandit(), CONFIG, KEY, sweep=Sweep(values | {"learning_rate": (1e-3, 5e-3)}))


@pytest.mark.night
def test_each_is_as_if_it_were_alone_and_the_best_is_of_all(swept):
    for own, rate in ((slice(0, 2), 1e-3), (slice(2, 4), 5e-3)):
        alone = train(Bandit(), dataclasses.replace(CONFIG, learning_rate=rate), KEY)
        for name in ("return", "value_loss", "entropy", "kl"):
            np.testing.assert_allclose(swept.history[name][:, own], alone.history[name], rtol=2e-2, atol=1e-3)
        assert [member["learning_rate"] for member in swept.members[own]] == [rate, rate]
    assert not np.allclose(swept.history["entropy"][-1, :2], swept.history["entropy"][-1, 2:])
    assert swept.history["success"][:, swept.best_seed].max() == swept.history["success"].max()
    assert swept.best.log_std.shape == (2,)


def test_a_grid_is_named_in_its_order():
    sweep = Sweep.parse(["learning-rate=1e-3,3e-3", "ppo.gamma=0.9"])
    assert sweep.names(2)[1:3] == ["learning_rate=0.001, gamma=0.9, seed 1", "learning_rate=0.003, gamma=0.9, seed 0"]
    assert format_point(sweep.grid[1]) == "learning_rate=0.003, gamma=0.9"
    np.testing.assert_array_equal(swept_numbers(sweep, 2)["learning_rate"], np.float32([1e-3, 1e-3, 3e-3, 3e-3]))
    assert Sweep.parse([]).grid == [{}]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (
            ["hidden=3,4"],
            r"hidden cannot be swept: it sets the shape[\s\S]*hint: settings that can be swept: learning_rate",
        ),
        (["num_envs=64,128"], "num_envs cannot be swept"),
        (["gama=0.9"], "gama cannot be swept: it is no setting of PPO"),
        (["gamma"], "'gamma' is no list of different numbers"),
        (["gamma=a,b"], "'gamma=a,b' is no list of different numbers"),
        (["gamma=0.9,0.9"], "is no list of different numbers"),
        (["gamma=0.9", "gamma=0.8"], "is no list of different numbers for one setting"),
        (["gamma=0.9,1.9"], r"gamma must lie in \[0, 1\], got 1.9"),
        (["target_kl=0.1,0.2"], "target_kl has no effect with a linear step size"),
    ],
)
def test_what_cannot_be_swept_is_refused(texts, message):
    with pytest.raises(UsageError, match=message):
        Sweep.parse(texts).configs(PPOConfig())
