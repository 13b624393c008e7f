"""What identify writes and prints: ``parameters.json`` and its table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.identify.fit import Fit
from sim2real.identify.identifiability import Check
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.prediction import position_of
from sim2real.identify.problem import Problem
from sim2real.identify.round_trip import RoundTrip
from sim2real.identify.uncertainty import Uncertainty, sum_of
from sim2real.identify.verdict import Position, Score, Verdict
from sim2real.stages.console import note, table
from sim2real.stages.manifest import sha256
from sim2real.stages.runs import portable

ROUND_TRIP = "round_trip_delay"


def document(
    pipeline: str,
    logs: Sequence[Path],
    run_dir: Path,
    found: Fit,
    spread: Uncertainty,
    check: Check,
    verdict: Verdict,
    trip: RoundTrip | None,
    truth: Mapping[str, float],
) -> dict[str, Any]:
    """Return what an identification found, as JSON takes it; logs in the run folder are named relative to it."""
    names = list(found.problem.table.names)
    return {
        "format": 2,
        "pipeline": pipeline,
        **hashed(logs, run_dir),
        "verdict": {"status": verdict.status, "reasons": list(verdict.reasons), "flags": verdict.flags},
        "parameters": _rows(found, spread, trip, truth),
        "covariance": {"names": names, "matrix": spread.covariance.tolist()},
        "correlation": {"names": names, "matrix": spread.correlation.tolist()},
        "residual_inflation": spread.inflation,
        "misfit": spread.misfit,
        "check": {
            "condition": check.condition,
            "undetermined": [list(g) for g in check.undetermined],
            "messages": list(check.messages),
            "standard_error_per_minute": dict(zip(names, check.per_minute.tolist(), strict=True)),
        },
        "search": {
            "strategy": found.problem.config.strategy if found.search else None,
            "history": found.search.history.tolist() if found.search else [],
            "evaluations": found.search.evaluations if found.search else 0,
            "refined": [{"before": r.before, "after": r.loss, "steps": r.steps} for r in found.refined],
        },
    }


def hashed(logs: Sequence[Path], run_dir: Path) -> dict[str, Any]:
    """Return which logs were used, as JSON takes it; those in the run folder by their place in it."""
    hashes = [{"path": portable(p, run_dir), "sha256": sha256(p)} for p in logs]
    return {"log": hashes[0], "logs": hashes}


def positions(problem: Problem, units: Mapping[str, str]) -> list[Position]:
    """Return the measured positions, which the verdict judges one by one."""
    return [
        Position(position_of(c), c.name, units.get(c.position, ""), c.position_sigma) for c in problem.model.channels
    ]


def scored(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Return how far each position is off on held-out data, the worst first, as JSON takes it."""
    return [
        {
            "name": s.position.name,
            "column": s.position.column,
            "unit": s.position.unit,
            "horizon_s": s.horizon_s,
            "rmse": {m: e if math.isfinite(e) else None for m, e in {"identified": s.own, **s.others}.items()},
            "beaten_by": s.beaten_by,
        }
        for s in scores
    ]


def quantities(parameters: ParameterTable) -> list[tuple[str, str, list[str]]]:
    """Return what several recordings are compared by: name, unit and the parameters whose sum it is."""
    free = [p for p in parameters if p.free and not p.per_recording]
    delays = [p.name for p in free if p.kind == "delay"]
    rows = [(p.name, p.unit, [p.name]) for p in free if p.kind != "delay" or len(delays) == 1]
    return rows + ([(ROUND_TRIP, "s", delays)] if len(delays) > 1 else [])


def error_of(found: Fit, spread: Uncertainty, parts: Sequence[str]) -> float:
    """Return the standard error of a sum of parameters."""
    return sum_of(spread, [found.problem.table.names.index(n) for n in parts])


