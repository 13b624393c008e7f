"""The policy: a network, the normaliser of its observations, and the distribution of its actions.

A policy is a pytree of arrays, so it can be a node's parameters and pass through jit, vmap and files. All functions
take one observation; use ``jax.vmap`` for more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from sim2real import pytree
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.base import Base
from sim2real.policy.contract import BUILT_IN, NetworkSpec
from sim2real.policy.runner import BESIDES, GRU_ARRAYS, OBSERVATION_CLIP, PARTS, gru_of, layers_of, require
from sim2real.training.networks.architectures import GRU, MLP, Factory, Network, is_recurrent, make_network, name_of
from sim2real.types import Array, PyTree


def log_prob(u: jax.Array, mean: jax.Array, log_std: jax.Array, squash: bool = False) -> jax.Array:
    """Return the log density, shape ``()``, of ``u (A,)`` under a normal distribution with a diagonal covariance.

    Written without distrax, whose import takes 1.7 s, a fifth of a training of the pendulum.

    Args:
        squash: Whether to return the density of ``tanh(u)``.
    """
    z = (u - mean) * jnp.exp(-log_std)
    density = -jnp.sum(0.5 * z**2 + log_std + 0.5 * math.log(2.0 * math.pi))
    return density - log_slope(u) if squash else density


def log_slope(u: jax.Array) -> jax.Array:
    """Return log |d tanh(u) / du|, shape ``(A,)``; accurate for large ``u``."""
    return jnp.sum(2.0 * (math.log(2.0) - u - jax.nn.softplus(-2.0 * u)))


def entropy(log_std: jax.Array) -> jax.Array:
    """Return the entropy [nat], shape ``()``, of a normal distribution with ``log_std (A,)``."""
    return jnp.sum(log_std + 0.5 * math.log(2.0 * math.pi * math.e))


@pytree.dataclass
class Policy(Base):
    """A Gaussian policy: normalises the observation, computes the mean by the network, bounds and scales it.

    By default the mean is clipped to [-1, 1]. Tasks such as a swing-up need full actions, which tanh reaches only for
    very large means, so that they train more slowly with it.

    Attributes:
        params: The network's parameters; for a perceptron, a pair ``(kernel (n_in, n_out), bias (n_out,))`` per layer.
        log_std: Shape ``(A,)``: logarithm of the exploration noise, in units of half the action range.
        mean: Shape ``(O,)``: the observation's mean.
        std: Shape ``(O,)``: the observation's standard deviation.
        low: Shape ``(A,)``: lower bound of the action.
        high: Shape ``(A,)``: upper bound of the action.
        spec: The description of the network in a bundle.
    """

    params: PyTree
    log_std: jax.Array
    mean: jax.Array
    std: jax.Array
    low: jax.Array
    high: jax.Array
    network: Network = pytree.field(pytree_node=False)
    spec: NetworkSpec = pytree.field(pytree_node=False, default=NetworkSpec())

    def initial_carry(self) -> PyTree:
        """Return the carry into an episode's first step; ``()`` if the network is stateless."""
        return self.network.initial_carry()

    def normalise(self, observation: jax.Array) -> jax.Array:
        """Return the network's input for ``observation``, both of shape ``(O,)``."""
        return jnp.clip((observation - self.mean) / self.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)

    def get_mean(self, carry: PyTree, observation: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the next carry, and the mean of the Gaussian, shape ``(A,)``, before it is bounded and scaled."""
        return self.network.apply(self.params, carry, self.normalise(observation))

    def bound(self, u: jax.Array) -> jax.Array:
        """Return ``u``, shape ``(A,)``, within [-1, 1]: clipped, or squashed by tanh."""
        return jnp.tanh(u) if self.spec.squash else jnp.clip(u, -1.0, 1.0)

    def to_action(self, u: jax.Array) -> jax.Array:
        """Bound ``u``, shape ``(A,)``, and scale it to [low, high]."""
        return self.low + 0.5 * (self.high - self.low) * (self.bound(u) + 1.0)

    def step(self, carry: PyTree, observation: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the next carry, and the action without exploration noise, shape ``(A,)``.

        Args:
            carry: Result of ``initial_carry`` at the episode's start, then of the previous step.
            observation: Shape ``(O,)``, in the units of the training.
        """
        carry, u = self.get_mean(carry, observation)
        return carry, self.to_action(u)

    def get_action(self, observation: jax.Array, rng: jax.Array | None = None) -> jax.Array:
        """Return the action, shape ``(A,)``, for an observation, shape ``(O,)``.

        Args:
            rng: JAX key of the exploration noise; None: no noise. A node of a graph may sample its action with it.

        Raises:
            UsageError: The policy has memory: its action depends on earlier observations.
        """
        if is_recurrent(self.network):
            raise UsageError(
                f"a policy of network {self.spec.name!r} has memory: its action depends on earlier observations",
                hint="call step(carry, observation), beginning each episode with initial_carry()",
            )
        _, u = self.get_mean(self.initial_carry(), observation)
        if rng is not None:
            u = u + jnp.exp(self.log_std) * jax.random.normal(rng, u.shape, u.dtype)
        return self.to_action(u)

    def to_weights(self) -> dict[str, np.ndarray]:
        """Return the arrays of a policy bundle: ``layers.<i>.kernel``, ``layers.<i>.bias``, ``log_std``, ...

        Raises:
            Sim2RealError: This is a batch of policies, whose leaves have a leading seed axis.
        """
        if np.ndim(self.log_std) != 1:
            raise Sim2RealError(
                f"one policy was expected, this one has leading axes {np.shape(self.log_std)[:-1]}",
                hint="pick a seed first: policies[0], or TrainResult.best",
            )
        weights = {name: getattr(self, name) for name in BESIDES} | _to_arrays(self.spec.name, self.params)
        return {name: np.asarray(value, np.float32) for name, value in weights.items()}

    @classmethod
    def from_weights(
        cls, weights: Mapping[str, np.ndarray], spec: NetworkSpec | None = None, factory: Factory | None = None
    ) -> Policy:
        """Return the policy from the arrays that ``to_weights`` returns.

        Args:
            spec: Default: a perceptron whose mean is clipped.
            factory: Makes a user's network; default: the class that ``spec`` names.

        Raises:
            Sim2RealError: An array is missing or of another shape.
            UsageError: The network cannot be imported.
        """
        spec = spec or NetworkSpec()
        arrays = {name: jnp.asarray(value, jnp.float32) for name, value in weights.items()}
        network, params = _from_arrays(spec.name if factory is None else factory, arrays)
        return cls(params=params, **{name: arrays[name] for name in BESIDES}, network=network, spec=spec)


def _to_arrays(name: str, params: PyTree) -> dict[str, Array]:
    """Return the parameters of a network by name."""
    if name not in BUILT_IN:
        return dict(_named(params))
    layers = params if name == "mlp" else params["layers"]
    arrays = {} if name == "mlp" else {f"gru.{part}": params[part] for part in GRU_ARRAYS}
    return arrays | {f"layers.{i}.{p}": a for i, ab in enumerate(layers) for p, a in zip(PARTS, ab, strict=True)}


def _from_arrays(kind: str | Factory, arrays: Mapping[str, jax.Array]) -> tuple[Network, PyTree]:
    """Return a network and its parameters; the inverse of ``_to_arrays``."""
    # For networks of this package, take the widths from the arrays.
    if kind in BUILT_IN:
        layers = tuple(layers_of(arrays))
        widths = tuple(bias.shape[0] for _, bias in layers)
        if kind == "mlp":
            return MLP(widths), layers
        gru = gru_of(arrays)
        return GRU((gru["recurrent"].shape[0], *widths)), {**gru, "layers": layers}
    # Make a user's network again, and compare its parameters with the arrays.
    require(arrays, BESIDES)
    inputs, outputs = arrays["mean"].size, arrays["log_std"].size
    network = make_network(kind, (), inputs, outputs, exported=False)
    example = network.init(np.random.default_rng(0), inputs, 1.0)
    named = _named(example)
    require(arrays, [name for name, _ in named])
    for name, leaf in named:
        if leaf.shape != arrays[name].shape:
            raise Sim2RealError(
                f"the policy's {name} has shape {arrays[name].shape}, that of {name_of(kind)} has {leaf.shape}",
                hint="the code of the network has changed since the training: return to the code of the training",
            )
    return network, jax.tree.unflatten(jax.tree.structure(example), [arrays[name] for name, _ in named])


def _named(params: PyTree) -> list[tuple[str, Array]]:
    """Return the arrays of a user's network with their paths as names."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return [(f"network.{jax.tree_util.keystr(path, simple=True, separator='.')}", leaf) for path, leaf in leaves]


@pytree.dataclass
class BlendedPolicy(Base):
    """A policy whose action grows linearly from 0 to the policy's: ``BlendedRunner`` in a compiled graph.

    Attributes:
        steps: Number of steps, above 0, until the action is the policy's.
    """

    policy: Policy
    steps: float

    def initial_carry(self) -> PyTree:
        """Return the carry into an episode's first step: the number of the step, and the policy's carry."""
        return jnp.float32(0.0), self.policy.initial_carry()

    def step(self, carry: PyTree, observation: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the next carry, and a share of the policy's action, shape ``(A,)``."""
        number, inside = carry
        inside, action = self.policy.step(inside, observation)
        return (number + 1.0, inside), action * jnp.minimum(1.0, number / self.steps)
