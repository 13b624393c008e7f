"""The folder of a model card: ``card.json``, ``model.xml``, ``signals.npz`` and ``reproduce.py``.

A figure of the card has a name, a value, a unit, and the recipe by which ``reproduce.py`` computes it again.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sim2real.artifacts.files import make_folder, write_arrays, write_json
from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.posterior import TRANSFORMS
from sim2real.identification.export.document import json_document
from sim2real.identification.export.plain import PlainSimulation
from sim2real.identification.export.reproduce import Card
from sim2real.identification.model import IdentifiableModel
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.artifacts.identification import Estimate, Identification
    from sim2real.identification.export.terms import Delays, Terms

CARD, MODEL, SIGNALS, SCRIPT = "card.json", "model.xml", "signals.npz", "reproduce.py"
ALLOWED = 0.01
"""Largest relative difference between a figure and its value in plain MuJoCo."""
LARGEST_BYTES = 50_000_000
"""Largest size of a card's signals."""
RUNS = ("ahead", "free")
"""Held-out segments of the horizon's length, and free runs."""
_DEVIATIONS = 1.96
"""Half the width of a 95 % interval, in standard deviations."""
_mj: Json = mujoco
Row = tuple[str, float | None, str, dict[str, Json]]
"""Name, value, unit and recipe of a figure."""


def write_card(
    folder: Path,
    identification: Identification,
    model: IdentifiableModel,
    plain: PlainSimulation | None,
    terms: Terms | None,
    delays: Delays,
    about: Sequence[tuple[str, str]],
    session: Mapping[str, Json],
) -> tuple[dict[str, Json], dict[str, np.ndarray]]:
    """Write the card's folder without the page, and return the document and the signals.

    Args:
        plain: The robot in plain MuJoCo; None: the card has no model, and no error of a simulation.
        terms: The robot in MuJoCo's terms; None where no MuJoCo model has it.
        session: Firmware, supply and temperatures that the log holds.
    """
    folder = make_folder(folder)
    signals, notes = card_signals(identification, plain)
    intervals = list(_intervals(identification))
    rows = [*_errors(identification, signals), *_quantiles(signals, identification.units), *intervals]
    rows += [*_sums(identification), *_links(identification)]
    if plain is not None:
        (folder / MODEL).write_text(plain.mjcf, encoding="utf-8")
        rows += _model(plain)
    document = {
        **json_document(identification, terms, delays, about),
        "logs": [{"name": Path(log.path).name, "sha256": log.sha256} for log in identification.logs],
        "session": session,
        "unknown": _unknown(identification, {name.partition(",")[0] for name, *_ in intervals}),
        "notes": notes,
        "simulation": None if plain is None else _simulation(identification, plain, model),
        "figures": [dict(zip(("name", "value", "unit", "recipe"), row, strict=True)) for row in rows],
    }
    write_json(folder / CARD, document)
    write_arrays(folder / SIGNALS, signals)
    shutil.copyfile(Path(__file__).with_name(SCRIPT), folder / SCRIPT)
    # The speed of joints without a measured velocity is a figure whose value the script itself computes.
    if len({f.partition("[")[0] for f in identification.fields}) == 1 and identification.samples:
        card = Card(folder)
        for field in identification.fields:
            recipe = {"kind": "speed", "signal": f"log/{field}", "q": 0.99}
            unit = f"{_unit(identification.units, field)}/s"
            row = {"name": f"{field}, speed, q99", "value": card.value(recipe), "unit": unit, "recipe": recipe}
            document["figures"].append(row)
        write_json(folder / CARD, document)
    return json.loads((folder / CARD).read_text(encoding="utf-8")), signals


def differing(folder: Path) -> list[str]:
    """Return a sentence for each figure that ``reproduce.py`` misses by more than 1 %."""
    card, sentences = Card(folder), []
    for row in card.card["figures"]:
        value = card.value(row["recipe"])
        if not abs(value - row["value"]) <= ALLOWED * max(abs(row["value"]), 1e-12):
            sentences.append(f"{row['name']} is {row['value']:.4g} {row['unit']} here, and {value:.4g} in plain MuJoCo")
    return sentences


