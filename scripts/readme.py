"""Write the tables and figures of README.md and of pages in docs/ from reports/: ``python scripts/readme.py``.

A report that is of another state of the code than this one is refused, unless it is named after --stale-ok.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from benches.catalogue import measures
from benches.provenance import ROOT, why_stale
from page_tables import recordings, sentences
from page_tables.latency import latency
from page_tables.league import evidence, league, league_promises
from page_tables.walk_delays import figure as falls_over_delay
from page_tables.walk_delays import walk_delays

TABLES = {
    "evidence": ("randomise", "league"),
    "demo": ("demo",),
    "arm": ("arm_cpu",),
    "so101": ("so101_cpu",),
    "demo_time": ("demo",),
    "so101_time": ("so101_cpu",),
    "real": ("identify_disk", "identify_xl330", "identify_so101"),
    "league": ("league",),
    "league_promises": ("league",),
    "latency": ("latency_league",),
    "randomise": ("randomise", "randomise_worn"),
    "worst_joint": ("league",),
    "wall": ("randomise_wall",),
    "compiled": ("graph_h200",),
    "on_a_gpu": ("train_h200",),
    "faults": ("faults",),
    "warp": ("compose_warp_h200",),
    "drift": ("drift_pendulum", "drift_arm", "drift_so101"),
    "restored": ("drift_pendulum_restore", "drift_arm_restore", "drift_so101_restore"),
    "devices": ("scaling_h200",),
    "view": ("view",),
    "excitation": ("excitation",),
    "twin": ("twin",),
    "carried": ("carried",),
    "walk": ("walk",),
    "legs_identify": ("legs_identify",),
    "walk_delays": ("walk_delays",),
    "walk_rival": ("walk_rival",),
    "walk_train": ("walk_train",),
    "light": ("light",),
}
"""Tables, and the reports that each is made of; a table whose reports are not all there stays as it is."""
GUIDES = ("so101", "train", "safety", "compose", "deploy", "scale", "view", "record", "walk", "robot_computer")
PAGES = ("README.md", "docs/results.md", "docs/getting_started.md", *(f"docs/guides/{name}.md" for name in GUIDES))
"""Pages with tables, or with a sentence of figures."""
FIGURE = "docs/images/what_training_knows.svg"
DELAYS_FIGURE = "docs/images/falls_over_delay.svg"
TRAINED_ON = {
    "data_sheet": "the data sheet, without delays",
    "uniform": "the data sheet, parameters 30 % up and down",
    "point": "the identified parameters and delays",
    "posterior": "the posterior of the identification",
    "all": "posterior, misfit, recorded timing and noise",
}
CLOSE_M = 0.02
"""How near the arm's tip must come to its target [m]."""


def demo(report: dict[str, Any]) -> str:
    """Return the table: one line a figure, the worst of all seeds first."""
    seeds = report["seeds"]
    worst = {n: max(abs(s["errors"][n]) for s in seeds) for n in seeds[0]["errors"]}
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
        *about_promises(seeds),
        ("upright on the robot", f"in {good} of {len(ours)} deployments at least 90 % of the last 5 s"),
        (
            "the same without identification",
            f"{sum(d >= 0.9 for d in nominal)} of {len(nominal)}: nominal parameters, no delays, the same training",
        ),
        ("time", f"{max(s['total_s'] for s in seeds):.0f} s at most on two CPU cores ({stages} s)"),
    ]
    return "".join(f"| {a} | {b} |\n" for a, b in lines)