def show(found: Mapping[str, Any]) -> None:
    """Print the parameters, and what stands in the way of trusting them."""
    rows = []
    for p in found["parameters"]:
        off = "" if p["truth"] is None else f"{100 * (p['estimate'] / p['truth'] - 1):+.1f} %"
        interval = f"[{p['low95']:.4g}, {p['high95']:.4g}]"
        rows.append([p["name"], p["estimate"], interval, p["unit"], p["nominal"], p["truth"], off, p["verdict"]])
    print(table(rows, ["parameter", "estimate", "95 % interval", "unit", "nominal", "truth", "off by", "verdict"]))
    if found["aggregate"]:
        each = [
            [a["name"], a["mean"], f"[{a['low95']:.4g}, {a['high95']:.4g}]", a["unit"], a["between"], a["agree"]]
            for a in found["aggregate"]
        ]
        print(table(each, ["over recordings", "mean", "95 % of the next", "unit", "spread", "agree"]))
    if judged := found["held_out"]:
        models = list(dict.fromkeys(m for row in judged for m in row["rmse"]))
        errors = [[row["name"], *(row["rmse"].get(m) for m in models), row["unit"]] for row in judged]
        print(table(errors, [f"off {judged[0]['horizon_s']:g} s ahead, held out", *models, "unit"]))
    note(f"verdict: {found['verdict']['status']}")
    for reason in found["verdict"]["reasons"]:
        note(f"  {reason}")
    if found["verdict"]["next"]:
        note(f"next: {found['verdict']['next']}")


def summary(found: Mapping[str, Any], logs: Sequence[str]) -> dict[str, Any]:
    """Return the few lines that the console shows at the end; of several positions the worst."""
    total = next((p for p in found["parameters"] if p["name"] == ROUND_TRIP), None)
    worst = found["held_out"][0] if found["held_out"] else {"name": "", "column": "", "unit": "", "rmse": {}}
    name, unit = worst["name"], f" {worst['unit']}".rstrip()
    if len(found["held_out"]) > 1:
        name += f", the worst of {len(found['held_out'])}"
    free: dict[str, list[float]] = {}
    for row in found["free_run"]:
        if row["field"] == worst["column"] and row["model"] in ("identified", "hold"):
            free.setdefault(row["model"], []).append(row["rmse"])
    return {
        "log": logs[0] if len(logs) == 1 else f"{len(logs)} logs, the first {logs[0]}",
        **({"round trip delay": f"{1e3 * total['estimate']:.1f} ms"} if total else {}),
        **({"position": f"{name}, on held-out data"} if name else {}),
        **{
            f"{model}, {worst['horizon_s']:g} s ahead": f"{e:.4f}{unit}"
            for model, e in worst["rmse"].items()
            if e is not None
        },
        **{f"{model}, free run": f"{np.mean(e):.4f}{unit}" for model, e in free.items()},
        "verdict": found["verdict"]["status"],
        "search": f"{found['search']['evaluations']} candidates in {found['search']['seconds']:.0f} s",
    }


def _rows(found: Fit, spread: Uncertainty, trip: RoundTrip | None, truth: Mapping[str, float]) -> list[dict[str, Any]]:
    parameters = found.problem.table
    rows = []
    for i, column in enumerate(parameters.columns):
        p = column.parameter
        value = np.ravel(found.values[p.name])[column.recording or 0]
        rows.append(
            {
                "name": column.label,
                "unit": p.unit,
                "kind": p.kind,
                "about": p.about,
                "nominal": p.nominal,
                "estimate": float(value),
                "standard_error": float(spread.standard_error[i]),
                "low95": float(spread.low[i]),
                "high95": float(spread.high[i]),
                "lower": p.low,
                "upper": p.high,
                "verdict": spread.verdict[i],
                "truth": truth.get(p.name),
            }
        )
    rows += [
        {
            **{"name": p.name, "unit": p.unit, "kind": p.kind, "about": p.about, "nominal": p.nominal},
            **{"estimate": p.nominal, "standard_error": 0.0, "low95": p.nominal, "high95": p.nominal},
            **{"lower": p.low, "upper": p.high, "verdict": "fixed", "truth": truth.get(p.name)},
        }
        for p in parameters
        if not p.free
    ]
    return rows + ([_round_trip(trip, truth)] if trip else [])


def _round_trip(trip: RoundTrip, truth: Mapping[str, float]) -> dict[str, Any]:
    """Return the row of the sum of all delays: what a log tells even where it cannot tell them apart."""
    return {
        "name": ROUND_TRIP,
        "unit": "s",
        "kind": "derived",
        "about": " + ".join([*trip.parts, *trip.held]),
        "nominal": 0.0,
        "estimate": trip.estimate,
        "standard_error": trip.standard_error,
        "low95": trip.low,
        "high95": trip.high,
        "lower": trip.lower,
        "upper": trip.upper,
        "verdict": trip.verdict,
        "truth": truth.get(ROUND_TRIP),
    }
