"""The folder of a model card: ``card.json``, ``model.xml``, ``signals.npz`` and ``reproduce.py``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.artifacts.files import make_folder, write_arrays, write_json
from sim2real.identify.export.card import figures
from sim2real.identify.export.card.plain import PlainSimulation
from sim2real.identify.export.card.reproduce import Card
from sim2real.identify.export.card.signals import RUNS
from sim2real.identify.export.document import json_document
from sim2real.identify.model import Channel
from sim2real.types import Json

if TYPE_CHECKING:
    import numpy as np

    from sim2real.artifacts.identification import Identification
    from sim2real.identify.export.terms import Delays, Terms

CARD, MODEL, SIGNALS, SCRIPT = "card.json", "model.xml", "signals.npz", "reproduce.py"
ALLOWED = 0.01
"""Largest relative difference between a figure and its value in plain MuJoCo."""


def write_card(
    folder: Path,
    identification: Identification,
    plain: PlainSimulation | None,
    terms: Terms | None,
    delays: Delays,
    about: Sequence[tuple[str, str]],
    session: Mapping[str, Json],
    sides: Mapping[str, str],
    signals: Mapping[str, np.ndarray],
    notes: Sequence[str],
    channels: Sequence[Channel],
) -> dict[str, Json]:
    """Write the card's folder without the page, and return the document.

    Args:
        plain: The robot in plain MuJoCo; None: the card has no model, and no error of a simulation.
        terms: The robot in MuJoCo's terms; None where no MuJoCo model has it.
        session: Firmware, supply and temperatures that the log holds.
        sides: Delay -> ``command`` or ``measurement``.
        notes: Sentences about missing parts of the card.
    """
    folder = make_folder(folder)
    intervals = list(figures.intervals(identification))
    listed = list(figures.errors(identification, [run for run in RUNS if f"{run}/into" in signals]))
    listed += [*figures.quantiles(signals, identification.units), *figures.sums(identification), *intervals]
    listed += figures.distributions(identification)
    if plain is not None:
        (folder / MODEL).write_text(plain.mjcf, encoding="utf-8")
        listed += figures.of_joints(plain)
    document = {
        **json_document(identification, terms, delays, about),
        "logs": [{"name": Path(log.path).name, "sha256": log.sha256} for log in identification.logs],
        "session": session,
        "unknown": figures.limits(identification, intervals),
        "notes": list(notes),
        "simulation": None if plain is None else _simulation(identification, plain, sides, channels),
        "figures": listed,
    }
    write_json(folder / CARD, document)
    write_arrays(folder / SIGNALS, signals)
    shutil.copyfile(Path(__file__).with_name(SCRIPT), folder / SCRIPT)
    # The speed of joints without a measured velocity is a figure whose value the script itself computes.
    document["figures"] += figures.speeds(identification, Card(folder))
    write_json(folder / CARD, document)
    return json.loads((folder / CARD).read_text(encoding="utf-8"))


def differing(folder: Path) -> list[str]:
    """Return a sentence for each figure that ``reproduce.py`` misses by more than 1 %."""
    card = Card(folder)
    sentences = []
    for row in card.card["figures"]:
        value = card.value(row["recipe"])
        if not abs(value - row["value"]) <= ALLOWED * max(abs(row["value"]), 1e-12):
            sentences.append(f"{row['name']} is {row['value']:.4g} {row['unit']} here, and {value:.4g} in plain MuJoCo")
    return sentences


def _simulation(
    identification: Identification, plain: PlainSimulation, sides: Mapping[str, str], channels: Sequence[Channel]
) -> dict[str, Json]:
    """Return the simulation for ``reproduce.py``; a field has 0 for a position or 1 for a velocity, and a joint."""
    delays = [p for p in identification.parameters if p.kind == "delay"]
    late = {
        side: float(sum(p.estimate for p in delays if sides.get(p.name) == side)) for side in ("command", "measurement")
    }
    fields = {
        name if c.index is None else f"{name}[{c.index}]": (quantity, joint)
        for joint, c in enumerate(channels)
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