def about_promises(seeds: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return the line on the bounds of errors on held-out data; empty for a report without them."""
    rows = [row for seed in seeds for row in seed.get("promises", ())]
    if not rows:
        return []
    below, worst = sum(row["kept"] == "yes" for row in rows), max(float(row["ratio"]) for row in rows)
    text = f"{below} of {len(rows)} below the bound that was promised; the worst is {worst:.2f} times its bound"
    return [("errors on held-out data", text)]


def run_time(report: Mapping[str, Any], subject: str) -> str:
    """Return the sentence on the time of a run: the median over its seeds, and that of each stage."""
    seeds = report["seeds"]
    total, *stages = (
        statistics.median(s[f"{name}_s"] for s in seeds) for name in ("total", "record", "identify", "train", "deploy")
    )
    record, identify, train, deploy = (f"{stage:.0f} s" for stage in stages)
    return (
        f"On two CPU cores {subject} takes {total:.0f} s: {record} to record, {identify} to\n"
        f"identify, {train} to train and {deploy} to deploy.\n"
    )


def real_motors(reports: Mapping[str, dict[str, Any]]) -> str:
    """Return the table of recordings of real motors: ours, mujoco.sysid in the same run, ours without delay.

    The bound that was promised stands beside our error if the report has it.
    """
    v = {r["name"].removeprefix("identify/"): r["value"] for report in reports.values() for r in report["rows"]}
    moved = [n for n in v if n.startswith("so101/") and n.endswith("_sysid_rmse_mrad")]
    joints = [n.replace("_sysid_rmse_mrad", "") for n in moved]
    kinds = ("_rmse_mrad", "_sysid_rmse_mrad", "_no_delay_mrad")
    arm, worst = ([of(v[j + kind] for j in joints) for kind in kinds] for of in (statistics.mean, max))
    disk = [1e3 * v[f"disk/{n}free_run_rmse_rad"] for n in ("", "sysid_", "no_delay_")]
    servo = [v[f"xl330/{n}test_mae_mrad"] for n in ("", "sysid_", "no_delay_")]
    bounds = {kind: [v[n] for n in v if n.startswith(f"{kind}/promised/")] for kind in ("disk", "xl330")}
    bounds["so101"] = [v[n] for j in joints if (n := f"so101/promised/{j.rpartition('/')[2]}_mrad") in v]

    def line(about: str, errors: Sequence[float], promised: Sequence[float], digits: int = 0) -> tuple[str, ...]:
        first, *others = (f"{x:.{digits}f} mrad" for x in errors)
        return about, first, f"{statistics.mean(promised):.{digits}f} mrad" if promised else "-", *others

    lines = [
        ("held-out data, whole recordings", "sim2real", "promised, RMSE", "mujoco.sysid", "sim2real without delay"),
        ("---", "---:", "---:", "---:", "---:"),
        line("motor with eccentric mass, 125 s free run, RMSE", disk, bounds["disk"]),
        line("DYNAMIXEL XL330, a gain that was not fitted, MAE", servo, bounds["xl330"]),
        line("SO-101 arm, joints that move, mean RMSE", arm, bounds["so101"], digits=1),
        line("SO-101 arm, worst joint of a motion, RMSE", worst, sorted(bounds["so101"])[-1:]),
    ]
    if not any(bounds.values()):  # a report of an earlier version has no bounds
        lines = [(about, first, *others) for about, first, _, *others in lines]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def randomise(ideal: Mapping[str, Any], worn: Mapping[str, Any]) -> str:
    """Return the table of the hidden robots: a line for each training model, with exact 95 % intervals.

    Args:
        ideal: The report of robots that are nearly ideal.
        worn: That of robots that are not.
    """
    count, trials = len(ideal["robots"]), ideal["flags"]["trials"]
    lines: list[tuple[str, ...]] = [
        (f"trained on, {count} hidden robots with {trials} deployments each", "nearly ideal", "95 %", "worn", "95 %"),
        ("---", "---:", "---:", "---:", "---:"),
    ]
    figures = [{r["name"].removeprefix("randomise/"): r["value"] for r in report["rows"]} for report in (ideal, worn)]
    for way, about in TRAINED_ON.items():
        line = [about]
        for v in figures:
            share, low, high = (100 * v[f"{way}/{n}"] for n in ("success", "low95", "high95"))
            line += [f"{share:.0f} %", f"{low:.0f} to {high:.0f} %"]
        lines.append(tuple(line))
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def what_training_knows(ideal: Mapping[str, Any], worn: Mapping[str, Any]) -> str:
    """Return README's figure as SVG: success on hidden robots by what the training was given."""
    shares = [{r["name"].removeprefix("randomise/"): r["value"] for r in report["rows"]} for report in (ideal, worn)]
    row_px, left_px, scale_px = 44, 390, 3.6
    height_px = 60 + row_px * len(TRAINED_ON)
    body = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 820 {height_px}" font-family="sans-serif">',
        "<title>Success on hidden robots by what the training was given</title>",
        f'<rect width="820" height="{height_px}" fill="#ffffff"/>',
        '<rect x="390" y="14" width="14" height="12" fill="#0b62b0"/><text x="410" y="25">nearly ideal robots</text>',
        '<rect x="570" y="14" width="14" height="12" fill="#b8540c"/><text x="590" y="25">worn robots</text>',
    ]
    for i, (way, label) in enumerate(TRAINED_ON.items()):
        top_px = 44 + i * row_px
        body.append(f'<text x="{left_px - 12}" y="{top_px + 20}" text-anchor="end">{label}</text>')
        for j, (share, colour) in enumerate(zip(shares, ("#0b62b0", "#b8540c"), strict=True)):
            percent = 100 * share[f"{way}/success"]
            y_px = top_px + 16 * j
            body.append(
                f'<rect x="{left_px}" y="{y_px}" width="{scale_px * percent:.0f}" height="13" fill="{colour}"/>'
                f'<text x="{left_px + scale_px * percent + 6:.0f}" y="{y_px + 11}">{percent:.0f} %</text>'
            )
    return "\n".join([*body, "</svg>", ""])


