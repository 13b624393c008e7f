"""Translation of a traced function into ONNX nodes, for the primitives of policy networks; others are refused."""

# jax2onnx 0.17.1 exports the same networks, but a vmapped flax module only by way of a jaxpr. It adds 23 distributions
# of 175 MB, needs an older orbax-checkpoint, and its first export takes 8 s, ours 0.15 s.

import string
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var
from onnx import NodeProto, helper

from sim2real.errors import UsageError
from sim2real.types import Array, Json, PyTree

_Value = str | np.ndarray
"""The name of a result, or an array that depends on no input."""

_DIRECT = {
    "tanh": "Tanh", "exp": "Exp", "log": "Log", "neg": "Neg", "abs": "Abs", "sqrt": "Sqrt", "logistic": "Sigmoid",
    "sin": "Sin", "cos": "Cos", "erf": "Erf", "sign": "Sign", "floor": "Floor", "ceil": "Ceil", "not": "Not",
    "copy": "Identity", "copy_p": "Identity", "stop_gradient": "Identity", "add": "Add", "add_any": "Add", "sub": "Sub",
    "mul": "Mul", "div": "Div", "max": "Max", "min": "Min", "pow": "Pow", "and": "And", "or": "Or", "xor": "Xor",
    "eq": "Equal", "lt": "Less", "le": "LessOrEqual", "gt": "Greater", "ge": "GreaterOrEqual",
}  # fmt: skip
"""Primitives that are one node of ONNX with the same inputs."""
_CALLS = {
    "jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr", "remat",
    "checkpoint",
}  # fmt: skip
_BODIES = ("jaxpr", "call_jaxpr", "fun_jaxpr")
_FLOATS = {"float32"}
_LOGICAL = {"not", "and", "or", "xor"}


