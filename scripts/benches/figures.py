"""Code that all benches share: the form of a row, shares with their intervals, and programs timed in turn."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import numpy as np
from scipy.stats import binomtest

from sim2real.types import PyTree

Row = dict[str, object]
"""``name``, ``value``, ``unit``, ``yardstick`` and ``goal`` of one figure."""
Report = dict[str, object]
"""``rows``, and the records behind them."""


def row(name: str, value: object, unit: str, yardstick: str = "", goal: str = "") -> Row:
    """Return one row of a bench."""
    return {"name": name, "value": value, "unit": unit, "yardstick": yardstick, "goal": goal}


def four_digits(value: float) -> float:
    """Return a value rounded to four significant digits."""
    return float(f"{value:.4g}")


def share(successes: int, trials: int) -> tuple[float, float, float]:
    """Return a share and its exact 95 % interval (Clopper and Pearson): value, lower end, upper end."""
    ends = binomtest(successes, trials).proportion_ci(method="exact")
    return successes / trials, ends.low, ends.high


def mean_absolute(errors: np.ndarray) -> float:
    """Return the mean absolute error."""
    return float(np.abs(errors).mean())


def rmse(errors: np.ndarray) -> float:
    """Return the root mean square error."""
    return float(np.sqrt(np.mean(errors**2)))


def medians(
    programs: Mapping[str, Callable[[], object]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Run programs in turn, once to warm up; return the median time of each [s]."""
    times: dict[str, list[float]] = {name: [] for name in programs}
    for i in range(repeats + 1):
        for name, program in programs.items():
            begin = clock()
            program()
            if i:
                times[name].append(clock() - begin)
    return {name: statistics.median(t) for name, t in times.items()}


def compare(
    programs: Mapping[str, Callable[[PyTree], PyTree]], starts: PyTree, repeats: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Time programs that are vmapped over ``starts``; return the median time of a call, and that of compiling [s]."""
    import jax

    calls, compile_s = {}, {}
    for name, program in programs.items():
        begin = time.perf_counter()
        compiled = jax.jit(jax.vmap(program)).lower(starts).compile()
        compile_s[name] = time.perf_counter() - begin
        calls[name] = lambda compiled=compiled: jax.block_until_ready(compiled(starts))
    return medians(calls, repeats), compile_s