def arm(what: str, cpu: dict[str, Any]) -> str:
    """Return the table of an arm: the first seed of the run."""
    seed = cpu["seeds"][0]

    def reached(key: str) -> str:
        distances = seed[key]
        good = sum(d < CLOSE_M for d in distances)
        return f"{good} of {len(distances)} deployments, median {1e3 * statistics.median(distances):.1f} mm off"

    truth = seed["round_trip_ms"] - seed["round_trip_error_ms"]
    stages = ", ".join(f"{stage} {seed[f'{stage}_s']:.0f}" for stage in ("record", "identify", "train", "deploy"))
    lines = [
        ("", what),
        ("---", "---"),
        ("held-out motion, 1 s ahead", f"{seed['mae_mrad']:.1f} mrad mean absolute error"),
        *about_promises(cpu["seeds"][:1]),
        ("round-trip delay", f"{abs(seed['round_trip_error_ms']):.1f} ms off the true {truth:.0f} ms"),
        ("within 2 cm of the target", reached("distances_m")),
        ("the same without identification", reached("nominal_distances_m")),
        ("time", f"{seed['total_s']:.0f} s on two CPU cores ({stages} s)"),
    ]
    return "".join(f"| {a} | {b} |\n" for a, b in lines)


def origin(reports: Mapping[str, dict[str, Any]]) -> str:
    """Return the line below a table: the commit of each of its reports."""
    commits = {name: (report.get("commit") or "")[:7] for name, report in reports.items()}
    listed = ", ".join(f"{f'`{sha}`' if sha else 'not recorded'} ({name})" for name, sha in commits.items())
    return f"\nCommit that was measured: {listed}.\n"


def updated(page: str, tables: Mapping[str, str]) -> str:
    """Return a page with each of its tables between the two markers of the table's name."""
    for name, text in tables.items():
        begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->\n"
        if begin in page:
            head, _, rest = page.partition(begin)
            page = head + begin + text + end + rest.partition(end)[2]
    return page


def read_reports() -> dict[str, dict[str, Any]]:
    """Return the committed reports of all tables, by name."""
    paths = {name: ROOT / "reports" / f"{name}.json" for table in TABLES.values() for name in table}
    return {name: json.loads(path.read_text()) for name, path in paths.items() if path.is_file()}


