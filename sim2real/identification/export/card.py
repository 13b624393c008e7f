"""The folder of a model card: ``card.json``, ``model.xml``, ``signals.npz`` and ``reproduce.py``.

A figure of the card is an error of the simulation or a quantile of a signal. It has a name, a value, a unit, and the
recipe by which ``reproduce.py`` computes it again.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim2real.artifacts.files import make_folder, write_arrays, write_json
from sim2real.identification.export.reproduce import Card
from sim2real.identification.model import IdentifiableModel, PlainSimulation
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.artifacts.identification import Identification
    from sim2real.identification.export.terms import Delays, Terms

CARD, MODEL, SIGNALS, SCRIPT = "card.json", "model.xml", "signals.npz", "reproduce.py"
FORMAT = 1
ALLOWED = 0.01
"""Largest relative difference between a figure and its value in plain MuJoCo."""
LARGEST_BYTES = 50_000_000
"""Largest size of a card's signals."""
RUNS = ("ahead", "free")
"""Kinds of predictions: held-out segments as long as the horizon, and free runs."""
_COLUMNS = (
    *("name", "unit", "kind", "about", "estimate", "standard_error"),
    *("low95", "high95", "lower", "upper", "state"),
)
_QUANTILES = {
    "times": (("q50", 0.5), ("q95", 0.95), ("q99", 0.99)),
    "log": (("lowest", 0.0), ("highest", 1.0)),
}
"""Kind of a signal -> its quantiles that are figures."""


def json_document(
    identification: Identification, terms: Terms | None, delays: Delays, about: Sequence[tuple[str, str]]
) -> dict[str, Json]:
    """Return all results, for programs; docs/guides/export.md describes the document.

    Args:
        terms: The robot in MuJoCo's terms; None if the robot has no MuJoCo model.
    """
    mujoco = ("timestep_s", "joints", "bodies", "unexpressed")
    return {
        "format": FORMAT,
        "about": dict(about),
        "verdict": {"status": identification.verdict.status, "reasons": identification.verdict.reasons},
        "parameters": [{n: getattr(p, n) for n in _COLUMNS} for p in identification.parameters],
        "posterior": identification.posterior,
        "delays_s": delays,
        "links": identification.links,
        "mujoco": {n: getattr(terms, n) for n in mujoco} if terms else None,
    }


def write_card(
    folder: Path,
    identification: Identification,
    model: IdentifiableModel,
    plain: PlainSimulation | None,
    document: Mapping[str, Json],
    session: Mapping[str, Json],
) -> tuple[dict[str, Json], dict[str, np.ndarray]]:
    """Write the card's folder without its page; return the document and the signals.

    Args:
        plain: The robot in plain MuJoCo; None: the card has no model, and no error of a simulation.
        document: The results, as ``json_document`` returns them.
        session: Firmware, supply and temperatures that the log holds.
    """
    folder = make_folder(folder)
    signals, notes = card_signals(identification, plain)
    card = {
        **document,
        "logs": [{"name": Path(log.path).name, "sha256": log.sha256} for log in identification.logs],
        "session": session,
        "unknown": _unknown(identification),
        "notes": notes,
        "simulation": None if plain is None else _simulation(identification, plain, model),
        "figures": list(_figures(identification, signals)),
    }
    if plain is not None:
        (folder / MODEL).write_text(plain.mjcf, encoding="utf-8")
    write_json(folder / CARD, card)
    write_arrays(folder / SIGNALS, signals)
    shutil.copyfile(Path(__file__).with_name(SCRIPT), folder / SCRIPT)
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
    """Return the signals of a card, and a sentence if they do not suffice to compute an error.

    Returns:
        ``log/FIELD``, each measurement once; ``times/KIND/NODE``, in order [s]; and for each run of ``RUNS`` with R
        segments: ``recording``, ``qpos``, ``qvel``, ``sent_s (R, K)``, ``command/FIELD``, ``row (N,)``, the segment of
        each measurement, ``into (N,)``, its time [s], and ``measured/FIELD (N,)``.
    """
    signals: dict[str, np.ndarray] = {}
    if identification.samples:
        once = identification.disjoint()
        signals |= {f"log/{f}": identification.samples[f"{f}_measured"][once] for f in identification.fields}
    if (timing := identification.timing) is not None:
        kinds = {"computation": timing.steps_s, "bus": timing.bus_s, "transport": timing.transport_s}
        signals |= {f"times/{kind}/{node}": v for kind, rows in kinds.items() for node, v in rows.items() if v.size}
    # Without a model, without commands, or with too many of them there are no errors of a simulation.
    if plain is None:
        why = "the robot's world has no counterpart in plain MuJoCo"
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


