"""Tables of the guides Record and View, each from one report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def view(report: Mapping[str, Any]) -> str:
    """Return the cost of a live viewer for a control loop."""
    rows = {row["name"].removeprefix("view/"): row for row in report["rows"]}
    lines = [
        "",
        f"12 joints at {report['flags']['rate']:g} Hz beside an emulated bus; {report['machine']['cores']} CPU cores.",
        "",
    ]
    lines += [
        "| viewer | processor time of the loop [%] | the same viewer on another log [%] | writes [1/s] "
        "| p99 lateness [ms] | viewer [cores] |",
        "|---|---|---|---|---|---|",
    ]
    for target in report["flags"]["targets"]:
        names = ("loop_share", "other_log_share", "writes_added", "lateness_p99_added_ms")
        added = (rows[f"{target}/{name}"] for name in names)
        cells = [f"{row['value']:+.3g} (s.e. {row['yardstick'].rpartition('+-')[2]})" for row in added]
        lines.append(f"| {target} | {' | '.join(cells)} | {rows[f'{target}/viewer_cores']['value']:.2f} |")
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
