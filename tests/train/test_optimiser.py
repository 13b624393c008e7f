"""The step size: down a line, or as far as the policy moves; the gradient of a minibatch."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from sim2real.training.config import PPOConfig
from sim2real.training.networks.architectures import MLP
from sim2real.training.ppo.losses import ActorCritic, Batch, loss
from sim2real.training.ppo.update import MAX_RATE, MIN_RATE, adapt_rate, get_rate, make_optimiser, set_rate


@pytest.mark.parametrize(
    ("rate", "kl", "expected"),
    [
        (1e-3, 0.021, 1e-3 / 1.5),
        (1e-3, 0.02, 1e-3),
        (1e-3, 0.005, 1e-3),
        (1e-3, 0.0049, 1.5e-3),
        (1e-3, 0.0, 1e-3),
        (1.2e-5, 1.0, MIN_RATE),
        (9e-3, 1e-4, MAX_RATE),
    ],
)
def test_the_rate_moves_by_half_of_it_within_bounds(rate, kl, expected):
    assert adapt_rate(jnp.float32(rate), jnp.float32(kl), 0.01) == pytest.approx(expected)


def test_an_adaptive_step_is_adams_of_the_rate_in_its_state():
    config = PPOConfig(schedule="adaptive", learning_rate=1e-3, max_grad_norm=1e9)
    ours, params, gradient = make_optimiser(config), jnp.array([1.0, -2.0]), jnp.array([0.3, 0.1])
    state = set_rate(ours.init(params), jnp.float32(4e-3))
    assert get_rate(state) == pytest.approx(4e-3)
    adam = optax.adam(4e-3, eps=1e-5)
    expected = adam.update(gradient, adam.init(params))[0]
    np.testing.assert_allclose(ours.update(gradient, state)[0], expected, rtol=1e-4)


def test_the_parts_of_a_minibatch_have_its_gradient(monkeypatch):
    """A GPU computes the gradients of parts side by side: of 1,024 rows in four parts."""
    x, networks = jax.random.normal(jax.random.key(0), (8, 128, 3)), ActorCritic(MLP((16, 2)), MLP((16, 1)), "mlp")
    rng, row = np.random.default_rng(0), jnp.sin(x[..., 0])
    actor, value = (network.init(rng, 3, 1.0) for network in networks[:2])
    params = {"actor": actor, "log_std": jnp.zeros(2), "value": value}
    batch = Batch(x, None, x[..., :2], row, row, row, row**2, None, row > 2, (), ())
    gradient = jax.grad(lambda params: loss(params, batch, PPOConfig(), networks)[0])
    whole = gradient(params)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "f32[4,256,3]" in str(jax.make_jaxpr(gradient)(params))
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(gradient(params)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
