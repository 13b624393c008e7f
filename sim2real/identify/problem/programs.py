"""Compiled programs of identification: one for each form of the arguments, shared by all problems of a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from sim2real.later import jax
from sim2real.types import PyTree

OnCompile = Callable[[bool], None]
"""Called with True before a program is compiled, and with False afterwards."""


class Program:
    """A function that is compiled for each form of its arguments: their tree, shapes and dtypes.

    On a CPU, XLA's fusion emitters are off (jaxlib 0.10), as programs that run for seconds then need half the time.
    """

    def __init__(self, function: Callable[..., PyTree]) -> None:
        old = jax.default_backend() == "cpu" and jax.__version__.startswith("0.10.")
        self._jitted = jax.jit(function, compiler_options={"xla_cpu_use_fusion_emitters": False} if old else None)
        self._compiled: dict[Any, Any] = {}

    def __call__(self, *args: Any, on_compile: OnCompile | None = None) -> PyTree:
        """Run the function, compiled at the first call with arguments of this form."""
        leaves, tree = jax.tree_util.tree_flatten(args)
        form = (tree, tuple((a.shape, a.dtype, a.weak_type) for a in map(jax.typeof, leaves)))
        if form not in self._compiled:
            with compiling(on_compile):
                self._compiled[form] = self._jitted.lower(*args).compile()
        return self._compiled[form](*args)


@contextmanager
def compiling(on_compile: OnCompile | None) -> Iterator[None]:
    """Report that a program is compiled inside a ``with`` block."""
    report = on_compile or (lambda started: None)
    report(True)
    yield
    report(False)
