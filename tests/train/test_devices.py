"""Seeds and copies divided among eight devices: the same training, within float error."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.scale.devices import mesh_of

SCRIPT = """
import dataclasses, json, re
import jax
import numpy as np
from environments import Bandit
from sim2real.training.config import PPOConfig
from sim2real.training.ppo import trainer
from sim2real.training.sweep import Sweep

divided, shardings_of = [], trainer.shardings_of
def seen(state, config):
    divided.append(shardings_of(state, config))
    return divided[-1]
trainer.shardings_of = seen

config = PPOConfig(
    num_seeds=2, num_envs=32, minibatches=4, rollout_steps=4, total_steps=512, hidden=(8,), evaluations=2, eval_steps=2,
)
found = {}
for devices in (1, 8):
    sweep = Sweep({"learning_rate": (1e-3, 3e-3)})
    result = trainer.train(Bandit(), dataclasses.replace(config, devices=devices), jax.random.key(3), sweep=sweep)
    leaves = jax.tree.leaves(jax.device_get(result.policies))
    found[devices] = [np.ravel(leaf).tolist() for leaf in [*leaves, *result.history.values()]]

found["mesh"] = dict(divided[-1].whole.mesh.shape)
from sim2real.training.scale.devices import place
from sim2real.training.ppo.trainer import _train_until_evaluation
from sim2real.training.ppo.trainer import make_networks, make_initial_state

config = dataclasses.replace(config, num_seeds=1, num_envs=48, rollout_steps=5, hidden=(7,), devices=2)
networks = make_networks(Bandit(), config)
state = make_initial_state(Bandit(), [config], jax.random.key(0), networks)
program = jax.jit(jax.vmap(lambda state: _train_until_evaluation(Bandit(), config, networks, state)))
text = program.lower(place(state, shardings_of(state, config))).compile().as_text()
found["rows"] = sorted(map(int, set(re.findall(r"= f32\\[(\\d+),7\\]\\S* dot\\(", text))))
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found():
    """What one device learns, and eight; and of how many rows each of two computes networks."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parents[1]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=300, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.night
def test_eight_devices_learn_what_one_learns(found):
    assert len(found["1"]) > 10
    assert found["mesh"] == {"seeds": 4, "copies": 2}, "two seeds, each with two settings"
    for one, eight in zip(found["1"], found["8"], strict=True):
        np.testing.assert_allclose(eight, one, rtol=1e-3, atol=1e-4)
    whole = 48 // 4 * 5
    assert whole // 2 in found["rows"], "each device computes its part of a minibatch"
    assert whole not in found["rows"]


def test_devices_that_are_not_there_or_cannot_divide_the_copies_are_refused(monkeypatch):
    with pytest.raises(UsageError, match="devices=64, but JAX finds 1 on this host"):
        mesh_of(PPOConfig(devices=64))
    monkeypatch.setattr("jax.local_devices", lambda: [SimpleNamespace(device_kind="cpu")] * 8)
    with pytest.raises(UsageError, match="8 devices cannot divide 2 seeds of 6 copies: 4 devices for each seed"):
        mesh_of(PPOConfig(devices=8, num_seeds=2, num_envs=6, minibatches=2))
