"""The table of the latency league: errors of each method on each emulated link, and the coverage of its intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

METHODS = {"ours": "sim2real", "sysid": "mujoco.sysid", "pace": "PACE", "correlation": "peak of the cross-correlation"}


def latency(report: Mapping[str, Any]) -> str:
    """Return a line for each link, one for the intervals, and a sentence on the links that another method wins."""
    values = {r["name"].removeprefix("latency/"): r for r in report["rows"]}
    methods = [m for m in METHODS if f"all/{m}/seconds" in values]
    lines: list[tuple[str, ...]] = [("link: mean / 95th percentile [ms]", "true", *(METHODS[m] for m in methods))]
    lines.append(("---", *["---:"] * (1 + len(methods))))
    lost, beaten = [], []
    for kind, true in report["truth"].items():
        errors = {m: {w: values[f"{kind}/{m}/{w}"]["value"] for w in ("mean", "p95", "lost")} for m in methods}
        cells = [f"{errors[m]['mean']:.2f} / {errors[m]['p95']:.2f}" for m in methods]
        lines.append((kind, f"{1e3 * true['mean']:.1f} / {1e3 * true['p95']:.1f}", *cells))
        if true["lost"]:
            missed = (f"{errors[m]['lost']:.2f}" for m in methods)
            lost.append((f"{kind}: share of lost messages [%]", f"{100 * true['lost']:.1f}", *missed))
        beaten += [
            f"{METHODS[m]} on {kind} ({what})"
            for what, about in (("mean", "mean"), ("95th percentile", "p95"))
            for m in methods
            if "ours" in errors and errors[m][about] < errors["ours"][about]
        ]
    intervals = [_held(values, m) for m in methods]
    lines += [*lost, ("truth within the 95 % intervals: mean; 95th percentile", "95 %", *intervals)]
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    return text + (f"\nBetter than sim2real: {', '.join(beaten)}.\n" if beaten else "")


def _held(values: Mapping[str, Any], method: str) -> str:
    """Return in how many recordings the intervals of a method contain the truth; "-" if it gives none."""
    rows = [values.get(f"all/{method}/held_{what}") for what in ("mean", "p95")]
    return "; ".join(r["yardstick"].partition(", ")[0] for r in rows if r) or "-"
