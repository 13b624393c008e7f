"""A traced function as nodes of ONNX: the primitives that networks of policies are made of, others are refused.

Written by hand, not jax2onnx 0.17: its first translation of three layers takes 15 s of processor time, without a batch
axis it made a model that onnxruntime refuses to load, and it brings netron, sympy, huggingface-hub and an older orbax.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var
from onnx import NodeProto, helper

from sim2real.errors import UsageError

_SAME = {
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
    """Nodes and constants of a function whose inputs and outputs have names.

    Args:
        who: What it is, for errors.

    Attributes:
        nodes: The nodes, in order.
        constants: Name -> array.

    Raises:
        UsageError: It has a primitive that is not translated.
    """

    def __init__(self, traced: ClosedJaxpr, inputs: Sequence[str], outputs: Sequence[str], who: str) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}
        self._who, self._count = who, 0
        made = self._run(traced.jaxpr, traced.consts, list(inputs))
        for value, name in zip(made, outputs, strict=True):
            self.nodes.append(helper.make_node("Identity", [self._name(value)], [name]))

    def _run(self, jaxpr: Jaxpr, constants: Sequence[Any], inputs: list[Any]) -> list[Any]:
        """Return the outputs of a function: names of results, or arrays where they depend on no input."""
        known: dict[Var, Any] = dict(zip(jaxpr.constvars, map(np.asarray, constants), strict=True))
        known |= dict(zip(jaxpr.invars, inputs, strict=True))

        def read(atom: Any) -> Any:
            return np.asarray(atom.val, _kind(atom).dtype) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            given = [read(atom) for atom in equation.invars]
            known |= zip(equation.outvars, self._apply(equation, given), strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def _apply(self, equation: JaxprEqn, given: list[Any]) -> list[Any]:
        """Return the results of one primitive."""
        name, options = str(equation.primitive), equation.params
        if not any(isinstance(value, str) for value in given):  # it depends on no input: JAX itself computes it
            made = equation.primitive.bind(*map(jnp.asarray, given), **options)
            return [np.asarray(value) for value in (made if equation.primitive.multiple_results else [made])]
        body = next((options[key] for key in _BODIES if key in options), None)
        if name in _CALLS and body is not None:
            return self._run(*((body.jaxpr, body.consts) if isinstance(body, ClosedJaxpr) else (body, ())), given)
        kinds = {str(_kind(atom).dtype) for atom in (*equation.invars, *equation.outvars)}
        fits = kinds == {"bool"} if name in _LOGICAL else name not in ("div", "pow") or kinds <= _FLOATS
        if name in _SAME and fits:
            return [self._node(_SAME[name], *given)]
        translate = _OTHERS.get(name)
        if translate is None or not fits:
            raise UsageError(
                f"network {self._who} uses {name} of {', '.join(sorted(kinds))}, which is not exported to ONNX: no "
                "robot could run it",
                hint=f"primitives that are: {', '.join(sorted({*_SAME, *_OTHERS}))}",
            )
        return list(translate(self, equation, given))

    def _name(self, value: Any) -> str:
        """Return the name of a result, or of a constant."""
        if isinstance(value, str):
            return value
        name = f"constant_{len(self.constants)}"
        self.constants[name] = np.asarray(value)
        return name

    def _node(self, kind: str, *given: Any, **options: Any) -> str:
        """Add a node; return the name of its result."""
        return self._nodes(kind, 1, *given, **options)[0]

    def _nodes(self, kind: str, results: int, *given: Any, **options: Any) -> list[str]:
        names = [f"made_{self._count + i}" for i in range(results)]
        self._count += results
        self.nodes.append(helper.make_node(kind, [self._name(value) for value in given], names, **options))
        return names


_Translate = Callable[[Any, JaxprEqn, list[Any]], Iterator[str] | list[str]]


def _kind(atom: Any) -> Any:
    """Return shape and dtype of an input or a result; an untyped part of JAX."""
    return atom.aval


def _given(equation: JaxprEqn) -> Any:
    return _kind(equation.invars[0])


def _shape(equation: JaxprEqn) -> np.ndarray:
    return np.array(_kind(equation.outvars[0]).shape, np.int64)


def _reshape(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    return [to._node("Reshape", given[0], _shape(equation))]


def _broadcast(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    axes = equation.params["broadcast_dimensions"]
    inside = np.ones(len(_shape(equation)), np.int64)
    inside[list(axes)] = _given(equation).shape
    return [to._node("Expand", to._node("Reshape", given[0], inside), _shape(equation))]


def _dot(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    (left, right), (batch_left, batch_right) = equation.params["dimension_numbers"]
    ranks = [len(_kind(atom).shape) for atom in equation.invars]
    if not batch_left and left == (ranks[0] - 1,) and right == (0,) and ranks[1] == 2:
        return [to._node("MatMul", *given)]
    letters = iter(string.ascii_lowercase)
    one = [next(letters) for _ in range(ranks[0])]
    other = [next(letters) for _ in range(ranks[1])]
    for mine, own in ((left, right), (batch_left, batch_right)):
        for i, j in zip(mine, own, strict=True):
            other[j] = one[i]
    gone = {one[i] for i in (*left, *batch_left)}
    kept = [one[i] for i in batch_left] + [x for x in (*one, *other) if x not in gone]
    return [to._node("Einsum", *given, equation=f"{''.join(one)},{''.join(other)}->{''.join(kept)}")]


def _select(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    which, *cases = given
    if len(cases) != 2 or _given(equation).dtype != np.bool_:
        raise UsageError(f"network {to._who} selects one of {len(cases)} by a number, which is not exported to ONNX")
    if not _given(equation).shape:
        which = to._node("Reshape", which, np.ones(len(_shape(equation)), np.int64))
    return [to._node("Where", which, cases[1], cases[0])]


def _slice(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    start, limit = (np.array(equation.params[key], np.int64) for key in ("start_indices", "limit_indices"))
    step = np.array(equation.params["strides"] or np.ones(len(start)), np.int64)
    return [to._node("Slice", given[0], start, limit, np.arange(len(start)), step)]


def _reduce(kind: str) -> _Translate:
    def translate(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
        axes = list(equation.params["axes"])
        if not axes:
            return [to._node("Identity", *given)]
        if kind == "ReduceSum":  # its axes are an input since opset 13, those of the others since 18
            return [to._node(kind, given[0], np.array(axes, np.int64), keepdims=0)]
        return [to._node(kind, given[0], axes=axes, keepdims=0)]

    return translate


def _power(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    power = equation.params["y"]
    if power == 2:
        return [to._node("Mul", given[0], given[0])]
    return [to._node("Pow", given[0], np.asarray(power, _given(equation).dtype))]


def _convert(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    kind = helper.np_dtype_to_tensor_dtype(np.dtype(equation.params["new_dtype"]))
    return [to._node("Cast", given[0], to=kind)]


def _split(to: Translation, equation: JaxprEqn, given: list[Any]) -> list[str]:
    sizes = np.array(equation.params["sizes"], np.int64)
    return to._nodes("Split", len(sizes), given[0], sizes, axis=equation.params["axis"])


_ONE = np.float32(1.0)
_OTHERS: dict[str, _Translate] = {
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
    "square": lambda to, _, given: [to._node("Mul", given[0], given[0])],
    "ne": lambda to, _, given: [to._node("Not", to._node("Equal", *given))],
    "rsqrt": lambda to, _, given: [to._node("Reciprocal", to._node("Sqrt", *given))],
    "log1p": lambda to, _, given: [to._node("Log", to._node("Add", given[0], _ONE))],
    "expm1": lambda to, _, given: [to._node("Sub", to._node("Exp", *given), _ONE)],
    "erfc": lambda to, _, given: [to._node("Sub", _ONE, to._node("Erf", *given))],
    "clamp": lambda to, _, given: [to._node("Max", to._node("Min", given[1], given[2]), given[0])],
    "transpose": lambda to, e, given: [to._node("Transpose", *given, perm=list(e.params["permutation"]))],
    "concatenate": lambda to, e, given: [to._node("Concat", *given, axis=e.params["dimension"])],
}


def trace(function: Callable[..., Any], shapes: Sequence[tuple[int, ...]]) -> ClosedJaxpr:
    """Return a function of float32 arrays, traced.

    Args:
        function: Takes as many arrays as there are shapes.
    """
    return jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes))
