"""What an actor or a critic may be: a perceptron, a GRU or a user's own network, as pure functions of one input.

Ours need no module system; ``flax.linen`` is there for a user's own.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from sim2real.errors import UsageError

Layers = tuple[tuple[jax.Array, jax.Array], ...]


@runtime_checkable
class Network(Protocol):
    """A network with a fixed number of outputs; stateless ones carry an empty tuple from step to step."""

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> Any:
        """Return parameters, a pytree of float32 arrays.

        Args:
            gain: By how much to scale the last layer: 0.01 for an actor, whose first actions should be near 0.
        """
        ...

    def initial_carry(self) -> Any:
        """Return what is carried into an episode's first step: a pytree of arrays, ``()`` if nothing is."""
        ...

    def apply(self, params: Any, carry: Any, x: jax.Array) -> tuple[Any, jax.Array]:
        """Return what is carried on, and the output, shape ``(outputs,)``.

        Args:
            params: What ``init`` returned, trained.
            carry: What ``initial_carry`` or the step before returned.
            x: Shape ``(inputs,)``.
        """
        ...


Factory = Callable[[int], Any]
"""Makes a ``Network`` or a module of flax.linen with this number of outputs."""


def orthogonal(rng: np.random.Generator, n_in: int, n_out: int, gain: float) -> np.ndarray:
    """Draw an orthogonal kernel, shape ``(n_in, n_out)``; in numpy, as compiling a QR that runs once takes longer."""
    q, r = np.linalg.qr(rng.normal(size=(max(n_in, n_out), min(n_in, n_out))))
    q = q * np.sign(np.diagonal(r))  # QR's choice of signs would make the distribution non-uniform
    return (gain * (q if n_in >= n_out else q.T)).astype(np.float32)


def init_mlp(rng: np.random.Generator, sizes: tuple[int, ...], last_gain: float) -> Layers:
    """Draw orthogonal kernels (gain sqrt(2), in the last layer ``last_gain``) and zero biases.

    Args:
        sizes: Widths of the input, of each hidden layer and of the output.

    Returns:
        One pair ``(kernel (n_in, n_out), bias (n_out,))`` per layer, float32.
    """
    gains = [np.sqrt(2.0)] * (len(sizes) - 2) + [last_gain]
    drawn = zip(sizes[:-1], sizes[1:], gains, strict=True)
    layers: Any = tuple((orthogonal(rng, *sized), np.zeros(sized[1], np.float32)) for sized in drawn)
    return layers


def apply_mlp(layers: Layers, x: jax.Array) -> jax.Array:
    """Return the output ``(n_out,)`` of tanh layers and a linear last layer for an input ``x (n_in,)``."""
    for kernel, bias in layers[:-1]:
        x = jnp.tanh(x @ kernel + bias)
    kernel, bias = layers[-1]
    return x @ kernel + bias


@dataclass(frozen=True)
class MLP:
    """Tanh layers and a linear last one.

    Attributes:
        widths: Of the hidden layers and of the output.
    """

    widths: tuple[int, ...]

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> Layers:
        """Return orthogonal kernels and zero biases."""
        return init_mlp(rng, (inputs, *self.widths), gain)

    def initial_carry(self) -> tuple[()]:
        """Return nothing."""
        return ()

    def apply(self, params: Layers, carry: Any, x: jax.Array) -> tuple[Any, jax.Array]:
        """Return nothing, and the output, shape ``(outputs,)``.

        Args:
            x: Shape ``(inputs,)``.
        """
        return carry, apply_mlp(params, x)