def _figures(identification: Identification, signals: Mapping[str, np.ndarray]) -> Iterator[dict[str, Json]]:
    """Yield the figures: errors up to each horizon and in free runs, times, ranges of motion."""
    units = identification.units
    for how, samples, pick, where in _runs(identification):
        for field in identification.fields:
            off = (samples[f"{field}_identified"] - samples[f"{field}_measured"])[pick]
            if off.size and np.isfinite(off).all() and f"{where['run']}/into" in signals:
                error = float(np.sqrt(np.mean(off**2)))
                yield _figure(f"{field}, RMSE {how}", error, _unit(units, field), {"field": field, **where})
    for name, values in signals.items():
        kind, _, owner = name.partition("/")
        finite = values[np.isfinite(values)]
        title, unit = (owner.replace("/", " of ", 1), "s") if kind == "times" else (owner, _unit(units, owner))
        for label, q in _QUANTILES.get(kind, ()) if finite.size else ():
            yield _figure(f"{title}, {label}", float(np.quantile(finite, q)), unit, {"signal": name, "q": q})


def _runs(
    identification: Identification,
) -> Iterator[tuple[str, Mapping[str, np.ndarray], np.ndarray, dict[str, Json]]]:
    """Yield for each kind of prediction of held-out parts: its words, columns, the rows that count, and a recipe."""
    for run, samples in zip(RUNS, (identification.samples, identification.free), strict=True):
        if not samples:
            continue
        ahead = samples["into"] - identification.internal.settle_s
        counts = samples["held_out"].astype(bool) & (ahead > 0.0)
        if run == "ahead":
            for horizon_s in sorted({row.seconds for row in identification.errors if not row.log}):
                how, where = f"up to {horizon_s:g} s ahead", {"run": run, "horizon_s": horizon_s}
                yield how, samples, counts & (ahead <= horizon_s), where
            continue
        for recording in np.unique(samples["recording"][counts]).tolist():
            pick = counts & (samples["recording"] == recording)
            seconds = float(np.ptp(samples["t"][pick]))
            where = {"run": run, "horizon_s": seconds + 1.0, "recording": recording}
            yield f"in a free run of {seconds:.3g} s of log {recording}", samples, pick, where


def _figure(name: str, value: float, unit: str, recipe: Mapping[str, Json]) -> dict[str, Json]:
    return {"name": name, "value": value, "unit": unit, "recipe": recipe}


def _unknown(identification: Identification) -> list[str]:
    """Return sentences about what the identification does not determine, and what its log does not cover."""
    sentences = []
    for p in identification.parameters:
        if p.state == "fixed" and p.kind != "derived":
            value = f"{p.estimate:.4g} {p.unit}".rstrip()
            sentences.append(f"{p.name} was not identified: it has its nominal value, {value}")
        elif p.state != "ok" and p.kind != "derived":
            sentences.append(f"{p.name} is {p.state}")
    return [*sentences, "outside of the motion, the speeds and the temperature of the log, the model extrapolates"]


def _simulation(identification: Identification, plain: PlainSimulation, model: IdentifiableModel) -> dict[str, Json]:
    """Return the simulation for ``reproduce.py``; a field has 0 (position) or 1 (velocity), and its joint."""
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
        **{n: v for n, v in vars(plain).items() if n not in ("mjcf", "begin")},
        "command_delay_s": late["command"],
        # A world of the graph is busy for 0.999 of its tick: its message leaves that much earlier (BaseWorld).
        "measurement_delay_s": late["measurement"] - 0.001 * plain.tick_s,
        "settle_s": identification.internal.settle_s,
        "fields": fields,
    }


def _unit(units: Mapping[str, str], field: str) -> str:
    return units.get(field, units.get(field.partition("[")[0], ""))
