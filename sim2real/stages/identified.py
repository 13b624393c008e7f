"""What identify writes and prints: ``parameters.json`` and its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.identify.fit import Fit
from sim2real.identify.identifiability import Check
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.uncertainty import Uncertainty, sum_of
from sim2real.identify.verdict import Verdict
from sim2real.stages.console import note, table
from sim2real.stages.manifest import sha256
from sim2real.stages.runs import portable

ROUND_TRIP = "round_trip_delay"
SURE_S = 0.005
"""A round trip with a larger standard error is not identified [s]."""


def document(
    pipeline: str,
    logs: Sequence[Path],
    run_dir: Path,
    found: Fit,
    spread: Uncertainty,
    check: Check,
    verdict: Verdict,
    truth: Mapping[str, float],
) -> dict[str, Any]:
    """Return what an identification found, as JSON takes it; logs in the run folder are named relative to it."""
    names = list(found.problem.table.names)
    hashes = [{"path": portable(p, run_dir), "sha256": sha256(p)} for p in logs]
    return {
        "format": 2,
        "pipeline": pipeline,
        "log": hashes[0],
        "logs": hashes,
        "verdict": {"status": verdict.status, "reasons": list(verdict.reasons)},
        "parameters": _rows(found, spread, truth),
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
    note(f"verdict: {found['verdict']['status']}")
    for reason in found["verdict"]["reasons"]:
        note(f"  {reason}")


def summary(found: Mapping[str, Any], logs: Sequence[str], horizon_s: float) -> dict[str, Any]:
    """Return the few lines that the console shows at the end."""
    last = [e for e in found["prediction"] if e["held_out"] and e["horizon_s"] == round(horizon_s, 3) and e["rmse"]]
    total = next((p for p in found["parameters"] if p["name"] == ROUND_TRIP), None)
    free = {}
    for row in found["free_run"]:
        if row["field"] == found["free_run"][0]["field"] and row["model"] in ("identified", "hold"):
            free.setdefault(row["model"], []).append(row["rmse"])
    return {
        "log": logs[0] if len(logs) == 1 else f"{len(logs)} logs, the first {logs[0]}",
        **({"round trip delay": f"{1e3 * total['estimate']:.1f} ms"} if total else {}),
        **{f"{e['model']}, {horizon_s:g} s ahead": f"{e['rmse']:.4f} (held out)" for e in last},
        **{f"{model}, free run": f"{np.mean(e):.4f} (held out)" for model, e in free.items()},
        "verdict": found["verdict"]["status"],
        "search": f"{found['search']['evaluations']} candidates in {found['search']['seconds']:.0f} s",
    }


def _rows(found: Fit, spread: Uncertainty, truth: Mapping[str, float]) -> list[dict[str, Any]]:
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
    delays = [c.label for c in parameters.columns if c.parameter.kind == "delay"]
    return rows + ([_round_trip(found, spread, delays, truth)] if delays else [])


def _round_trip(found: Fit, spread: Uncertainty, delays: list[str], truth: Mapping[str, float]) -> dict[str, Any]:
    """Return the row of the sum of all delays: what a log tells even where it cannot tell them apart."""
    parameters = found.problem.table
    error = error_of(found, spread, delays)
    fixed = [p for p in parameters if p.kind == "delay" and not p.free]
    total = sum(float(np.ravel(found.values[n])[0]) for n in delays) + sum(p.nominal for p in fixed)
    return {
        "name": ROUND_TRIP,
        "unit": "s",
        "kind": "derived",
        "about": " + ".join([*delays, *(p.name for p in fixed)]),
        "nominal": 0.0,
        "estimate": total,
        "standard_error": error,
        "low95": total - 1.96 * error,
        "high95": total + 1.96 * error,
        "lower": sum(parameters[n].low for n in delays),
        "upper": sum(parameters[n].high for n in delays),
        "verdict": "accepted" if error < SURE_S else "not identifiable",
        "truth": truth.get(ROUND_TRIP),
    }