class Translation:
    """Nodes and constants of a traced function, with the given names of its inputs and outputs.

    Attributes:
        constants: Name -> array.

    Raises:
        UsageError: The function has a primitive that is not translated.
    """

    def __init__(self, traced: ClosedJaxpr, inputs: Sequence[str], outputs: Sequence[str], network: str) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}
        self.network, self._count = network, 0
        results = self._run(traced.jaxpr, traced.consts, list(inputs))
        for value, name in zip(results, outputs, strict=True):
            self.nodes.append(helper.make_node("Identity", [self._name(value)], [name]))

    def _run(self, jaxpr: Jaxpr, constants: Sequence[Array], inputs: Sequence[_Value]) -> list[_Value]:
        """Return the outputs of a function."""
        values: dict[Var, _Value] = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
        values |= dict(zip(jaxpr.invars, inputs, strict=True))

        def read(atom: Var | Literal) -> _Value:
            return np.asarray(atom.val, _kind(atom).dtype) if isinstance(atom, Literal) else values[atom]

        for equation in jaxpr.eqns:
            operands = [read(atom) for atom in equation.invars]
            values |= zip(equation.outvars, self._apply(equation, operands), strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def _apply(self, equation: JaxprEqn, operands: list[_Value]) -> list[_Value]:
        """Return the results of one primitive."""
        name, options = str(equation.primitive), equation.params

        # JAX computes constants, which depend on no input.
        if not any(isinstance(value, str) for value in operands):
            result = equation.primitive.bind(*map(jnp.asarray, operands), **options)
            return [np.asarray(value) for value in (result if equation.primitive.multiple_results else [result])]

        # A call is replaced by the nodes of its function.
        body = next((options[key] for key in _BODIES if key in options), None)
        if name in _CALLS and body is not None:
            function = (body.jaxpr, body.consts) if isinstance(body, ClosedJaxpr) else (body, ())
            return self._run(*function, operands)

        # Other primitives are one node, or have a function here; ONNX differs from JAX in div and pow of integers.
        kinds = {str(_kind(atom).dtype) for atom in (*equation.invars, *equation.outvars)}
        fits = kinds == {"bool"} if name in _LOGICAL else name not in ("div", "pow") or kinds <= _FLOATS
        if name in _DIRECT and fits:
            return [self.node(_DIRECT[name], *operands)]
        translate = _TRANSLATED.get(name)
        if translate is None or not fits:
            raise UsageError(
                f"network {self.network} uses {name} of {', '.join(sorted(kinds))}, which is not exported to ONNX: no "
                "robot could run it",
                hint=f"primitives that are: {', '.join(sorted({*_DIRECT, *_TRANSLATED}))}",
            )
        return list(translate(self, equation, operands))

    def _name(self, value: _Value) -> str:
        """Return the name of a result, or of a constant."""
        if isinstance(value, str):
            return value
        name = f"constant_{len(self.constants)}"
        self.constants[name] = np.asarray(value)
        return name

    def node(self, kind: str, *operands: _Value, **options: Json) -> str:
        """Add a node; return the name of its result."""
        return self.node_of_several(kind, 1, *operands, **options)[0]

    def node_of_several(self, kind: str, results: int, *operands: _Value, **options: Json) -> list[str]:
        """Add a node; return the names of its results."""
        names = [f"result_{self._count + i}" for i in range(results)]
        self._count += results
        self.nodes.append(helper.make_node(kind, [self._name(value) for value in operands], names, **options))
        return names


_Translate = Callable[[Translation, JaxprEqn, list[_Value]], list[str]]


def _kind(atom: Var | Literal) -> ShapedArray:
    """Return shape and dtype of an input or a result."""
    if not isinstance(atom.aval, ShapedArray):
        raise UsageError(f"a value of type {atom.aval} is not exported to ONNX", hint="use arrays of numbers")
    return atom.aval


def _operand(equation: JaxprEqn) -> ShapedArray:
    return _kind(equation.invars[0])


def _shape(equation: JaxprEqn) -> np.ndarray:
    return np.array(_kind(equation.outvars[0]).shape, np.int64)


def _reshape(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    return [to.node("Reshape", operands[0], _shape(equation))]


def _broadcast(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    axes = equation.params["broadcast_dimensions"]
    inside = np.ones(len(_shape(equation)), np.int64)
    inside[list(axes)] = _operand(equation).shape
    return [to.node("Expand", to.node("Reshape", operands[0], inside), _shape(equation))]


def _dot(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    (left, right), (batch_left, batch_right) = equation.params["dimension_numbers"]
    ranks = [len(_kind(atom).shape) for atom in equation.invars]
    if not batch_left and left == (ranks[0] - 1,) and right == (0,) and ranks[1] == 2:
        return [to.node("MatMul", *operands)]
    letters = iter(string.ascii_lowercase)
    # Contracted axes and batch axes share a letter; the result has the batch axes first, then the free axes.
    one = [next(letters) for _ in range(ranks[0])]
    other = [next(letters) for _ in range(ranks[1])]
    for axes, other_axes in ((left, right), (batch_left, batch_right)):
        for i, j in zip(axes, other_axes, strict=True):
            other[j] = one[i]
    shared = {one[i] for i in (*left, *batch_left)}
    result = [one[i] for i in batch_left] + [x for x in (*one, *other) if x not in shared]
    return [to.node("Einsum", *operands, equation=f"{''.join(one)},{''.join(other)}->{''.join(result)}")]


def _select(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    which, *cases = operands
    if len(cases) != 2 or _operand(equation).dtype != np.bool_:
        raise UsageError(f"network {to.network} selects one of {len(cases)} by a number, which is not exported to ONNX")
    if not _operand(equation).shape:
        which = to.node("Reshape", which, np.ones(len(_shape(equation)), np.int64))
    return [to.node("Where", which, cases[1], cases[0])]


def _slice(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    start, limit = (np.array(equation.params[key], np.int64) for key in ("start_indices", "limit_indices"))
    step = np.array(equation.params["strides"] or np.ones(len(start)), np.int64)
    return [to.node("Slice", operands[0], start, limit, np.arange(len(start)), step)]


def _reduce(kind: str) -> _Translate:
    def translate(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
        axes = list(equation.params["axes"])
        if not axes:
            return [to.node("Identity", *operands)]
        if kind == "ReduceSum":  # its axes are an input since opset 13, those of the others since 18
            return [to.node(kind, operands[0], np.array(axes, np.int64), keepdims=0)]
        return [to.node(kind, operands[0], axes=axes, keepdims=0)]

    return translate


def _power(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    power = equation.params["y"]
    if power == 2:
        return [to.node("Mul", operands[0], operands[0])]
    return [to.node("Pow", operands[0], np.asarray(power, _operand(equation).dtype))]


def _convert(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    kind = helper.np_dtype_to_tensor_dtype(np.dtype(equation.params["new_dtype"]))
    return [to.node("Cast", operands[0], to=kind)]


def _split(to: Translation, equation: JaxprEqn, operands: list[_Value]) -> list[str]:
    sizes = np.array(equation.params["sizes"], np.int64)
    return to.node_of_several("Split", len(sizes), operands[0], sizes, axis=equation.params["axis"])


_ONE = np.array(1.0, np.float32)
_TRANSLATED: dict[str, _Translate] = {
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "broadcast_in_dim": _broadcast,
    "dot_general": _dot,
    "select_n": _select,
    "slice": _slice,
    "split": _split,
    "reduce_sum": _reduce("ReduceSum"),
    "reduce_max": _reduce("ReduceMax"),
    "reduce_min": _reduce("ReduceMin"),
    "reduce_prod": _reduce("ReduceProd"),
    "integer_pow": _power,
    "convert_element_type": _convert,
    "square": lambda to, _, operands: [to.node("Mul", operands[0], operands[0])],
    "ne": lambda to, _, operands: [to.node("Not", to.node("Equal", *operands))],
    "rsqrt": lambda to, _, operands: [to.node("Reciprocal", to.node("Sqrt", *operands))],
    "log1p": lambda to, _, operands: [to.node("Log", to.node("Add", operands[0], _ONE))],
    "expm1": lambda to, _, operands: [to.node("Sub", to.node("Exp", *operands), _ONE)],
    "erfc": lambda to, _, operands: [to.node("Sub", _ONE, to.node("Erf", *operands))],
    "clamp": lambda to, _, operands: [to.node("Max", to.node("Min", operands[1], operands[2]), operands[0])],
    "transpose": lambda to, e, operands: [to.node("Transpose", *operands, perm=list(e.params["permutation"]))],
    "concatenate": lambda to, e, operands: [to.node("Concat", *operands, axis=e.params["dimension"])],
}


def trace(function: Callable[..., PyTree], shapes: Sequence[tuple[int, ...]]) -> ClosedJaxpr:
    """Return a traced function of float32 arrays with these shapes."""
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes))
