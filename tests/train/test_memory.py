"""A network that remembers, and what is shown once."""

import dataclasses

import jax
import numpy as np
import pytest
from environments import Sign
from flax import linen

from sim2real.errors import Sim2RealError, UsageError
from sim2real.policy import ActionTerm, ObservationTerm, PolicyContract, load_bundle, save_bundle
from sim2real.policy.contract import NetworkSpec
from sim2real.training.config import PPOConfig
from sim2real.training.networks.architectures import GRU, make_network
from sim2real.training.ppo.losses import unroll
from sim2real.training.ppo.trainer import train

CONFIG = PPOConfig(
    num_envs=64, minibatches=4, rollout_steps=16, total_steps=60_000, hidden=(16,), evaluations=1, eval_steps=20,
    gamma=0.5, reward_scale=1.0, learning_rate=1e-2,
)  # fmt: skip
CONTRACT = PolicyContract(
    (ObservationTerm("sign", ("1",)), ObservationTerm("shown", ("1",))), (ActionTerm("guess", "1", -2.0, 2.0),), 50.0
)


@pytest.fixture(scope="module")
def learnt():
    return train(Sign(), dataclasses.replace(CONFIG, network="gru"), jax.random.key(0))


@pytest.mark.night
def test_it_learns_what_a_perceptron_cannot(learnt):
    blind = train(Sign(), CONFIG, jax.random.key(0))
    assert learnt.history["success"][-1, 0] > 0.9
    assert blind.history["success"][-1, 0] < 0.6, "half of the signs can be guessed"


@pytest.mark.night
@pytest.mark.parametrize("backend", ["numpy", "onnx"])
def test_the_bundle_remembers_until_it_is_reset(learnt, backend, tmp_path):
    if backend == "onnx":
        pytest.importorskip("onnxruntime")
    policy = learnt.best
    runner = load_bundle(save_bundle(tmp_path, policy.to_weights(), CONTRACT, spec=policy.spec), backend)
    for sign in (1.0, -1.0):
        rows = np.array([[sign, 1.0], [0.0, 0.0], [0.0, 0.0]], np.float32)
        runner.reset()
        found = np.concatenate([runner.act(row) for row in rows])
        reference = jax.lax.scan(policy.step, policy.initial_carry(), rows)[1][:, 0]
        np.testing.assert_allclose(found, reference, atol=1e-5)
        np.testing.assert_allclose(found[1:], sign, atol=0.4)
    forgetful = [load_bundle(tmp_path, backend).act(row)[0] for row in rows]
    assert forgetful[1] != pytest.approx(found[1], abs=1e-3)


def test_its_equations_are_those_of_flax():
    unit, cell = GRU((5, 1)), linen.GRUCell(5)
    params = unit.init(np.random.default_rng(0), 3, 1.0)
    split = [np.split(params[name], 3, -1) for name in ("kernel", "recurrent", "bias")]
    theirs = {f"i{gate}": {"kernel": w, "bias": b} for gate, w, b in zip("rzn", split[0], split[2], strict=True)}
    theirs |= {f"h{gate}": {"kernel": u} for gate, u in zip("rz", split[1], strict=False)}
    theirs["hn"] = {"kernel": split[1][2], "bias": np.zeros(5)}
    carry, x = np.random.default_rng(1).normal(size=(2, 5)).astype(np.float32)
    expected, _ = cell.apply({"params": theirs}, carry, x[:3])
    np.testing.assert_allclose(unit.apply(params, carry, x[:3])[0], expected, atol=1e-6)


def test_a_sequence_begins_anew_after_an_end_and_waits_where_the_policy_does():
    """Row by row in Python against the scan."""
    rng = np.random.default_rng(0)
    network = GRU((4, 2))
    params, start = network.init(rng, 3, 1.0), network.initial_carry()
    x, after = rng.normal(size=(2, 6, 1, 3)).astype(np.float32)
    stepped, end = np.array([[1], [0], [1], [1], [1], [1]], bool), np.array([[0], [0], [1], [0], [1], [0]], bool)
    carried = rng.normal(size=(1, 4)).astype(np.float32)
    found = unroll(network, params, carried, x, stepped, end, after)
    carry = carried[0]
    for t in range(6):
        moved, y = network.apply(params, carry, x[t, 0])
        carry = moved if stepped[t, 0] else carry
        np.testing.assert_allclose(found.y[t, 0], y, atol=1e-6)
        np.testing.assert_allclose(found.following[t, 0], network.apply(params, carry, after[t, 0])[1], atol=1e-6)
        carry = start if end[t, 0] else carry
    np.testing.assert_allclose(found.carry[0], carry, atol=1e-6)


def test_what_describes_no_network_is_refused():
    with pytest.raises(UsageError, match=r"a GRU needs a width[\s\S]*hint: --ppo.hidden"):
        make_network("gru", (), 3, 1)
    assert NetworkSpec.from_dict({"name": "gru", "squash": True}) == NetworkSpec("gru", True)
    for about in (None, {"name": "mlp"}):
        with pytest.raises(Sim2RealError, match=r"network is incomplete or wrong[\s\S]*hint: "):
            NetworkSpec.from_dict(about)
