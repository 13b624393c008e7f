"""Networks of actors and critics: a perceptron, a GRU or a user's own network, as pure functions of one input."""

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen

from sim2real.errors import UsageError
from sim2real.types import Array, PyTree

Layers = tuple[tuple[Array, Array], ...]
"""A pair ``(kernel (n_in, n_out), bias (n_out,))`` per layer, float32."""


@runtime_checkable
class Network(Protocol):
    """A network with a fixed number of outputs; the carry of a stateless network is an empty tuple."""

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> PyTree:
        """Return parameters, a pytree of float32 arrays.

        Args:
            gain: Scale of the last layer: 0.01 for an actor, whose first actions should be near 0.
        """
        ...

    def initial_carry(self) -> PyTree:
        """Return the carry into an episode's first step: a pytree of arrays, ``()`` if the network is stateless."""
        ...

    def apply(self, params: PyTree, carry: PyTree, x: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the next carry, and the output, shape ``(outputs,)``, for an input of shape ``(inputs,)``."""
        ...


Factory = Callable[[int], Network | linen.Module]
"""Makes a network with the given number of outputs."""


def orthogonal(rng: np.random.Generator, n_in: int, n_out: int, gain: float) -> np.ndarray:
    """Draw an orthogonal kernel, shape ``(n_in, n_out)``; in numpy, because compiling a QR takes longer."""
    q, r = np.linalg.qr(rng.normal(size=(max(n_in, n_out), min(n_in, n_out))))
    q = q * np.sign(np.diagonal(r))  # without this, QR's choice of signs would make the distribution non-uniform
    return (gain * (q if n_in >= n_out else q.T)).astype(np.float32)


def init_mlp(rng: np.random.Generator, sizes: tuple[int, ...], last_gain: float) -> Layers:
    """Draw orthogonal kernels (gain sqrt(2), in the last layer ``last_gain``) and zero biases.

    Args:
        sizes: Widths of the input, of each hidden layer and of the output.
    """
    gains = [np.sqrt(2.0)] * (len(sizes) - 2) + [last_gain]
    shapes = zip(sizes[:-1], sizes[1:], gains, strict=True)
    return tuple((orthogonal(rng, *shape), np.zeros(shape[1], np.float32)) for shape in shapes)


def apply_mlp(layers: Layers, x: jax.Array) -> jax.Array:
    """Return the output ``(n_out,)`` of tanh layers and a linear last layer for an input ``x (n_in,)``."""
    for kernel, bias in layers[:-1]:
        x = jnp.tanh(x @ kernel + bias)
    kernel, bias = layers[-1]
    return x @ kernel + bias


@dataclass(frozen=True)
class MLP:
    """Tanh layers and a linear last layer.

    Attributes:
        widths: Widths of the hidden layers and of the output.
    """

    widths: tuple[int, ...]

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> Layers:
        """Return orthogonal kernels and zero biases."""
        return init_mlp(rng, (inputs, *self.widths), gain)

    def initial_carry(self) -> tuple[()]:
        """Return an empty carry."""
        return ()

    def apply(self, params: Layers, carry: PyTree, x: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the carry unchanged, and the output, shape ``(outputs,)``."""
        return carry, apply_mlp(params, x)


@dataclass(frozen=True)
class GRU:
    """A perceptron whose first layer is a gated recurrent unit (Cho et al. 2014).

    With reset gate r, update gate z and candidate n, columns of the kernels in this order::

        r, z = sigmoid(x W + h U + b);  n = tanh(x W_n + b_n + r * (h U_n));  h' = (1 - z) n + z h

    Attributes:
        widths: Widths of the unit, of each tanh layer after it, and of the output.
    """

    widths: tuple[int, ...]

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> dict[str, PyTree]:
        """Return orthogonal kernels; the update gate's bias is 1, so that the unit remembers from the start."""
        width = self.widths[0]
        bias = np.repeat(np.array([0.0, 1.0, 0.0], np.float32), width)
        kernels = [np.concatenate([orthogonal(rng, n, width, 1.0) for _ in range(3)], 1) for n in (inputs, width)]
        return {"kernel": kernels[0], "recurrent": kernels[1], "bias": bias, "layers": init_mlp(rng, self.widths, gain)}

    def initial_carry(self) -> np.ndarray:
        """Return zeros, shape ``(width,)``."""
        return np.zeros(self.widths[0], np.float32)

    def apply(self, params: dict[str, PyTree], carry: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the unit's state, shape ``(width,)``, and the output, shape ``(outputs,)``."""
        # The parts of both gates and of the candidate that depend on the input, and on the state.
        of_input = jnp.split(x @ params["kernel"] + params["bias"], 3)
        of_state = jnp.split(carry @ params["recurrent"], 3)
        reset, update = (jax.nn.sigmoid(a + b) for a, b in zip(of_input[:2], of_state[:2], strict=True))
        candidate = jnp.tanh(of_input[2] + reset * of_state[2])
        carry = (1.0 - update) * candidate + update * carry
        return carry, apply_mlp(params["layers"], carry)


@dataclass(frozen=True)
class FlaxNetwork:
    """A module of flax.linen, called as ``module(x)``, or ``module(carry, x)`` if it has ``initialize_carry``.

    Attributes:
        module: The module, which must have no variables except its parameters.
        inputs: Number of entries of its input.
    """

    module: linen.Module
    inputs: int

    def init(self, rng: np.random.Generator, inputs: int, gain: float) -> PyTree:
        """Return the parameters as the module initialises them; ``gain`` has no effect.

        Raises:
            UsageError: The module has variables that are no parameters.
        """
        del gain
        key, x = jax.random.key(int(rng.integers(2**31))), jnp.zeros(inputs)
        variables = jax.jit(self.module.init)(key, *((self.initial_carry(), x) if self._recurrent else (x,)))
        if set(variables) != {"params"}:
            raise UsageError(
                f"{type(self.module).__name__} has variables besides its parameters: {', '.join(sorted(variables))}",
                hint="use layers without a state, LayerNorm instead of BatchNorm; observations are normalised already",
            )
        return jax.tree.map(np.asarray, variables["params"])

    def initial_carry(self) -> PyTree:
        """Return the result of the module's ``initialize_carry``, ``()`` if it has no such method."""
        if not isinstance(self.module, _RecurrentModule):
            return ()
        return jax.tree.map(np.asarray, self.module.initialize_carry(jax.random.key(0), (self.inputs,)))

    def apply(self, params: PyTree, carry: PyTree, x: jax.Array) -> tuple[PyTree, jax.Array]:
        """Return the next carry, and the output, shape ``(outputs,)``."""
        variables = {"params": params}
        result: PyTree = self.module.apply(variables, *((carry, x) if self._recurrent else (x,)))
        return result if self._recurrent else (carry, result)

    @property
    def _recurrent(self) -> bool:
        return isinstance(self.module, _RecurrentModule)


@runtime_checkable
class _RecurrentModule(Protocol):
    """A module of flax.linen that carries a state from step to step."""

    def initialize_carry(self, rng: jax.Array, input_shape: tuple[int, ...]) -> PyTree:
        """Return the carry into the first step."""
        ...


def is_recurrent(network: Network) -> bool:
    """Return whether a network carries arrays from step to step."""
    return bool(jax.tree.leaves(network.initial_carry()))


def make_network(
    kind: str | Factory, hidden: tuple[int, ...], inputs: int, outputs: int, exported: bool = True
) -> Network:
    """Return a network.

    Args:
        kind: ``"mlp"``, ``"gru"``, ``"package.module:Class"``, or a factory.
        exported: Whether a robot will run the network: then a network that cannot be exported is refused before the
            training.

    Raises:
        UsageError: There is no such network, the factory makes no network, or it cannot be exported.
    """
    # A network of this package.
    if kind in ("mlp", "gru"):
        if kind == "gru" and not hidden:
            raise UsageError("a GRU needs a width: hidden is empty", hint="--ppo.hidden 64 64")
        return MLP((*hidden, outputs)) if kind == "mlp" else GRU((*hidden, outputs))

    # Make the user's network, and check it by tracing.
    factory = find_factory(kind) if isinstance(kind, str) else kind
    try:
        module = factory(outputs)
    except TypeError as error:
        raise UsageError(
            f"network {name_of(kind)} cannot be made of its number of outputs alone: {error}",
            hint="give its other arguments defaults, or, in Python, train(..., actor=lambda outputs: ...)",
        ) from error
    network = FlaxNetwork(module, inputs) if isinstance(module, linen.Module) else module
    if not isinstance(network, Network):
        raise UsageError(
            f"network {name_of(kind)} makes a {type(module).__name__}, neither a flax.linen.Module nor a Network",
            hint="a Network has init, initial_carry and apply: sim2real.training.networks.architectures.Network",
        )
    _check_network(network, name_of(kind), inputs, outputs)
    if exported:
        _check_export(network, name_of(kind), inputs)
    return network


def find_factory(name: str) -> Factory:
    """Return the class with a name such as ``package.module:Class``.

    Raises:
        UsageError: It cannot be imported, or is no class: the name may come from another person's bundle, which must
            not call functions of a library.
    """
    module, sign, attribute = name.partition(":")
    hint = "write mlp, gru, or package.module:Class; found as Python finds modules, and in the current directory"
    if not (sign and module and attribute):
        raise UsageError(f"there is no network {name!r}", hint=hint)
    # An installed command does not have the current directory in its path.
    here = str(Path.cwd())
    sys.path.append(here)
    try:
        factory = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"network {name!r} cannot be imported: {error}", hint=hint) from error
    finally:
        sys.path.remove(here)
    if not isinstance(factory, type):
        raise UsageError(f"network {name!r} is a {type(factory).__name__}, no class", hint=hint)
    return factory


def name_of(kind: str | Factory) -> str:
    """Return a network's name; for a user's network, ``package.module:Class``."""
    if isinstance(kind, str):
        return kind
    return f"{kind.__module__}:{getattr(kind, '__qualname__', type(kind).__qualname__)}"


def _check_network(network: Network, name: str, inputs: int, outputs: int) -> None:
    """Raise unless shapes and dtypes of a traced network are those of the protocol."""
    params = network.init(np.random.default_rng(0), inputs, 1.0)
    carry = network.initial_carry()
    after, y = jax.eval_shape(network.apply, params, carry, jax.ShapeDtypeStruct((inputs,), np.float32))
    if getattr(y, "shape", None) != (outputs,) or y.dtype != np.float32:
        raise UsageError(
            f"network {name} returns {getattr(y, 'dtype', type(y))} of shape {getattr(y, 'shape', None)} for an input "
            f"of shape ({inputs},), float32 of shape ({outputs},) is needed",
            hint="its input is one observation, without a batch axis, and the factory gets its number of outputs",
        )
    kinds = [[(np.shape(leaf), jnp.result_type(leaf)) for leaf in jax.tree.leaves(tree)] for tree in (carry, after)]
    floats = all(dtype == np.float32 for _, dtype in kinds[0])
    if jax.tree.structure(carry) != jax.tree.structure(after) or kinds[0] != kinds[1] or not floats:
        raise UsageError(
            f"network {name} must keep the form of its initial carry, arrays of float32: {kinds[1]} after {kinds[0]}",
            hint="apply returns (carry, output), the carry of the structure, shapes and dtypes of initial_carry",
        )


def _check_export(network: Network, name: str, inputs: int) -> None:
    """Raise unless a network can be translated to ONNX."""
    from sim2real.training.networks.onnx_export import translate  # onnx takes 0.2 s to import

    params = network.init(np.random.default_rng(0), inputs, 1.0)
    first, tree = jax.tree.flatten(network.initial_carry())

    def step(x: jax.Array, *carry: jax.Array) -> list[jax.Array]:
        after, y = jax.vmap(network.apply, (None, 0, 0))(params, jax.tree.unflatten(tree, carry), x)
        return [y, *jax.tree.leaves(after)]

    translate(step, [(inputs,), *map(np.shape, first)], name)
