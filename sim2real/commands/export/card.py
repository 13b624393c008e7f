"""``sim2real export identified --to card``: a folder with which a stranger reproduces each figure of a robot."""

from pathlib import Path

import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.manifest import sha256
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.export.card.card import differing, write_card
from sim2real.identify.export.card.signals import all_signals
from sim2real.identify.export.terms import Terms, find_delays, values_of
from sim2real.identify.model import IdentifiableModel
from sim2real.log.reader import read_log
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.terminal.console import note
from sim2real.types import Json

_SESSION: tuple[str, ...] = ("firmware", "voltage", "temperature")
"""Facts about the hardware that a log may hold, in its metadata or as a measurement."""


def write_model_card(
    folder: Path,
    identification: Identification,
    robot: RecordedRobot,
    model: IdentifiableModel,
    terms: Terms | None,
    about: list[tuple[str, str]],
    run_dir: Path | None,
) -> None:
    """Write the card of an identification, and a note for each figure that plain MuJoCo misses.

    Args:
        run_dir: Folder of the run, in which the log lies; None: the card has no facts about the hardware.

    Raises:
        UsageError: The folder has files of something else.
    """
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / "card.json").is_file()):
        raise UsageError(f"{folder} is there and holds no model card", hint="name another folder with --out")
    sides = {p.name: p.side for p in model.parameters}
    values = {p.name: p.nominal for p in model.parameters} | values_of(identification)
    plain = robot.plain_simulation(values)
    signals, notes = all_signals(identification, plain)
    about = [row for row in about if row[0] != "log"]  # a path of the own machine is no part of a card
    delays, session = find_delays(identification, sides), _session(identification, robot.roles.sensor, run_dir)
    card = write_card(
        folder, identification, plain, terms, delays, about, session, sides, signals, notes, model.channels
    )
    for sentence in [*card["notes"], *differing(folder)]:
        note(sentence)
    from sim2real.view.page.model_card import model_card_page  # matplotlib and jinja2 take 0.5 s to import

    model_card_page(card, signals, folder, identification.links)


def _session(identification: Identification, sensor: str, run_dir: Path | None) -> dict[str, str]:
    """Return firmware, supply voltage and temperature in the first log, as text."""
    source = identification.logs[0] if identification.logs else None
    path = run_dir / source.path if source is not None and run_dir is not None else None
    if source is None or path is None or not path.is_file() or sha256(path) != source.sha256:
        return dict.fromkeys(_SESSION, "the log is not beside the identification")
    return facts_of(read_log(path), sensor) if path.suffix == ".mcap" else dict.fromkeys(_SESSION, "not recorded")


def facts_of(episode: Episode, sensor: str) -> dict[str, str]:
    """Return firmware, supply voltage and temperature in a log, as text, from its metadata and measurements."""
    facts: dict[str, str] = dict.fromkeys(_SESSION, "not recorded")
    hardware = episode.metadata.get("hardware")
    facts |= {n: _of_motors(v) for n, v in hardware.items()} if isinstance(hardware, dict) else {}
    # A measurement is better than the value at the begin of the recording, and has its place.
    for name, rows in episode.outputs.get(sensor, {}).items():
        for fact in _SESSION:
            if rows.size and fact in name:
                unit = episode.units.get(sensor, {}).get(name, "")
                facts.pop(fact, None)
                facts[name] = f"{np.min(rows):.4g} to {np.max(rows):.4g} {unit}".rstrip()
    return facts


def _of_motors(values: Json) -> str:
    """Return a fact of each motor as text: one value, or each value with its motors."""
    if not isinstance(values, dict):
        return str(values)
    # Group the motors by their value, as most robots have motors of one kind.
    motors: dict[str, list[str]] = {}
    for motor, value in values.items():
        motors.setdefault(str(value), []).append(motor)
    if len(motors) == 1 and len(values) > 1:
        return f"{next(iter(motors))}, all motors"
    return "; ".join(f"{value}: {', '.join(names)}" for value, names in motors.items())
