"""The policy as a function, as a pytree, as arrays and as a bundle; its actions may be bounded by tanh."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.policy import ActionTerm, NetworkSpec, ObservationTerm, PolicyContract, load_bundle, save_bundle
from sim2real.training.config import PPOConfig
from sim2real.training.networks.architectures import MLP, init_mlp
from sim2real.training.networks.policy import Policy, entropy, log_prob, log_slope
from sim2real.training.ppo.losses import ActorCritic, Batch, loss


@pytest.fixture
def policy():
    rng = np.random.default_rng(0)
    return Policy(
        params=init_mlp(rng, (3, 16, 16, 2), 1.0),
        log_std=np.array([-1.0, 0.5], np.float32),
        mean=np.array([1.0, 0.0, -2.0], np.float32),
        std=np.array([0.5, 2.0, 10.0], np.float32),
        low=np.array([-2.0, 0.0], np.float32),
        high=np.array([2.0, 5.0], np.float32),
        network=MLP((16, 16, 2)),
    )


def test_kernels_are_orthogonal():
    (first, bias), (last, _) = init_mlp(np.random.default_rng(0), (64, 32, 3), 0.01)
    np.testing.assert_allclose(first.T @ first, 2.0 * np.eye(32), atol=1e-5)
    np.testing.assert_allclose(last.T @ last, 1e-4 * np.eye(3), atol=1e-8)
    assert not bias.any()


def test_densities_and_entropies_are_those_of_distrax():
    distrax = pytest.importorskip("distrax")
    u, mean, log_std = jnp.array([1.2, -2.3]), jnp.array([0.4, -1.0]), jnp.array([-0.7, 0.4])
    normal = distrax.MultivariateNormalDiag(mean, jnp.exp(log_std))
    np.testing.assert_allclose(log_prob(u, mean, log_std), normal.log_prob(u), rtol=1e-6)
    np.testing.assert_allclose(entropy(log_std), normal.entropy(), rtol=1e-6)
    squashed = distrax.Transformed(normal, distrax.Block(distrax.Tanh(), 1)).log_prob(jnp.tanh(u))
    np.testing.assert_allclose(log_prob(u, mean, log_std, squash=True), squashed, rtol=1e-4)
    # The slope of tanh is exact where float32 rounds tanh to 1.
    assert float(log_slope(np.array([20.0], np.float32))) == pytest.approx(2.0 * (np.log(2.0) - 20.0), rel=1e-6)


def test_actions_stay_within_the_bounds_and_reach_them(policy):
    observations = 100.0 * jax.random.normal(jax.random.key(0), (500, 3))
    actions = np.asarray(jax.vmap(policy.get_action)(observations))
    assert actions.shape == (500, 2)
    np.testing.assert_allclose(actions.min(0), policy.low)
    np.testing.assert_allclose(actions.max(0), policy.high)


def test_noise_comes_only_from_a_key(policy):
    observation = jnp.array([1.0, 0.0, -2.0])
    act = jax.jit(lambda policy, key: policy.get_action(observation, key))
    keys = jax.random.split(jax.random.key(0), 4000)
    noisy = np.asarray(jax.vmap(act, (None, 0))(policy, keys))
    still = np.asarray(policy.get_action(observation))
    np.testing.assert_array_equal(still, act(policy, None))
    inside = (noisy[:, 0] > -1.99) & (noisy[:, 0] < 1.99)
    # Half the range of the first action is 2, so its noise is 2 exp(-1), slightly less as the bounds cut its tails.
    assert inside.mean() > 0.95
    assert noisy[:, 0].std() == pytest.approx(2.0 * np.exp(-1.0), rel=0.1)
    assert noisy[:, 0].mean() == pytest.approx(still[0], abs=0.05)


def test_weights_make_the_same_policy(policy):
    again = Policy.from_weights(policy.to_weights())
    assert jax.tree.structure(again) == jax.tree.structure(policy)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(policy), strict=True):
        np.testing.assert_array_equal(a, b)


def test_weights_of_many_seeds_are_refused(policy):
    policies = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), policy)
    with pytest.raises(Sim2RealError, match=r"leading axes \(2,\)[\s\S]*hint: pick a seed"):
        policies.to_weights()
    assert policies[1].to_weights().keys() == policy.to_weights().keys()


def test_missing_weights_are_named(policy):
    weights = policy.to_weights()
    del weights["layers.1.bias"], weights["std"]
    with pytest.raises(Sim2RealError, match=r"lack layers\.1\.bias, std; available: .*layers\.0\.kernel"):
        Policy.from_weights(weights)


def test_the_entropy_is_that_of_the_actions():
    mean, log_std = jnp.array([0.4]), jnp.array([-0.7])
    noise = jax.random.normal(jax.random.key(0), (1, 20_000, 1))
    u, row = mean + jnp.exp(log_std) * noise, jnp.zeros((1, 20_000))
    layers = ((np.zeros((1, 1), np.float32), np.asarray(mean)),)
    params = {"actor": layers, "log_std": log_std, "value": layers}
    batch = Batch(row[..., None], None, u, row, row, row, row + 1.0, noise, row > 0, (), ())
    parts = loss(params, batch, PPOConfig(squash=True), ActorCritic(MLP((1,)), MLP((1,)), "mlp"))[1]
    monte_carlo = -jax.vmap(lambda u: log_prob(u, mean, log_std, squash=True))(u[0]).mean()
    assert float(parts["entropy"]) == pytest.approx(float(monte_carlo), abs=0.02)


CONTRACT = PolicyContract((ObservationTerm("x", ("1", "1")),), (ActionTerm("a", "1", -1.0, 3.0),), 50.0)


@pytest.mark.parametrize("backend", ["numpy", "onnx"])
def test_the_bundle_squashes_the_mean(backend, tmp_path):
    if backend == "onnx":
        pytest.importorskip("onnxruntime")
    one, layers = np.ones(1, np.float32), init_mlp(np.random.default_rng(0), (2, 8, 1), 3.0)
    policy = Policy(layers, 0 * one, np.zeros(2, np.float32), np.ones(2, np.float32), -one, 3 * one, MLP((8, 1)),
                    NetworkSpec(squash=True))  # fmt: skip
    runner = load_bundle(save_bundle(tmp_path, policy.to_weights(), CONTRACT, spec=policy.spec), backend)
    for x in np.random.default_rng(1).normal(size=(20, 2)).astype(np.float32):
        mean = policy.get_mean((), x)[1]
        np.testing.assert_allclose(runner.act(x), 1.0 + 2.0 * np.tanh(mean), atol=1e-5)
        np.testing.assert_allclose(policy.get_action(x), 1.0 + 2.0 * np.tanh(mean), atol=1e-5)

    about = json.loads((tmp_path / "policy.json").read_text())
    assert about["format_version"] == 2, "an older version would clip"
    del about["network"]
    (tmp_path / "policy.json").write_text(json.dumps(about))
    with pytest.raises(Sim2RealError, match=r"network is incomplete or wrong[\s\S]*hint: export"):
        load_bundle(tmp_path)
