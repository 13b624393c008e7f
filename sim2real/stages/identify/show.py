"""What identify prints: tables of estimates, errors and links, and the summary of the stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim2real.artifacts.estimation.links import Link
from sim2real.artifacts.files import number
from sim2real.artifacts.identification import ROUND_TRIP, Estimate, Identification
from sim2real.stages.terminal.console import note, table


def show(identification: Identification) -> None:
    """Print the estimates, held-out errors, links and the verdict."""
    rows = []
    for p in identification.parameters:
        interval = "" if p.low95 is None else f"[{p.low95:.4g}, {number(p.high95):.4g}]"
        rows.append([p.name, p.estimate, interval, p.unit, p.nominal, p.truth, _off(p), p.verdict])
    print(table(rows, ["parameter", "estimate", "95 % interval", "unit", "nominal", "truth", "off by", "verdict"]))
    if identification.aggregate:
        rows = [
            [a.name, a.mean, f"[{a.low95:.4g}, {a.high95:.4g}]", a.unit, a.between, a.agree]
            for a in identification.aggregate
        ]
        print(table(rows, ["over recordings", "mean", "95 % of the next", "unit", "spread", "agree"]))
    if identification.posterior is not None and identification.posterior.others:
        rows = [[o.about, f"{100 * o.weight:.0f} %"] for o in identification.posterior.others]
        print(table(rows, ["explains the recordings as well", "share of the draws"]))
    if held_out := identification.held_out:
        models = list(dict.fromkeys(m for row in held_out for m in row.rmse))
        rows = [[row.name, *(row.rmse.get(m) for m in models), row.unit] for row in held_out]
        print(table(rows, [f"off {held_out[0].horizon_s:g} s ahead, held out", *models, "unit"]))
    if identification.links:
        print(link_table(identification.links))
    note(f"verdict: {identification.verdict.status}")
    for reason in identification.verdict.reasons:
        note(f"  {reason}")
    if identification.verdict.next:
        note(f"next: {identification.verdict.next}")


def _off(p: Estimate) -> str:
    """Return the distance of an estimate from the true value: in percent, or in the unit if the true value is 0."""
    if p.truth is None:
        return ""
    return f"{100 * (p.estimate / p.truth - 1):+.1f} %" if p.truth else f"{p.estimate:+.2g} {p.unit}"


def link_table(links: Sequence[Link]) -> str:
    """Return a table of links: one row a number, with its 95 % interval."""
    rows = [
        [name, factor * number(r.value), f"[{factor * number(r.low95):.4g}, {factor * number(r.high95):.4g}]", unit]
        for link in links
        for name, r, factor, unit in link.rows()
    ]
    return table(rows, ["link", "estimate", "95 % interval", "unit"])


def summary(identification: Identification) -> dict[str, str]:
    """Return the lines that the console shows at the end: name -> text. Of several positions it is the worst one."""
    logs, search = identification.logs, identification.search
    lines = {"log": logs[0].path if len(logs) == 1 else f"{len(logs)} logs, the first {logs[0].path}"}
    if total := next((p for p in identification.parameters if p.name == ROUND_TRIP), None):
        lines["round trip delay"] = f"{1e3 * total.estimate:.1f} ms"
    if identification.held_out:
        worst = identification.held_out[0]
        count, unit = len(identification.held_out), f" {worst.unit}".rstrip()
        which = worst.name + (f", the worst of {count}" if count > 1 else "")
        lines["position"] = f"{which}, on held-out data"
        for model, error in worst.rmse.items():
            if error is not None:
                lines[f"{model}, {worst.horizon_s:g} s ahead"] = f"{error:.4f}{unit}"
        for model in ("identified", "hold"):
            runs = [r for r in identification.free_run if r.field == worst.column and r.model == model]
            if runs:
                lines[f"{model}, free run"] = f"{np.mean([number(r.rmse) for r in runs]):.4f}{unit}"
    lines["verdict"] = identification.verdict.status
    lines["search"] = f"{search.evaluations} candidates in {number(search.seconds):.0f} s"
    return lines