def tables(reports: Mapping[str, dict[str, Any]]) -> dict[str, str]:
    """Return the tables whose reports are all present."""
    write: dict[str, Callable[[dict[str, dict[str, Any]]], str]] = {
        "evidence": lambda chosen: evidence(chosen["randomise"], chosen["league"]),
        "demo": lambda chosen: demo(chosen["demo"]),
        "arm": lambda chosen: arm("the arm: three position-controlled servos on one bus", *chosen.values()),
        "so101": lambda chosen: arm("the SO-101: six servos with the parameters of a real one", *chosen.values()),
        "demo_time": lambda own: run_time(own["demo"], "the demo"),
        "so101_time": lambda own: run_time(own["so101_cpu"], "the run"),
        "real": real_motors,
        "league": lambda chosen: league(chosen["league"]),
        "league_promises": lambda chosen: league_promises(chosen["league"]),
        "latency": lambda chosen: latency(chosen["latency_league"]),
        "randomise": lambda chosen: randomise(chosen["randomise"], chosen["randomise_worn"]),
        "worst_joint": lambda chosen: sentences.worst_joint(*chosen.values()),
        "wall": lambda chosen: sentences.on_the_wall_clock(*chosen.values()),
        "compiled": lambda chosen: sentences.compiled_graph(*chosen.values()),
        "on_a_gpu": lambda chosen: sentences.on_a_gpu(*chosen.values()),
        "faults": lambda chosen: sentences.faults(*chosen.values()),
        "warp": lambda chosen: sentences.on_warp(*chosen.values()),
        "drift": lambda chosen: sentences.drift(*chosen.values()),
        "restored": lambda chosen: sentences.restored(*chosen.values()),
        "devices": lambda chosen: sentences.on_more_devices(*chosen.values()),
        "view": lambda chosen: recordings.view(*chosen.values()),
        "excitation": lambda chosen: recordings.excitation(*chosen.values()),
        "twin": lambda chosen: sentences.twin(*chosen.values()),
        "carried": lambda chosen: sentences.carried(*chosen.values()),
        "walk": lambda chosen: sentences.walk(*chosen.values()),
        "legs_identify": lambda chosen: sentences.legs_identify(*chosen.values()),
        "walk_delays": lambda chosen: walk_delays(*chosen.values()),
        "walk_rival": lambda chosen: sentences.walk_rival(*chosen.values()),
        "walk_train": lambda chosen: sentences.walk_train(*chosen.values()),
        "light": lambda chosen: sentences.light(*chosen.values()),
    }
    there = {table: names for table, names in TABLES.items() if set(names) <= set(reports)}
    chosen = {table: {name: reports[name] for name in names} for table, names in there.items()}
    return {table: write[table](chosen[table]) + origin(chosen[table]) for table in there}


def stale(reports: Mapping[str, dict[str, Any]], root: Path = ROOT) -> dict[str, str]:
    """Return the reports that are not of the present state of the code: name -> reason."""
    reasons = {}
    for name, report in reports.items():
        paths = measures(report["bench"], report["flags"]) if "bench" in report else ()
        if why := why_stale(report, paths, root):
            reasons[name] = why
    return reasons


def main(arguments: Sequence[str] | None = None) -> int:
    """Update the pages in place."""
    parser = argparse.ArgumentParser(prog="readme.py", description=__doc__)
    names = list(dict.fromkeys(name for table in TABLES.values() for name in table))
    parser.add_argument(
        "--stale-ok", nargs="+", default=[], choices=names, metavar="REPORT",
        help=f"take these reports although their measured files have changed since: {', '.join(names)}",
    )  # fmt: skip
    accepted = parser.parse_args(arguments).stale_ok
    reports = read_reports()
    refused = {name: why for name, why in stale(reports).items() if name not in accepted}
    for name, why in refused.items():
        print(f"error: reports/{name}.json: {why}", file=sys.stderr)
    if refused:
        print(f"\nhint: measure again, or --stale-ok {' '.join(refused)}", file=sys.stderr)
        return 1
    for page in (ROOT / name for name in PAGES):
        page.write_text(updated(page.read_text(), tables(reports)))
    (ROOT / FIGURE).write_text(what_training_knows(reports["randomise"], reports["randomise_worn"]))
    (ROOT / DELAYS_FIGURE).write_text(falls_over_delay(reports["walk_delays"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
