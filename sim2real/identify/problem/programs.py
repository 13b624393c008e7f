"""Compiled programs of identification: one for each form of their arguments, shared by all problems of a model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import jax

OnCompile = Callable[[bool], None]
"""Called with True before a program is compiled, and with False afterwards."""


class Program:
    """A function that is compiled for each form of its arguments: their tree, shapes and dtypes.

    On a CPU it is compiled without XLA's fusion emitters, as long as XLA can do without (jaxlib 0.10): for programs
    that run for seconds, the older way to fuse loops is twice as fast. An identification of the disk takes 24 s instead
    of 33, one of the pendulum 39 instead of 47. Training takes longer that way, 45 instead of 30.

    Args:
        function: The function; traceable.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        old = jax.default_backend() == "cpu" and jax.__version__.startswith("0.10.")
        self._jitted = jax.jit(function, compiler_options={"xla_cpu_use_fusion_emitters": False} if old else None)
        self._compiled: dict[Any, Any] = {}

    def __call__(self, *args: Any, on_compile: OnCompile | None = None) -> Any:
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
