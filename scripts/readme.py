"""Write the table of README.md from reports/demo.json: ``python scripts/readme.py``."""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
BEGIN, END = "<!-- demo:begin -->\n", "<!-- demo:end -->\n"


def table(report: dict[str, Any]) -> str:
    """Return the table: one line a figure, the worst of all seeds first."""
    seeds = report["seeds"]
    worst = {n: max(abs(s["group_errors"][n]) for s in seeds) for n in seeds[0]["group_errors"]}
    name = max(worst, key=lambda n: worst[n])
    ours = [d for s in seeds for d in s["deployments"]]
    nominal = [d for s in seeds for d in s["nominal_deployments"]]
    good = sum(d >= 0.9 for d in ours)
    truth = statistics.mean(s["round_trip_ms"] - s["round_trip_error_ms"] for s in seeds)
    stages = ", ".join(
        f"{stage} {statistics.median(s[f'{stage}_s'] for s in seeds):.0f}"
        for stage in ("record", "identify", "train", "deploy")
    )
    lines = [
        ("", f"{len(seeds)} runs of the demo, each on a robot with noise of its own"),
        ("---", "---"),
        ("parameters", f"at most {100 * worst[name]:.1f} % off the true ones ({name})"),
        (
            "round-trip delay",
            f"at most {max(abs(s['round_trip_error_ms']) for s in seeds):.1f} ms off the true {truth:.0f} ms",
        ),
        (
            "prediction, 1 s ahead",
            f"{max(s['prediction_over_true_model'] for s in seeds):.2f} times the error of the true model at most",
        ),
        ("upright on the robot", f"in {good} of {len(ours)} deployments at least 90 % of the last 5 s"),
        (
            "the same without identification",
            f"{sum(d >= 0.9 for d in nominal)} of {len(nominal)}: nominal parameters, no delays, the same training",
        ),
        ("time", f"{max(s['total_s'] for s in seeds):.0f} s at most on two CPU cores ({stages} s)"),
    ]
    return "".join(f"| {a} | {b} |\n" for a, b in lines)


def updated(readme: str, report: dict[str, Any]) -> str:
    """Return the README with the table between its two markers."""
    head, _, rest = readme.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return head + BEGIN + table(report) + END + tail


def main() -> int:
    """Update README.md in place."""
    readme = ROOT / "README.md"
    readme.write_text(updated(readme.read_text(), json.loads((ROOT / "reports" / "demo.json").read_text())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
