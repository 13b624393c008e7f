"""What benches share: the form of a row, and programs timed in turn."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any


def row(name: str, value: Any, unit: str, yardstick: str = "", goal: str = "") -> dict[str, Any]:
    """Return one row of a bench."""
    return {"name": name, "value": value, "unit": unit, "yardstick": yardstick, "goal": goal}


def medians(
    programs: Mapping[Any, Callable[[], Any]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> dict[Any, float]:
    """Run programs in turn, once to warm up; return the median of the seconds that each takes."""
    times: dict[Any, list[float]] = {name: [] for name in programs}
    for i in range(repeats + 1):
        for name, program in programs.items():
            begin = clock()
            program()
            if i:
                times[name].append(clock() - begin)
    return {name: statistics.median(t) for name, t in times.items()}


def compare(programs: Mapping[str, Callable[[Any], Any]], starts: Any, repeats: int) -> tuple[dict, dict]:
    """Time programs that are vmapped over ``starts``; return median seconds of a call, and seconds to compile."""
    import jax

    calls, compile_s = {}, {}
    for name, program in programs.items():
        begin = time.perf_counter()
        compiled = jax.jit(jax.vmap(program)).lower(starts).compile()
        compile_s[name] = time.perf_counter() - begin
        calls[name] = lambda compiled=compiled: jax.block_until_ready(compiled(starts))
    return medians(calls, repeats), compile_s