def card_signals(
    identification: Identification, plain: PlainSimulation | None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the signals of a card, and a sentence if it has none that an error is computed from.

    Returns:
        ``log/FIELD``, each measurement once, with their ``stamps`` [s]; ``times/KIND/NODE``, in order [s];
        ``link/NAME/delays`` [s] and ``link/NAME/share``; and for each run of ``RUNS`` with R segments: ``recording``,
        ``qpos``, ``qvel``, ``sent_s (R, K)``, ``command/FIELD``, ``row (N,)``, the segment of each measurement,
        ``into (N,)``, its time [s], and ``measured/FIELD (N,)``.
    """
    signals: dict[str, np.ndarray] = {}
    for link in identification.links:
        signals |= {f"link/{link.name}/delays": link.delays, f"link/{link.name}/share": link.share}
    if identification.samples:
        once = identification.disjoint()
        signals |= {f"log/{f}": identification.samples[f"{f}_measured"][once] for f in identification.fields}
        signals["stamps"] = identification.samples["t"][once]
    if (timing := identification.timing) is not None:
        kinds = {"computation": timing.steps_s, "bus": timing.bus_s, "transport": timing.transport_s}
        signals |= {f"times/{kind}/{node}": v for kind, rows in kinds.items() for node, v in rows.items() if v.size}
    # Without a model, without commands, or with too many of them there are no errors of a simulation.
    several, why = [p.name for p in identification.parameters if "@" in p.name], ""
    if plain is None:
        why = "the robot's world has no counterpart in plain MuJoCo"
    elif several:
        why = f"{several[0].partition('@')[0]} differs from recording to recording, and a model has one value"
    elif not identification.replays:
        why = "the identification has no commands (replays.npz); identify again"
    else:
        simulated = _held_out(identification, plain)
        if sum(v.nbytes for v in (signals | simulated).values()) <= LARGEST_BYTES:
            return signals | simulated, []
        why = f"its commands and measurements have more than {LARGEST_BYTES // 10**6} MB"
    return signals, [f"This card has no errors of a simulation that a script can compute: {why}."]


def _held_out(identification: Identification, plain: PlainSimulation) -> dict[str, np.ndarray]:
    """Return commands, initial states and measurements of the held-out segments and of the free runs."""
    signals: dict[str, np.ndarray] = {}
    for run, samples in zip(RUNS, (identification.samples, identification.free), strict=True):
        columns = {n.removeprefix(f"{run}/"): v for n, v in identification.replays.items() if n.startswith(f"{run}/")}
        if not columns or not samples:
            continue
        states = [plain.begin(start) for start in columns["start"]]
        signals[f"{run}/qpos"], signals[f"{run}/qvel"] = (np.stack(rows) for rows in zip(*states, strict=True))
        signals |= {f"{run}/{name}": v for name, v in columns.items() if name not in ("start", "segment", "begin_s")}
        pick = np.isin(samples["segment"], columns["segment"])
        signals[f"{run}/row"] = np.searchsorted(columns["segment"], samples["segment"][pick])
        signals[f"{run}/into"] = samples["into"][pick]
        signals |= {f"{run}/measured/{f}": samples[f"{f}_measured"][pick] for f in identification.fields}
    return signals


def _errors(identification: Identification, signals: Mapping[str, np.ndarray]) -> Iterator[Row]:
    """Yield the errors of the identified model on held-out data: up to each horizon, and in free runs."""
    rows: list[tuple[str, str, Mapping[str, Mapping[str, float | None]], dict[str, Json]]] = [
        ("ahead", f"up to {r.horizon_s:g} s ahead", {"rmse": r.rmse, "mae": r.mae}, {"horizon_s": r.horizon_s})
        for r in identification.prediction
        if r.model == "identified" and r.held_out
    ]
    rows += [
        ("free", f"in a free run of {r.seconds:.3g} s of log {r.recording}",
         {"rmse": {r.field: r.rmse}, "mae": {r.field: r.mae}},
         {"horizon_s": r.seconds + 1.0, "recording": r.recording})
        for r in identification.free_run
        if r.model == "identified"
    ]  # fmt: skip
    for run, how, measures, where in rows:
        for measure, by_field in measures.items():
            for field, value in by_field.items():
                if value is not None and f"{run}/into" in signals:
                    recipe = {"kind": "error", "field": field, "measure": measure, "run": run, **where}
                    yield f"{field}, {measure.upper()} {how}", value, _unit(identification.units, field), recipe


def _quantiles(signals: Mapping[str, np.ndarray], units: Mapping[str, str]) -> Iterator[Row]:
    """Yield the distribution of recorded times, and the range of motion and speed that the log covers."""
    shares = {
        "times": (("q50", 0.5), ("q95", 0.95), ("q99", 0.99)),
        "log": (("lowest", 0.0), ("highest", 1.0)),
    }
    for name, values in signals.items():
        kind, _, owner = name.partition("/")
        if not (finite := values[np.isfinite(values)]).size:
            continue
        title, unit = (owner.replace("/", " of ", 1), "s") if kind == "times" else (owner, _unit(units, owner))
        for label, q in shares.get(kind, ()):
            recipe = {"kind": "quantile", "signal": name, "q": q}
            yield f"{title}, {label}", float(np.quantile(finite, q)), unit, recipe


def _sums(identification: Identification) -> Iterator[Row]:
    parts = [p.name for p in identification.parameters if p.kind == "delay"]
    for p in identification.parameters:
        if p.name == ROUND_TRIP:
            yield "sum of the delays", p.estimate, "s", {"kind": "sum", "parameters": parts}


def _intervals(identification: Identification) -> Iterator[Row]:
    """Yield both ends of the intervals that a Normal distribution on the parameter's scale describes."""
    posterior = identification.posterior
    for p in identification.parameters:
        if p.low95 is None or p.high95 is None or p.low95 == p.high95:
            continue
        if posterior is not None and p.name in posterior.names:
            i = posterior.names.index(p.name)
            scale, mean = posterior.transform[i], float(posterior.mean[i])
            deviation = float(np.sqrt(posterior.covariance[i, i]))
        elif p.name == ROUND_TRIP and p.standard_error is not None:
            scale, mean, deviation = "linear", p.estimate, p.standard_error
        else:
            continue
        ends = [TRANSFORMS[scale][1](mean + k * _DEVIATIONS * deviation, np) for k in (-1.0, 1.0)]
        if all(math.isclose(a, b, rel_tol=ALLOWED) for a, b in zip(ends, (p.low95, p.high95), strict=True)):
            for end, k, value in (("low", -_DEVIATIONS, p.low95), ("high", _DEVIATIONS, p.high95)):
                recipe = {"kind": "interval", "scale": scale, "mean": mean, "deviation": deviation, "deviations": k}
                yield f"{p.name}, {end} end of the 95 % interval", value, p.unit, recipe


def _links(identification: Identification) -> Iterator[Row]:
    """Yield mean and 95th percentile of the delays of links, which ``--links`` estimates from the motion."""
    for link in identification.links:
        for label, q, number in (("mean", None, link.mean), ("q95", 0.95, link.p95)):
            if number.value is not None:
                recipe = {"kind": "distribution", "link": link.name, "q": q}
                yield f"{' + '.join(link.parts)}, {label} of the messages", number.value, "s", recipe


def _model(plain: PlainSimulation) -> Iterator[Row]:
    """Yield the joints' numbers in the model, for a check of ``model.xml``."""
    model = _mj.MjModel.from_xml_string(plain.mjcf)
    for joint in plain.joints:
        for name, unit in (("damping", "N m s/rad"), ("armature", "kg m^2"), ("frictionloss", "N m")):
            if value := float(getattr(model, f"dof_{name}")[model.joint(joint).dofadr[0]]):
                recipe = {"kind": "model", "joint": joint, "field": f"dof_{name}"}
                yield f"{joint}, {name} in the model", value, unit, recipe


def _unknown(identification: Identification, described: set[str]) -> list[str]:
    """Return sentences about what the identification does not determine, and what its log does not cover.

    Args:
        described: Parameters whose intervals are figures of the card.
    """
    sentences = [_doubt(p) for p in identification.parameters if p.kind != "derived" and p.verdict != "ok"]
    if others := [p.name for p in identification.parameters if p.low95 != p.high95 and p.name not in described]:
        sentences.append(
            f"the intervals of {', '.join(others)} are no figures of this card: bounds cut them, or the search widened "
            "them; sim2real identify computes them from the logs"
        )
    sentences += identification.check.messages if identification.check else ()
    return [*sentences, "outside of the motion, the speeds and the temperature of the log, the model extrapolates"]


def _doubt(p: Estimate) -> str:
    if p.verdict == "fixed":
        return f"{p.name} was not identified: it has its nominal value, {p.estimate:.4g} {p.unit}".rstrip()
    return f"{p.name} is {p.verdict}"


def _simulation(identification: Identification, plain: PlainSimulation, model: IdentifiableModel) -> dict[str, Json]:
    """Return the simulation for ``reproduce.py``; a field has 0 for a position or 1 for a velocity, and a joint."""
    sides = {p.name: p.side for p in model.parameters}
    delays = [p for p in identification.parameters if p.kind == "delay"]
    late = {
        side: float(sum(p.estimate for p in delays if sides.get(p.name) == side)) for side in ("command", "measurement")
    }
    fields = {
        name if c.index is None else f"{name}[{c.index}]": (quantity, joint)
        for joint, c in enumerate(model.channels)
        for quantity, (name, _) in enumerate(c.fields)
    }
    return {
        **plain.document(),
        "command_delay_s": late["command"],
        # A world of the graph is busy for 0.999 of its tick: its message leaves that much earlier (BaseWorld).
        "measurement_delay_s": late["measurement"] - 0.001 * plain.tick_s,
        "settle_s": identification.settle_s,
        "fields": fields,
    }


def _unit(units: Mapping[str, str], field: str) -> str:
    return units.get(field, units.get(field.partition("[")[0], ""))
