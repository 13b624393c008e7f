"""Write the tables of README.md and docs/, and README's figures, from reports/: ``python scripts/figures.py``.

Each table stands on its page between two markers, so that the page reads the same on GitHub, in an editor and in the
built documentation.
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
import textwrap
from pathlib import Path
from typing import Any

import matplotlib

sys.path.insert(0, str(Path(__file__).parent))

from benches.rows import ROOT, Report, markdown, missed

TABLES = {
    "why": ("recorded.league.why", "league", "pays"),
    "evidence": ("recorded.league.evidence", "league"),
    "whole_runs": ("runs.stages.table", "demo", "arm_cpu", "so101_cpu"),
    "league": ("recorded.league.table", "league"),
    "latency": ("latency.table", "latency_league"),
    "pays": ("pays.table", "pays"),
    "randomise": ("hidden.randomise.table", "randomise", "randomise_worn"),
    "doctor": ("doctor.table", "doctor"),
    "walk": ("walk.table", "walk"),
    "walk_delays": ("walking.delays.table", "walk_delays"),
    "walk_train": ("walking.train.table", "walk_train"),
    "legs_identify": ("legs_identify.table", "legs_identify"),
    "compiled": ("graph.table", "graph_h200"),
    "warp": ("compose.table", "compose_warp_h200"),
    "on_a_gpu": ("train.table", "train_h200"),
    "devices": ("train.scaling", "scaling_h200"),
    "drift": ("drift.table", "drift_so101"),
}
"""Name between the markers -> function of a bench, and the reports that it gets."""
IMAGES = {
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
    cpu = f"{machine['cores']} cores, {machine['cpu'].replace('(R)', '')}"
    devices = [d for d in machine.get("devices", ()) if d != "cpu"] or [cpu]
    note = f" ({report['note']})" if "note" in report else ""
    return f"{name}: `{report['commit'][:7]}`, {report['date']}, {devices[0]}{note}"


def with_origin(text: str, origins: str) -> str:
    """Return a text of tables and paragraphs with its origin behind it, paragraphs in lines of a page."""
    *parts, last = text.strip("\n").split("\n\n")
    parts += [last, origins] if last.startswith("|") else [f"{last} {origins}".strip()]
    wrap = functools.partial(textwrap.fill, width=118, break_long_words=False, break_on_hyphens=False)
    return "\n\n".join(part if part.startswith("|") else wrap(part) for part in parts) + "\n"


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
        text = made(function, *(reports[name] for name in names))
        tables[table] = with_origin(text, f"Measured: {about}." if table != "why" else "")
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
