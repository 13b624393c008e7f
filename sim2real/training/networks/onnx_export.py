"""Export of a policy with a user's network to ONNX: a robot runs it without JAX and without the network's code."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.policy.bundle import check_parity, draw_samples
from sim2real.policy.onnx_graph import make_model
from sim2real.policy.runner import OnnxBackend
from sim2real.training.networks.jaxpr_onnx import Translation, trace
from sim2real.training.networks.policy import Policy

PARITY = 1e-4
"""Largest accepted difference between ONNX and JAX, as a fraction of the actions' range. A layer's norm amplifies
the last bits of inputs that hardly differ: 1.1e-5 behind a GroupNorm of clipped values."""


def export_graph(policy: Policy) -> bytes | None:
    """Return the policy as a serialised ONNX model; None for networks that a bundle runs without one.

    If onnxruntime is installed, the model is compared with JAX on observations as in one episode.

    Raises:
        UsageError: The network has a primitive that is not exported.
        Sim2RealError: JAX and ONNX give different actions.
    """
    if policy.spec.built_in:
        return None
    # Trace one step of a batch of 1; the leaves of the carry are inputs and outputs of the model.
    first, tree = jax.tree.flatten(policy.initial_carry())
    sizes = policy.mean.size, policy.low.size

    def step(observation: jax.Array, *carry: jax.Array) -> list[jax.Array]:
        after, action = jax.vmap(policy.step)(jax.tree.unflatten(tree, carry), observation)
        return [action, *jax.tree.leaves(after)]

    shapes = [(1, sizes[0]), *((1, *np.shape(leaf)) for leaf in first)]
    inputs = ["observation", *(f"carry_{i}" for i in range(len(first)))]
    outputs = ["action", *(f"next_carry_{i}" for i in range(len(first)))]
    translation = Translation(trace(step, shapes), inputs, outputs, policy.spec.name)
    model = make_model(translation.nodes, translation.constants, sizes, first)

    # Compare the actions of both.
    if importlib.util.find_spec("onnxruntime") is not None:
        compare(policy, model)
    return model


def compare(policy: Policy, model: bytes) -> None:
    """Raise a ``Sim2RealError`` if JAX and ONNX give different actions on observations as in one episode."""
    arrays = {name: np.asarray(getattr(policy, name)) for name in ("mean", "std", "low", "high")}
    samples, backend = draw_samples(arrays), OnnxBackend(model)
    of_jax = jax.lax.scan(policy.step, policy.initial_carry(), jnp.asarray(samples))[1]
    check_parity(arrays, list(np.asarray(of_jax)), [backend(sample[None])[0] for sample in samples], "JAX", PARITY)
