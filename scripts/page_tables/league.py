"""The league's tables: errors on held-out parts beside those of the others, and beside the bounds promised before."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real.artifacts.estimation.promise import FREE_RUN, Promise
from sim2real.stages.estimation.predicted_logs import LEAST_PARTS
from sim2real.stages.estimation.promises import further

LEAGUE_SETS = {
    "disk": "motor with eccentric mass, RMSE",
    "xl330": "DYNAMIXEL XL330, MAE",
    "so101": "SO-101 arm, joints that move, RMSE",
    "go2": "Unitree Go2 in the air, RMSE",
    "sts3250": "Feetech STS3250, MAE",
    "emps": "EMPS linear axis, RMSE",
}
"""Sets of a report with these names; others have their folder's name."""
LEAGUE_ENTRANTS = {
    "sysid": "mujoco.sysid",
    "sysid_delay": "mujoco.sysid with a delay",
    "pace": "PACE",
    "bam_m1": "BAM M1",
    "bam_m6": "BAM M6",
    "textbook": "textbook servo",
    "published": "best published set",
}


def league(report: Mapping[str, Any]) -> str:
    """Return the table of the league, one line for each set, and a sentence for each that another entrant wins."""
    lines = [
        ("held out, mean", "sim2real", "worst fold (promised)", "worst joint", "time", *LEAGUE_ENTRANTS.values()),
        ("---", *["---:"] * (4 + len(LEAGUE_ENTRANTS))),
    ]
    lost = []
    for name in _sets(report):
        folds = {f["fold"] for f in report["folds"] if f["set"] == name}
        seconds = [f["seconds"] for f in report["folds"] if (f["set"], f["entrant"]) == (name, "ours") and f["seconds"]]
        means, joint = (_errors(report, name, what) for what in ("mean", "worst_joint"))
        took = f"{statistics.median(seconds):.0f} s" if seconds else "-"
        others = (_short(means.get(entrant)) for entrant in LEAGUE_ENTRANTS)
        count, unit = f"{len(folds)} fold{'s' * (len(folds) > 1)}", _unit(report, name)
        ours = _short(means.get("ours")), _worst(report, name), _short(joint.get("ours"))
        lines.append((f"{LEAGUE_SETS.get(name, name)}, {count} [{unit}]", *ours, took, *others))
        better = [
            f"{LEAGUE_ENTRANTS[e]} ({_short(means[e])} {unit})"
            for e in sorted(means, key=lambda e: means[e])
            if "ours" in means and means[e] < means["ours"]
        ]
        if better:
            lost.append(f"\nBetter than sim2real on the set {LEAGUE_SETS.get(name, name)}: {', '.join(better)}.\n")
    return "".join("| " + " | ".join(line) + " |\n" for line in lines) + "".join(lost)


def league_promises(report: Mapping[str, Any]) -> str:
    """Return the ledger of the league's folds: each error of sim2real beside its bound, the largest ratio first."""
    rows = [row for name in _sets(report) for row in promises(report, name)]
    counts = [sum(row.kept == how for row in rows) for how in ("yes", "no")]
    bounded = sum(row.bound is not None for row in rows)
    lines: list[tuple[str, ...]] = [
        ("held out", "part", "promised", "shown", "ratio", "kept"),
        ("---", "---", *["---:"] * 3, "---"),
    ]
    for row in sorted(rows, key=lambda row: -(row.ratio or 0.0)):
        if row.ratio is not None:
            sizes = (f"{_short(size)} {row.unit}" for size in (row.bound, row.error))
            lines.append((row.name, row.source, *sizes, f"{row.ratio:.2f}", row.kept))
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    return f"{text}\n{counts[0]} of {bounded} errors are below their bounds, {counts[1]} above 1.25 times the bound.\n"


def promises(report: Mapping[str, Any], name: str) -> list[Promise]:
    """Return the error of sim2real on each fold of a set, beside the bound that follows from the other folds."""
    folds = [f for f in report["folds"] if (f["set"], f["entrant"]) == (name, "ours") and f["value"] is not None]
    errors, label = np.array([f["value"] for f in folds]), LEAGUE_SETS.get(name, name)
    rows = []
    for i, fold in enumerate(folds):
        others = np.delete(errors, i)
        bound = further(others) if others.size >= LEAST_PARTS else None
        error = float(errors[i])
        rows.append(Promise(fold["fold"], False, name, label, _unit(report, name), FREE_RUN, 0.0, error, bound))
    return rows


def _worst(report: Mapping[str, Any], name: str) -> str:
    """Return the largest error of sim2real over the folds of a set, and its bound."""
    rows = promises(report, name)
    if not rows:
        return "-"
    worst = max(rows, key=lambda row: row.error or 0.0)
    return _short(worst.error) + ("" if worst.bound is None else f" ({_short(worst.bound)})")


def _unit(report: Mapping[str, Any], name: str) -> str:
    return next("mm" if r["unit"] == "mm" else "mrad" for r in report["rows"] if r["name"].split("/")[1] == name)


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _sets(report: Mapping[str, Any]) -> list[str]:
    """Return the sets of a report, those of the list first."""
    there = dict.fromkeys(f["set"] for f in report["folds"])
    return [*(n for n in LEAGUE_SETS if n in there), *(n for n in there if n not in LEAGUE_SETS)]


def evidence(ideal: Mapping[str, Any], judged: Mapping[str, Any]) -> str:
    """Return README's table: what sim2real reaches beside the best of the others, then the set that it loses."""
    share = {r["name"].removeprefix("randomise/"): 100 * r["value"] for r in ideal["rows"] if r["value"] is not None}
    count, trials = len(ideal["robots"]), ideal["flags"]["trials"]
    lines = [
        ("measured on", "sim2real", "worst part (promised)", "compared with"),
        ("---", "---:", "---:", "---:"),
        (
            f"success on {count} nearly ideal robots with hidden parameters and delays, {trials} deployments each",
            f"{share['all/success']:.0f} %",
            "",
            f"{share['data_sheet/success']:.0f} % trained on the data sheet",
        ),
    ]
    sets = {name: _errors(judged, name, "mean") for name in LEAGUE_SETS}
    lost = []
    for name, errors in sets.items():
        if len(errors) < 2 or "ours" not in errors:
            continue
        unit = "mm" if name == "emps" else "mrad"
        best = min((e for e in errors if e != "ours"), key=lambda e: errors[e])
        line = (
            f"{LEAGUE_SETS[name]}, mean over held-out parts",
            f"{errors['ours']:.1f} {unit}",
            _worst(judged, name),
            f"{errors[best]:.1f} {unit} by {LEAGUE_ENTRANTS[best]}",
        )
        (lines if errors["ours"] < errors[best] else lost).append(line)
    text = "".join("| " + " | ".join(line) + " |\n" for line in lines)
    text += "\nIn brackets: the bound that follows from the errors on the other parts, 95 % of errors are below it.\n"
    return text + "".join(f"\nsim2real loses on {what}: {ours} against {other}.\n" for what, ours, _, other in lost)


def _errors(judged: Mapping[str, Any], name: str, what: str) -> dict[str, float]:
    """Return entrant -> error on a set of the league [mrad, mm]; the published sets are one entrant, with the least."""
    errors: dict[str, float] = {}
    for row in judged["rows"]:
        _, of, entrant, kind = row["name"].split("/")
        if (of, kind) == (name, what) and row["value"] is not None:
            entrant = entrant.partition("_")[0] if entrant.startswith("published") else entrant
            value = (1e3 if row["unit"] == "rad" else 1.0) * row["value"]
            errors[entrant] = min(value, errors.get(entrant, value))
    return errors