@dataclass(frozen=True)
class GRU:
    """A gated recurrent unit (Cho et al. 2014) in place of a perceptron's first layer.

    With reset gate r, update gate z and candidate n, columns of the kernels in this order::

        r, z = sigmoid(x W + h U + b);  n = tanh(x W_n + b_n + r * (h U_n));  h' = (1 - z) n + z h

    Attributes:
        widths: Of the unit, of each tanh layer after it, and of the output.
    """

    widths: tuple[int, ...]

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> dict[str, Any]:
        """Return orthogonal kernels; the update gate's bias is 1, so that it remembers before it has learnt to."""
        width = self.widths[0]
        bias = np.repeat(np.array([0.0, 1.0, 0.0], np.float32), width)
        kernels = [np.concatenate([orthogonal(rng, n, width, 1.0) for _ in range(3)], 1) for n in (inputs, width)]
        return {"kernel": kernels[0], "recurrent": kernels[1], "bias": bias, "layers": init_mlp(rng, self.widths, gain)}

    def initial_carry(self) -> np.ndarray:
        """Return zeros, shape ``(width,)``."""
        return np.zeros(self.widths[0], np.float32)

    def apply(self, params: dict[str, Any], carry: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the unit's state, shape ``(width,)``, and the output, shape ``(outputs,)``.

        Args:
            params: What ``init`` returned.
            x: Shape ``(inputs,)``.
        """
        seen = jnp.split(x @ params["kernel"] + params["bias"], 3)
        kept = jnp.split(carry @ params["recurrent"], 3)
        reset, update = (jax.nn.sigmoid(a + b) for a, b in zip(seen[:2], kept[:2], strict=True))
        candidate = jnp.tanh(seen[2] + reset * kept[2])
        carry = (1.0 - update) * candidate + update * carry
        return carry, apply_mlp(params["layers"], carry)


@dataclass(frozen=True)
class FlaxNetwork:
    """A module of flax.linen, called as ``module(x)``, or ``module(carry, x)`` where it has ``initialize_carry``.

    Attributes:
        module: The module; its parameters are all that it has.
        inputs: Number of entries of its input.
    """

    module: linen.Module
    inputs: int

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> Any:
        """Return the module's own parameters; how it begins, its last layer too, is its own affair.

        Raises:
            UsageError: It has variables that are no parameters.
        """
        del gain
        key, x = jax.random.key(int(rng.integers(2**31))), jnp.zeros(inputs)
        variables = jax.jit(self.module.init)(key, *((self.initial_carry(), x) if self._recurrent else (x,)))
        if set(variables) != {"params"}:
            raise UsageError(
                f"{type(self.module).__name__} has variables besides its parameters: {', '.join(sorted(variables))}",
                hint="use layers without a state of their own, LayerNorm in place of BatchNorm; observations are "
                "normalised already",
            )
        return jax.tree.map(np.asarray, variables["params"])

    def initial_carry(self) -> Any:
        """Return what the module's ``initialize_carry`` returns, ``()`` if it has none."""
        if not self._recurrent:
            return ()
        module: Any = self.module
        return jax.tree.map(np.asarray, module.initialize_carry(jax.random.key(0), (self.inputs,)))

    def apply(self, params: Any, carry: Any, x: jax.Array) -> tuple[Any, jax.Array]:
        """Return what is carried on, and the output, shape ``(outputs,)``.

        Args:
            x: Shape ``(inputs,)``.
        """
        variables = {"params": params}
        made: Any = self.module.apply(variables, carry, x) if self._recurrent else self.module.apply(variables, x)
        return made if self._recurrent else (carry, made)

    @property
    def _recurrent(self) -> bool:
        return hasattr(self.module, "initialize_carry")


def is_recurrent(network: Network) -> bool:
    """Return whether a network carries anything from step to step."""
    return bool(jax.tree.leaves(network.initial_carry()))


def make_network(
    kind: str | Factory, hidden: tuple[int, ...], inputs: int, outputs: int, exported: bool = True
) -> Network:
    """Return a network.

    Args:
        kind: ``"mlp"``, ``"gru"``, ``"package.module:Class"``, or what makes one of its own.
        exported: Whether a robot is to run it, as it does an actor; refused here if it could not, before it is trained.

    Raises:
        UsageError: There is no such network, it is none, or it cannot be exported.
    """
    if kind in ("mlp", "gru"):
        if kind == "gru" and not hidden:
            raise UsageError("a GRU needs a width: hidden is empty", hint="--ppo.hidden 64 64")
        return MLP((*hidden, outputs)) if kind == "mlp" else GRU((*hidden, outputs))
    factory = find_factory(kind) if isinstance(kind, str) else kind
    try:
        made = factory(outputs)
    except TypeError as error:
        raise UsageError(
            f"network {name_of(kind)} cannot be made of its number of outputs alone: {error}",
            hint="give its other arguments defaults, or, in Python, train(..., actor=lambda outputs: ...)",
        ) from error
    network = FlaxNetwork(made, inputs) if isinstance(made, linen.Module) else made
    if not isinstance(network, Network):
        raise UsageError(
            f"network {name_of(kind)} makes a {type(made).__name__}, neither a flax.linen.Module nor a Network",
            hint="a Network has init, initial_carry and apply: sim2real.train.networks.architectures.Network",
        )
    _check_network(network, name_of(kind), inputs, outputs)
    if exported:
        _check_export(network, name_of(kind), inputs)
    return network


def find_factory(name: str) -> Factory:
    """Return the class with a name such as ``package.module:Class``.

    Raises:
        UsageError: It cannot be imported, or is no class: a bundle from elsewhere has such a name, and shall call none
            of a library's functions.
    """
    module, sign, attribute = name.partition(":")
    hint = "write mlp, gru, or package.module:Class; found as Python finds modules, and in the current directory"
    if not (sign and module and attribute):
        raise UsageError(f"there is no network {name!r}", hint=hint)
    here = str(Path.cwd())  # where an installed command does not look by itself
    sys.path.append(here)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"network {name!r} cannot be imported: {error}", hint=hint) from error
    finally:
        sys.path.remove(here)
    if not isinstance(found, type):
        raise UsageError(f"network {name!r} is a {type(found).__name__}, no class", hint=hint)
    return found


