"""Tables of the guides Record and View, each from one report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_COSTS = {
    "loop_share": "processor time of the loop [%]",
    "other_log_share": "the same beside a viewer of another log [%]",
    "writes_added": "more writes [1/s]",
    "lateness_p99_ms": "p99 lateness [ms]",
    "lateness_p99_added_ms": "more than without it [ms]",
    "viewer_cores": "viewer [cores]",
}
"""Figures of a report, those that it has -> header of their column."""


def view(report: Mapping[str, Any]) -> str:
    """Return the cost of a live viewer for a control loop."""
    rows = {row["name"].removeprefix("view/"): row for row in report["rows"]}
    lines = [
        "",
        f"12 joints at {report['flags']['rate']:g} Hz beside an emulated bus; {report['machine']['cores']} CPU cores.",
        "",
    ]
    names = [n for n in _COSTS if all(f"{target}/{n}" in rows for target in report["flags"]["targets"])]
    lines += [f"| viewer | {' | '.join(_COSTS[n] for n in names)} |", "|---" * (1 + len(names)) + "|"]
    for target in report["flags"]["targets"]:
        cells = []
        for figure in (rows[f"{target}/{name}"] for name in names):
            _, added, error = figure["yardstick"].rpartition("+-")
            cells.append(f"{figure['value']:+.3g} (s.e. {error})" if added else f"{figure['value']:.3g}")
        lines.append(f"| {target} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def excitation(report: Mapping[str, Any]) -> str:
    """Return the errors of friction and zeros by the excitation of the recording."""
    rows = {row["name"].removeprefix("excitation/"): row["value"] for row in report["rows"]}
    names = {
        "multisine": "multisine",
        "teleoperated": "teleoperated motion, a file",
        "by_hand": "shown by hand, then played",
    }
    lines = [
        "",
        f"The embedded SO-101, {report['flags']['seconds']:g} s of each: rms over the joints, mean half 95 % interval.",
        "",
    ]
    lines += ["| excitation | friction, error [%] | interval [%] | zero, error [mrad] | interval [mrad] | verdict |"]
    lines += ["|---|---|---|---|---|---|"]
    for case in report["flags"]["cases"]:
        figures = [
            rows[f"{case}/{what}"] for what in ("friction_error", "friction_interval", "zero_error", "zero_interval")
        ]
        lines.append(f"| {names[case]} | {' | '.join(f'{x:.3g}' for x in figures)} | {rows[f'{case}/verdict']} |")
    return "\n".join([*lines, ""])
