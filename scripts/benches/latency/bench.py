"""The latency league: six emulated links, whose delays four methods estimate from recordings of a hidden servo.

    python scripts/bench.py latency-league --jobs 2 --json reports/latency_league.json

The rows are, for each link and method, the root mean square errors of the estimated mean, of the 95th percentile and
of the share of lost messages, over recordings that differ in goals, delays and noise. For all links together: in how
many recordings the 95 % intervals contain the truth, with the exact interval of that share.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

import numpy as np

from benches import jobs
from benches.latency.links import KINDS, log, truth
from benches.latency.methods import METHODS, timed
from benches.rows import Report, Row, four_digits, markdown, row, share

QUICK: dict[str, Any] = {"recordings": 1, "length_s": 3.0, "links": ["losses"], "methods": ["ours", "correlation"]}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--links", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--recordings", type=int, default=6, help="of each link")
    parser.add_argument("--length-s", type=float, default=8.0, help="length of a recording")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first recording")
    parser.add_argument("--jobs", type=int, default=1, help="recordings at once, of one thread each")


def run(options: argparse.Namespace) -> Report:
    """Estimate each link from each recording with each method."""
    tasks = [(kind, options.seed + i) for kind in options.links for i in range(options.recordings)]
    done = dict(jobs.each(measure, tasks, options))
    records = [record for i in range(len(tasks)) for record in done[i]["records"]]
    return {"rows": rows(records), "truth": {k: asdict(truth(k, options.length_s)) for k in options.links}}


def measure(kind: str, seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return the estimates of all methods from one recording, beside what the link did."""
    recording, true = log(kind, options.length_s, seed), truth(kind, options.length_s)
    records = []
    for method in options.methods:
        estimate, seconds = timed(method, recording, seed)
        errors = {n: getattr(estimate, n) - getattr(true, n) for n in ("mean", "p95", "lost")}
        ends = {"mean": estimate.mean95, "p95": estimate.p95_95}
        held = {n: None if e is None else bool(e[0] <= getattr(true, n) <= e[1]) for n, e in ends.items()}
        about = {"link": kind, "seed": seed, "method": method, "seconds": seconds}
        records.append({**about, "estimate": asdict(estimate), "errors": errors, "held": held})
    return {"records": records}


def rows(records: list[dict[str, Any]]) -> list[Row]:
    """Return errors of each link and method, and the coverage of each method."""
    table, units = [], {"mean": ("ms", 1e3), "p95": ("ms", 1e3), "lost": ("%", 100.0)}
    for method in dict.fromkeys(r["method"] for r in records):
        of_method = [r for r in records if r["method"] == method]
        for kind in dict.fromkeys(r["link"] for r in of_method):
            some = [r for r in of_method if r["link"] == kind]
            for what, (unit, factor) in units.items():
                error = factor * float(np.sqrt(np.mean([r["errors"][what] ** 2 for r in some])))
                name = f"latency/{kind}/{method}/{what}"
                table.append(row(name, four_digits(error), unit, f"the emulation, {len(some)} recordings"))
        for what in ("mean", "p95"):
            held = [r["held"][what] for r in of_method if r["held"][what] is not None]
            if held:
                value, low, high = share(sum(held), len(held))
                about = f"{sum(held)} of {len(held)}, 95 % interval {low:.2f} to {high:.2f}"
                table.append(
                    row(
                        f"latency/all/{method}/held_{what}",
                        four_digits(value),
                        "share",
                        about,
                        ">= 0.95" if method == "ours" else "",
                    )
                )
        seconds = float(np.median([r["seconds"] for r in of_method]))
        table.append(row(f"latency/all/{method}/seconds", four_digits(seconds), "s", "processor time of a recording"))
    return table


NAMES = {"ours": "sim2real", "sysid": "mujoco.sysid", "pace": "PACE", "correlation": "peak of the cross-correlation"}


def table(report: Report) -> str:
    """Return the errors on each link, the coverage of the intervals, and the links that another method wins."""
    of = {r["name"].removeprefix("latency/"): r for r in report["rows"]}
    methods = [m for m in NAMES if f"all/{m}/seconds" in of]
    lines, lost, better = [], [], []
    for kind, true in report["truth"].items():
        errors = {m: {w: of[f"{kind}/{m}/{w}"]["value"] for w in ("mean", "p95", "lost")} for m in methods}
        cells = [f"{errors[m]['mean']:.2f} / {errors[m]['p95']:.2f}" for m in methods]
        lines.append((kind, f"{1e3 * true['mean']:.1f} / {1e3 * true['p95']:.1f}", *cells))
        if true["lost"]:
            shares = [f"{errors[m]['lost']:.2f}" for m in methods]
            lost.append((f"{kind}: share of lost messages [%]", f"{100 * true['lost']:.1f}", *shares))
        for what, name in (("mean", "mean"), ("p95", "95th percentile")):
            better += [f"{NAMES[m]} on {kind} ({name})" for m in methods if errors[m][what] < errors["ours"][what]]
    held = [[of.get(f"all/{m}/held_{what}") for what in ("mean", "p95")] for m in methods]
    counts = ["; ".join(r["yardstick"].partition(", ")[0] for r in rs if r) or "-" for rs in held]
    lines += [*lost, ("truth within the 95 % intervals: mean; 95th percentile", "95 %", *counts)]
    lines.append(
        ("processor time of a recording [s]", "", *(f"{of[f'all/{m}/seconds']['value']:.2g}" for m in methods))
    )
    head = ("link: mean / 95th percentile [ms]", "true", *map(NAMES.__getitem__, methods))
    text = (
        "\nAll but the correlation fit the servo too. PACE's form is re-implemented; its search has a limit of time.\n"
    )
    return markdown(head, lines) + text + (f"\nBetter than sim2real: {', '.join(better)}.\n" if better else "")
