"""The policy and its networks.

A policy is a pytree of arrays, so it can be a node's parameters and pass through jit, vmap and files. Networks are
plain functions over tuples of arrays, as a multilayer perceptron needs no module system. All functions take one
observation; use ``jax.vmap`` for more.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sim2real.errors import Sim2RealError
from sim2real.graph.base import Base
from sim2real.policy.runner import OBSERVATION_CLIP, layers_of

Layers = tuple[tuple[jax.Array, jax.Array], ...]


def init_mlp(rng: np.random.Generator, sizes: tuple[int, ...], last_gain: float) -> Layers:
    """Draw orthogonal kernels (gain sqrt(2), in the last layer ``last_gain``) and zero biases.

    In numpy, as compiling a QR decomposition that runs once takes longer.

    Args:
        rng: Source of the kernels.
        sizes: Widths of the input, of each hidden layer and of the output.
        last_gain: Gain of the last layer.

    Returns:
        One pair ``(kernel (n_in, n_out), bias (n_out,))`` per layer, float32.
    """
    gains = [np.sqrt(2.0)] * (len(sizes) - 2) + [last_gain]
    layers = []
    for n_in, n_out, gain in zip(sizes[:-1], sizes[1:], gains, strict=True):
        q, r = np.linalg.qr(rng.normal(size=(max(n_in, n_out), min(n_in, n_out))))
        q = q * np.sign(np.diagonal(r))  # QR's choice of signs would make the distribution non-uniform
        kernel = gain * (q if n_in >= n_out else q.T)
        layers.append((kernel.astype(np.float32), np.zeros(n_out, np.float32)))
    return tuple(layers)


def apply_mlp(layers: Layers, x: jax.Array) -> jax.Array:
    """Return the output ``(n_out,)`` of tanh layers and a linear last layer for an input ``x (n_in,)``."""
    for kernel, bias in layers[:-1]:
        x = jnp.tanh(x @ kernel + bias)
    kernel, bias = layers[-1]
    return x @ kernel + bias


def log_prob(u: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Return the log density of ``u`` under a normal distribution with a diagonal covariance.

    Written out: importing distrax takes 1.7 s, a fifth of a training of the pendulum, which compiles and runs as fast
    with it.

    Args:
        u: Shape ``(A,)``.
        mean: Shape ``(A,)``.
        log_std: Shape ``(A,)``: logarithms of the standard deviations.

    Returns:
        Shape ``()``.
    """
    z = (u - mean) * jnp.exp(-log_std)
    return -jnp.sum(0.5 * z**2 + log_std + 0.5 * math.log(2.0 * math.pi))


def entropy(log_std: jax.Array) -> jax.Array:
    """Return the entropy [nat], shape ``()``, of a normal distribution with ``log_std (A,)``."""
    return jnp.sum(log_std + 0.5 * math.log(2.0 * math.pi * math.e))


@struct.dataclass
class Policy(Base):
    """A Gaussian policy: the observation is normalised, tanh layers give the mean, which is clipped and scaled.

    The mean is clipped to [-1, 1], not squashed by tanh: tasks such as a swing-up need full actions, which tanh reaches
    only for very large means, and train more slowly with it.

    Attributes:
        layers: One pair ``(kernel (n_in, n_out), bias (n_out,))`` per layer.
        log_std: Shape ``(A,)``: logarithm of the exploration noise, in units of half the action range.
        mean: Shape ``(O,)``: the observation's mean.
        std: Shape ``(O,)``: the observation's standard deviation.
        low: Shape ``(A,)``: lower bound of the action.
        high: Shape ``(A,)``: upper bound of the action.
    """

    layers: Layers
    log_std: jax.Array
    mean: jax.Array
    std: jax.Array
    low: jax.Array
    high: jax.Array

    def normalise(self, observation: jax.Array) -> jax.Array:
        """Return the network's input for ``observation``, both of shape ``(O,)``."""
        return jnp.clip((observation - self.mean) / self.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)

    def get_mean(self, observation: jax.Array) -> jax.Array:
        """Return the mean of the Gaussian, shape ``(A,)``, before clipping and scaling."""
        return apply_mlp(self.layers, self.normalise(observation))

    def to_action(self, u: jax.Array) -> jax.Array:
        """Clip ``u``, shape ``(A,)``, to [-1, 1] and scale it to [low, high]."""
        return self.low + 0.5 * (self.high - self.low) * (jnp.clip(u, -1.0, 1.0) + 1.0)

    def get_action(self, observation: jax.Array, rng: jax.Array | None = None) -> jax.Array:
        """Return the action, shape ``(A,)``, for an observation, shape ``(O,)``.

        Args:
            observation: In the units that the policy was trained with.
            rng: JAX key of the exploration noise; None: no noise.
        """
        u = self.get_mean(observation)
        if rng is not None:
            u = u + jnp.exp(self.log_std) * jax.random.normal(rng, u.shape, u.dtype)
        return self.to_action(u)

    def to_weights(self) -> dict[str, np.ndarray]:
        """Return the arrays of a policy bundle: ``layers.<i>.kernel``, ``layers.<i>.bias``, ``log_std``, ...

        Raises:
            Sim2RealError: This is a batch of policies: its leaves have a leading seed axis.
        """
        if np.ndim(self.log_std) != 1:
            raise Sim2RealError(
                f"one policy was expected, this one has leading axes {np.shape(self.log_std)[:-1]}",
                hint="pick a seed first: policies[0], or TrainResult.best",
            )
        weights = {name: getattr(self, name) for name in ("log_std", "mean", "std", "low", "high")}
        for i, (kernel, bias) in enumerate(self.layers):
            weights |= {f"layers.{i}.kernel": kernel, f"layers.{i}.bias": bias}
        return {name: np.asarray(value, np.float32) for name, value in weights.items()}

    @classmethod
    def from_weights(cls, weights: dict[str, np.ndarray]) -> Policy:
        """Return the policy from the arrays that ``to_weights`` returns.

        Raises:
            Sim2RealError: An array is missing.
        """
        arrays = {name: jnp.asarray(value, jnp.float32) for name, value in weights.items()}
        layers = tuple(layers_of(arrays))
        rest = ("log_std", "mean", "std", "low", "high")
        return cls(layers=layers, **{name: arrays[name] for name in rest})
