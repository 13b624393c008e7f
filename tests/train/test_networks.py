"""The policy as a function, as a pytree and as arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.training.networks.architectures import MLP, init_mlp
from sim2real.training.networks.policy import Policy, entropy, log_prob


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


def test_density_is_that_of_independent_normals():
    distrax = pytest.importorskip("distrax")
    u, mean, log_std = jnp.array([0.3, -1.0]), jnp.array([0.0, 0.5]), jnp.array([-1.0, 0.5])
    reference = distrax.MultivariateNormalDiag(mean, jnp.exp(log_std))
    np.testing.assert_allclose(log_prob(u, mean, log_std), reference.log_prob(u), rtol=1e-6)
    np.testing.assert_allclose(entropy(log_std), reference.entropy(), rtol=1e-6)


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
