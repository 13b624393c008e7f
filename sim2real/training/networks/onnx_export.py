"""Exports a policy with a user's network to ONNX, so that a robot runs it without JAX and the network's code.

``sim2real.policy.onnx_graph`` exports the networks of this package.
"""

import importlib.util
import json
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun

from sim2real.errors import UsageError
from sim2real.installation import with_extra
from sim2real.policy.bundle import check_parity, draw_samples
from sim2real.policy.onnx_graph import IR_VERSION, OPSET
from sim2real.policy.runner import INITIAL_CARRY, OnnxBackend
from sim2real.training.networks.policy import Policy
from sim2real.types import PyTree

PARITY = 1e-4
"""Largest accepted difference between ONNX and JAX, as a share of the actions' range. A normalisation amplifies
rounding errors of nearly equal inputs: 1.1e-5 after a GroupNorm of clipped values.
"""


def export_graph(policy: Policy) -> bytes | None:
    """Return the policy as a serialised ONNX model; None for networks that need none.

    If onnxruntime is installed, the model is compared with JAX on observations of an episode.

    Raises:
        UsageError: jax2onnx is not installed, or does not translate the network.
        Sim2RealError: JAX and ONNX give different actions.
    """
    if policy.spec.built_in:
        return None
    # Export one step of a batch of 1; the leaves of the carry are inputs and outputs of the model.
    first, tree = jax.tree.flatten(policy.initial_carry())

    def step(observation: jax.Array, *carry: jax.Array) -> list[jax.Array]:
        after, action = jax.vmap(policy.step)(jax.tree.unflatten(tree, carry), observation)
        return [action, *jax.tree.leaves(after)]

    model = translate(step, [policy.mean.shape, *map(np.shape, first)], policy.spec.name)
    model.ir_version = IR_VERSION
    if first:
        carry = json.dumps([np.asarray(array).tolist() for array in first])
        model.metadata_props.add(key=INITIAL_CARRY, value=carry)
    graph = model.SerializeToString()

    # Compare the actions of both.
    if importlib.util.find_spec("onnxruntime") is not None:
        compare(policy, graph)
    return graph


def compare(policy: Policy, model: bytes) -> None:
    """Raise a ``Sim2RealError`` if JAX and ONNX give different actions on observations as in one episode."""
    arrays = {name: np.asarray(getattr(policy, name)) for name in ("mean", "std", "low", "high")}
    samples, backend = draw_samples(arrays), OnnxBackend(model)
    of_jax = jax.lax.scan(policy.step, policy.initial_carry(), jnp.asarray(samples))[1]
    check_parity(arrays, list(np.asarray(of_jax)), [backend(sample[None])[0] for sample in samples], "JAX", PARITY)


def translate(step: Callable[..., PyTree], shapes: Sequence[tuple[int, ...]], network: str) -> Any:
    """Return the ONNX model of a step of a batch of 1, from observation and carry to an action and the next carry.

    Args:
        shapes: Shapes of the inputs without the batch axis: the observation, then each leaf of the carry.
        network: The network's name, for errors.

    Raises:
        UsageError: jax2onnx is not installed, or does not translate the network.
    """
    try:
        from jax2onnx import to_onnx  # imported late: it takes seconds
    except ImportError as error:
        raise UsageError(
            f"network {network} is exported to ONNX by jax2onnx, which is not installed", hint=with_extra("network")
        ) from error
    inputs = [jax.ShapeDtypeStruct((1, *shape), jnp.float32) for shape in shapes]
    carry = [f"carry_{i}" for i in range(len(shapes) - 1)]
    names, after = ["observation", *carry], ["action", *(f"next_{name}" for name in carry)]
    traced = jaxpr_as_fun(jax.make_jaxpr(step)(*inputs))  # jax2onnx does not trace a module of flax under `vmap`
    try:
        return to_onnx(traced, inputs, model_name="policy", opset=OPSET, input_names=names, output_names=after)
    except Exception as error:  # errors of jax2onnx have no common base class
        raise UsageError(
            f"network {network} is not exported to ONNX, so no robot could run it: {error}",
            hint="use layers that jax2onnx translates",
        ) from error
