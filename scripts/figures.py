"""Write the tables of README.md and docs/, and README's figures, from reports/: ``python scripts/figures.py``.

Each table stands on its page between two markers, so that the page reads the same on GitHub, in an editor and in the
built documentation.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

sys.path.insert(0, str(Path(__file__).parent))

from benches.rows import ROOT, Report, markdown, missed

TABLES = {
    "evidence": ("recorded.league.evidence", "randomise", "league"),
    "demo": ("runs.demo.table", "demo"),
    "demo_time": ("runs.demo.sentence", "demo"),
    "arm": ("runs.arm.table", "arm_cpu"),
    "so101": ("runs.arm.table", "so101_cpu"),
    "so101_time": ("runs.arm.sentence", "so101_cpu"),
    "league": ("recorded.league.table", "league"),
    "worst_joint": ("recorded.league.worst_joint", "league"),
    "latency": ("latency.table", "latency_league"),
    "randomise": ("hidden.randomise.table", "randomise", "randomise_worn"),
    "pays": ("pays.table", "pays"),
    "doctor": ("doctor.table", "doctor"),
    "compiled": ("graph.table", "graph_h200"),
    "on_a_gpu": ("train.table", "train_h200"),
    "warp": ("compose.table", "compose_warp_h200"),
    "drift": ("drift.table", "drift_so101"),
    "devices": ("train.scaling", "scaling_h200"),
    "walk": ("walk.table", "walk"),
    "legs_identify": ("legs_identify.table", "legs_identify"),
    "walk_delays": ("walking.delays.table", "walk_delays"),
    "walk_train": ("walking.train.table", "walk_train"),
}
"""Name between the markers -> function of a bench, and the reports that it gets."""
IMAGES = {
    "docs/images/what_training_knows.svg": ("hidden.randomise.figure", "randomise", "randomise_worn"),
    "docs/images/identification_pays.svg": ("pays.figure", "pays"),
    "docs/images/falls_over_delay.svg": ("walking.delays.figure", "walk_delays"),
}


def made(function: str, *reports: Report) -> Any:
    """Return what a bench's function makes of reports."""
    module, _, name = function.rpartition(".")
    return getattr(importlib.import_module(f"benches.{module}"), name)(*reports)


def origin(name: str, report: Report) -> str:
    """Return commit, date and machine of a report, and its note if it has one."""
    machine = report["machine"]
    devices = [d for d in machine.get("devices", ()) if d != "cpu"] or [f"{machine['cores']} cores, {machine['cpu']}"]
    note = f" ({report['note']})" if "note" in report else ""
    return f"{name}: `{report['commit'][:7]}`, {report['date']}, {devices[0]}{note}"


def missed_goals(reports: dict[str, Report]) -> str:
    """Return the rows of all reports whose goal is missed."""
    lines = [
        (f"`{r['name']}`", f"{r['value']} {r['unit']}".removesuffix(" 1"), r["goal"], name)
        for name, report in reports.items()
        for r in report["rows"]
        if missed(r)
    ]
    return markdown(("row", "value", "goal", "report"), lines, "lrrl")


def main() -> int:
    """Update the pages in place."""
    reports: dict[str, Any] = {p.stem: json.loads(p.read_text()) for p in sorted((ROOT / "reports").glob("*.json"))}
    if quick := [name for name, report in reports.items() if report.get("quick")]:
        print(f"error: made with --quick: {', '.join(quick)}", file=sys.stderr)
        return 1
    tables = {"missed": missed_goals(reports)}
    for table, (function, *names) in TABLES.items():
        about = "; ".join(origin(name, reports[name]) for name in names)
        tables[table] = f"{made(function, *(reports[name] for name in names))}\nMeasured: {about}.\n"
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = old = page.read_text()
        for name, table in tables.items():
            begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->\n"
            if begin in text:
                head, _, rest = text.partition(begin)
                text = head + begin + table + end + rest.partition(end)[2]
        if text != old:
            page.write_text(text)
    # A figure is the same file again as long as its report is the same.
    matplotlib.rcParams.update({"svg.hashsalt": "sim2real", "svg.fonttype": "none", "font.family": "sans-serif"})
    for path, (function, *names) in IMAGES.items():
        made(function, *(reports[name] for name in names)).savefig(ROOT / path, metadata={"Date": None})
    return 0


if __name__ == "__main__":
    sys.exit(main())