def name_of(kind: str | Factory) -> str:
    """Return a network's name, ``package.module:Class`` of one that is not ours."""
    if isinstance(kind, str):
        return kind
    return f"{kind.__module__}:{getattr(kind, '__qualname__', type(kind).__qualname__)}"


def _check_network(network: Network, name: str, inputs: int, outputs: int) -> None:
    """Raise unless a network takes and returns what it should, by tracing it."""
    params = network.init(np.random.default_rng(0), inputs, 1.0)
    carry = network.initial_carry()
    after, y = jax.eval_shape(network.apply, params, carry, jax.ShapeDtypeStruct((inputs,), np.float32))
    if getattr(y, "shape", None) != (outputs,) or y.dtype != np.float32:
        raise UsageError(
            f"network {name} returns {getattr(y, 'dtype', type(y))} of shape {getattr(y, 'shape', None)} for an input "
            f"of shape ({inputs},), float32 of shape ({outputs},) is needed",
            hint="it is given one observation, without a batch axis, and made with its number of outputs",
        )
    kinds = [[(np.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves(tree)] for tree in (carry, after)]
    whole = all(dtype == np.float32 for _, dtype in kinds[0])
    if jax.tree.structure(carry) != jax.tree.structure(after) or kinds[0] != kinds[1] or not whole:
        raise UsageError(
            f"network {name} must carry on what it began with, arrays of float32: {kinds[1]} after {kinds[0]}",
            hint="apply returns (carry, output), the carry of the structure, shapes and dtypes of initial_carry",
        )


def _check_export(network: Network, name: str, inputs: int) -> None:
    """Raise unless a network can be translated to ONNX."""
    from sim2real.train.networks.jaxpr_onnx import Translation, trace  # onnx takes 0.2 s to import

    params = network.init(np.random.default_rng(0), inputs, 1.0)
    leaves, tree = jax.tree.flatten((network.initial_carry(), np.zeros(inputs, np.float32)))
    traced = trace(
        lambda *given: network.apply(params, *jax.tree.unflatten(tree, given)), [np.shape(x) for x in leaves]
    )
    count = len(traced.jaxpr.outvars)
    Translation(traced, [f"in_{i}" for i in range(len(leaves))], [f"out_{i}" for i in range(count)], name)
