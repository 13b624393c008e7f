"""The figures of a model card, each with the recipe by which ``reproduce.py`` computes it again."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.posterior import TRANSFORMS
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.artifacts.identification import Estimate, Identification
    from sim2real.identify.export.card.plain import PlainSimulation
    from sim2real.identify.export.card.reproduce import Card

_mj: Json = mujoco
_DEVIATIONS = 1.96
"""Half the width of a 95 % interval, in standard deviations."""
_SAME = 0.01
"""Largest relative difference between an interval's end and the Normal distribution that describes it."""
_QUANTILES = (0.5, 0.95, 0.99)


def figure(name: str, value: float, unit: str, recipe: Mapping[str, Json]) -> dict[str, Json]:
    """Return a figure of the card as JSON."""
    return {"name": name, "value": value, "unit": unit, "recipe": dict(recipe)}


def intervals(identification: Identification) -> Iterator[dict[str, Json]]:
    """Yield both ends of the intervals that a Normal distribution on the parameter's scale describes."""
    posterior = identification.posterior
    for p in identification.parameters:
        if p.low95 is None or p.high95 is None or p.low95 == p.high95:
            continue
        if posterior is not None and p.name in posterior.names:
            place = posterior.names.index(p.name)
            scale, mean = posterior.transform[place], float(posterior.mean[place])
            deviation = float(np.sqrt(posterior.covariance[place, place]))
        elif p.name == ROUND_TRIP and p.standard_error is not None:
            scale, mean, deviation = "linear", p.estimate, p.standard_error
        else:
            continue
        ends = [TRANSFORMS[scale][1](mean + k * _DEVIATIONS * deviation, np) for k in (-1.0, 1.0)]
        if all(math.isclose(a, b, rel_tol=_SAME) for a, b in zip(ends, (p.low95, p.high95), strict=True)):
            for end, k, value in (("low", -_DEVIATIONS, p.low95), ("high", _DEVIATIONS, p.high95)):
                recipe = {"kind": "interval", "scale": scale, "mean": mean, "deviation": deviation, "deviations": k}
                yield figure(f"{p.name}, {end} end of the 95 % interval", value, p.unit, recipe)


def sums(identification: Identification) -> Iterator[dict[str, Json]]:
    """Yield the sum of the delays."""
    trips = [p for p in identification.parameters if p.name == ROUND_TRIP]
    for p in trips:
        parts = [q.name for q in identification.parameters if q.kind == "delay"]
        yield figure("sum of the delays", p.estimate, "s", {"kind": "sum", "parameters": parts})


def distributions(identification: Identification) -> Iterator[dict[str, Json]]:
    """Yield mean and 95th percentile of the delays of links, which ``--links`` estimates from the motion."""
    for link in identification.links:
        total = " + ".join(link.parts)
        for label, q, number in (("mean", None, link.mean), ("q95", 0.95, link.p95)):
            if number.value is not None:
                recipe = {"kind": "distribution", "link": link.name, "q": q}
                yield figure(f"{total}, {label} of the messages", number.value, "s", recipe)


def of_joints(plain: PlainSimulation) -> Iterator[dict[str, Json]]:
    """Yield the joints' numbers in the model, for a check of ``model.xml``."""
    model = _mj.MjModel.from_xml_string(plain.mjcf)
    for joint in plain.joints:
        for name, unit in (("damping", "N m s/rad"), ("armature", "kg m^2"), ("frictionloss", "N m")):
            value = float(getattr(model, f"dof_{name}")[model.joint(joint).dofadr[0]])
            if value:
                recipe = {"kind": "model", "joint": joint, "field": f"dof_{name}"}
                yield figure(f"{joint}, {name} in the model", value, unit, recipe)


def quantiles(signals: Mapping[str, np.ndarray], units: Mapping[str, str]) -> Iterator[dict[str, Json]]:
    """Yield the distribution of recorded times, and the range of motion and speed that the log covers."""
    for name, values in signals.items():
        kind, _, owner = name.partition("/")
        finite = values[np.isfinite(values)]
        if kind not in ("times", "log") or not finite.size:
            continue
        about = ((f"q{100 * q:g}", q) for q in _QUANTILES) if kind == "times" else (("lowest", 0.0), ("highest", 1.0))
        unit = "s" if kind == "times" else units.get(owner, units.get(owner.partition("[")[0], ""))
        title = owner.replace("/", " of ", 1) if kind == "times" else owner
        for label, q in about:
            recipe = {"kind": "quantile", "signal": name, "q": q}
            yield figure(f"{title}, {label}", float(np.quantile(finite, q)), unit, recipe)


def speeds(identification: Identification, card: Card) -> Iterator[dict[str, Json]]:
    """Yield the speed of each position whose velocity was not measured, from differences of the positions."""
    measured = {f.partition("[")[0] for f in identification.fields}
    if len(measured) == 1 and identification.samples:
        for field in identification.fields:
            recipe = {"kind": "speed", "signal": f"log/{field}", "q": 0.99}
            yield figure(f"{field}, speed, q99", card.value(recipe), f"{_unit(identification, field)}/s", recipe)


def errors(identification: Identification, runs: Sequence[str]) -> Iterator[dict[str, Json]]:
    """Yield the errors of the identified model on held-out data: up to each horizon, and in free runs.

    Args:
        runs: The runs whose signals the card has.
    """
    rows = [
        (field, f"up to {row.horizon_s:g} s ahead", measure, value, {"run": "ahead", "horizon_s": row.horizon_s})
        for row in identification.prediction
        if row.model == "identified" and row.held_out
        for measure, by_field in (("rmse", row.rmse), ("mae", row.mae))
        for field, value in by_field.items()
    ]
    rows += [
        (row.field, f"in a free run of {row.seconds:.3g} s of log {row.recording}", measure, value,
         {"run": "free", "horizon_s": row.seconds + 1.0, "recording": row.recording})
        for row in identification.free_run
        if row.model == "identified"
        for measure, value in (("rmse", row.rmse), ("mae", row.mae))
    ]  # fmt: skip
    for field, reach, measure, value, where in rows:
        if value is not None and where["run"] in runs:
            recipe = {"kind": "error", "field": field, "measure": measure, **where}
            yield figure(f"{field}, {measure.upper()} {reach}", value, _unit(identification, field), recipe)


def limits(identification: Identification, described: Sequence[Mapping[str, Json]]) -> list[str]:
    """Return sentences about what the identification does not determine, and what its log does not cover.

    Args:
        described: The figures of ``intervals``.
    """
    undetermined = [_sentence(p) for p in identification.parameters if p.kind != "derived" and p.verdict != "accepted"]
    names = {row["name"].partition(",")[0] for row in described}
    others = [p.name for p in identification.parameters if p.low95 != p.high95 and p.name not in names]
    if others:
        undetermined.append(
            f"the intervals of {', '.join(others)} are no figures of this card: bounds cut them, or the search widened "
            "them; sim2real identify computes them from the logs"
        )
    outside = "outside of the motion, the speeds and the temperature of the log, the model extrapolates"
    return [*undetermined, *(identification.check.messages if identification.check else ()), outside]


def _sentence(p: Estimate) -> str:
    if p.verdict == "fixed":
        return f"{p.name} was not identified: it has its nominal value, {p.estimate:.4g} {p.unit}".rstrip()
    return f"{p.name} is {p.verdict}"


def _unit(identification: Identification, field: str) -> str:
    return identification.units.get(field, identification.units.get(field.partition("[")[0], ""))
