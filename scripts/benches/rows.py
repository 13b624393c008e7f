"""Code that all benches share: rows and reports, goals, shares with their intervals, and programs timed in turn."""

from __future__ import annotations

import json
import re
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from sim2real.types import PyTree

ROOT = Path(__file__).resolve().parents[2]
Row = dict[str, Any]
"""``name``, ``value``, ``unit``, ``yardstick`` and ``goal`` of one figure."""
Report = dict[str, Any]
"""``rows``, and the records that a table needs besides."""


def row(name: str, value: object, unit: str, yardstick: str = "", goal: str = "") -> Row:
    """Return one row of a bench."""
    return {"name": name, "value": value, "unit": unit, "yardstick": yardstick, "goal": goal}


def missed(line: Mapping[str, Any]) -> bool:
    """Return whether a row misses its goal: ``< 3``, ``<= 3``, ``> 3``, ``>= 3``, ``+-3``, ``p99 < 3``, or ``all``.

    Each of several values counts, for ``p99`` the second of "p50, p99, max"; ``all`` is the number of the unit "of 20".
    """
    text, values = str(line.get("goal", "")), line["value"] if isinstance(line["value"], list) else [line["value"]]
    if text.startswith("all") and str(line["unit"]).startswith("of "):
        text = f">= {line['unit'].split()[1]}"
    goal = re.fullmatch(r"(p99 )?(<=|>=|<|>|\+-) ?([\d.e+-]+)(, .*)?", text)
    numbers = [v for v in values if isinstance(v, int | float)]
    if goal is None or not numbers:
        return False
    sign, limit = goal[2], float(goal[3])
    numbers = numbers[1:2] if goal[1] else numbers
    meets = {
        "<": lambda v: v < limit,
        "<=": lambda v: v <= limit,
        ">": lambda v: v > limit,
        ">=": lambda v: v >= limit,
        "+-": lambda v: abs(v) <= limit,
    }
    return not all(map(meets[sign], numbers))


def text_of(report: Report) -> str:
    """Return a report as JSON: a line for each entry, and for each element of a list of records."""
    lines = []
    for key, value in report.items():
        text = json.dumps(value)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            text = "[\n" + ",\n".join(f"  {json.dumps(record)}" for record in value) + "\n ]"
        lines.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def values(report: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the rows of a report whose names begin with the prefix: rest of the name -> value."""
    return {r["name"].removeprefix(prefix): r["value"] for r in report["rows"] if r["name"].startswith(prefix)}


def markdown(head: Sequence[str], lines: Iterable[Sequence[object]], align: str = "") -> str:
    """Return a table of a page.

    Args:
        align: A letter for each column: ``l`` or ``r``; "": the first left, the others right.
    """
    letters = align or "l" + "r" * (len(head) - 1)
    rule = ["---:" if letter == "r" else "---" for letter in letters]
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in (head, rule, *lines))


def four_digits(value: float) -> float:
    """Return a value rounded to four significant digits."""
    return float(f"{value:.4g}")


def share(successes: int, trials: int) -> tuple[float, float, float]:
    """Return a share and its exact 95 % interval (Clopper and Pearson): value, lower end, upper end."""
    ends = binomtest(successes, trials).proportion_ci(method="exact")
    return successes / trials, ends.low, ends.high


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
