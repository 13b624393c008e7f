"""What a traced function's results depend on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax

if TYPE_CHECKING:
    from sim2real.types import PyTree


@dataclass(frozen=True)
class Origin:
    """Where a result comes from.

    Attributes:
        marked: Whether it depends on a marked argument.
        argument: Number of the argument's leaf that it is, unchanged; None: it is computed.
    """

    marked: bool
    argument: int | None


def origins(function: Callable[..., PyTree], arguments: tuple[PyTree, ...], marked: PyTree) -> PyTree:
    """Return an ``Origin`` for each leaf of what a function returns, in its tree.

    Errs on the side of caution: every result of an operation counts as depending on all its operands.

    Args:
        marked: Which of them are marked: a bool for each leaf, in the arguments' tree.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    program, places = closed.jaxpr, jax.tree_util.tree_structure(shape)
    tainted = {v for v, m in zip(program.invars, jax.tree_util.tree_leaves(marked), strict=True) if m}
    for equation in program.eqns:
        if any(v in tainted for v in equation.invars if not hasattr(v, "val")):
            tainted.update(equation.outvars)
    number = {v: i for i, v in enumerate(program.invars)}
    results = [
        Origin(False, None) if hasattr(v, "val") else Origin(v in tainted, number.get(v)) for v in program.outvars
    ]
    return jax.tree_util.tree_unflatten(places, results)
