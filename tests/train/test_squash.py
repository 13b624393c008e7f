"""Actions that are bounded by tanh."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.policy import ActionTerm, NetworkSpec, ObservationTerm, PolicyContract, load_bundle, save_bundle
from sim2real.training.config import PPOConfig
from sim2real.training.networks.architectures import MLP, init_mlp
from sim2real.training.networks.policy import Policy, log_prob, log_slope
from sim2real.training.ppo.losses import ActorCritic, Batch, loss

MEAN, LOG_STD = jnp.array([0.4]), jnp.array([-0.7])


def test_density_equals_that_of_distrax():
    distrax = pytest.importorskip("distrax")
    normal = distrax.MultivariateNormalDiag(jnp.array([0.4, -1.0]), jnp.array([0.5, 1.5]))
    reference = distrax.Transformed(normal, distrax.Block(distrax.Tanh(), 1))
    u = jnp.array([1.2, -2.3])
    found = log_prob(u, jnp.array([0.4, -1.0]), jnp.log(jnp.array([0.5, 1.5])), squash=True)
    np.testing.assert_allclose(found, reference.log_prob(jnp.tanh(u)), rtol=1e-4)


def test_the_slope_of_tanh_is_exact_where_float32_rounds_tanh_to_1():
    u = np.array([20.0], np.float32)
    assert float(log_slope(u)) == pytest.approx(2.0 * (np.log(2.0) - 20.0), rel=1e-6)


def test_the_entropy_is_that_of_the_actions():
    noise = jax.random.normal(jax.random.key(0), (1, 20_000, 1))
    u, row = MEAN + jnp.exp(LOG_STD) * noise, jnp.zeros((1, 20_000))
    layers = ((np.zeros((1, 1), np.float32), np.asarray(MEAN)),)
    params = {"actor": layers, "log_std": LOG_STD, "value": layers}
    batch = Batch(row[..., None], None, u, row, row, row, row + 1.0, noise, row > 0, (), ())
    parts = loss(params, batch, PPOConfig(squash=True), ActorCritic(MLP((1,)), MLP((1,)), "mlp"))[1]
    monte_carlo = -jax.vmap(lambda u: log_prob(u, MEAN, LOG_STD, squash=True))(u[0]).mean()
    assert float(parts["entropy"]) == pytest.approx(float(monte_carlo), abs=0.02)


@pytest.fixture(scope="module")
def policy():
    one = np.ones(1, np.float32)
    layers = init_mlp(np.random.default_rng(0), (2, 8, 1), 3.0)
    return Policy(layers, 0 * one, np.zeros(2, np.float32), np.ones(2, np.float32), -one, 3 * one, MLP((8, 1)),
                  NetworkSpec(squash=True))  # fmt: skip


CONTRACT = PolicyContract((ObservationTerm("x", ("1", "1")),), (ActionTerm("a", "1", -1.0, 3.0),), 50.0)


@pytest.mark.parametrize("backend", ["numpy", "onnx"])
def test_the_bundle_squashes_the_mean(policy, backend, tmp_path):
    if backend == "onnx":
        pytest.importorskip("onnxruntime")
    runner = load_bundle(save_bundle(tmp_path, policy.to_weights(), CONTRACT, spec=policy.spec), backend)
    for x in np.random.default_rng(1).normal(size=(20, 2)).astype(np.float32):
        mean = policy.get_mean((), x)[1]
        np.testing.assert_allclose(runner.act(x), 1.0 + 2.0 * np.tanh(mean), atol=1e-5)
        np.testing.assert_allclose(policy.get_action(x), 1.0 + 2.0 * np.tanh(mean), atol=1e-5)


def test_who_does_not_know_of_it_must_refuse_the_bundle(policy, tmp_path):
    """An older version would clip."""
    folder = save_bundle(tmp_path, policy.to_weights(), CONTRACT, spec=policy.spec)
    about = json.loads((folder / "policy.json").read_text())
    assert about["format_version"] == 2
    del about["network"]
    (folder / "policy.json").write_text(json.dumps(about))
    with pytest.raises(Sim2RealError, match=r"network is incomplete or wrong[\s\S]*hint: export"):
        load_bundle(folder)
