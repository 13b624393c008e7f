"""An identification as a model of another simulator, as JSON, or as a model card."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from sim2real.artifacts.files import write_json
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run import sha256
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identification.export.card import differing, json_document, write_card
from sim2real.identification.export.targets import late_mjcf, source_of
from sim2real.identification.export.terms import find_delays, find_terms
from sim2real.identification.model import IdentifiableModel
from sim2real.identification.parameters import ParameterTable
from sim2real.installation import version
from sim2real.log.reader import read_log
from sim2real.robots.loop import SENSOR
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.load import AnyRobot, robot_of
from sim2real.stages.shared.arguments import AnyIdentification, AnyPath, identification_of
from sim2real.stages.shared.identification import identified_robot
from sim2real.stages.terminal.console import note
from sim2real.types import Json

FORMATS = ("mjcf", "mjlab", "isaaclab", "json", "card")
_PLAIN = {"gain", "stiffness", "damping", "viscous", "coulomb", "armature", "gravity", "delay"}
"""Last names of parameter paths that have a counterpart in MuJoCo's joints and drives."""
_SESSION: tuple[str, ...] = ("firmware", "voltage", "temperature")
"""Facts about the hardware that a log may hold, in its metadata or as a measurement."""


def export(
    robot: AnyRobot,
    identification: AnyIdentification,
    out: AnyPath,
    to: Literal["mjcf", "mjlab", "isaaclab", "json", "card"] = "mjcf",
) -> Path:
    """Write the estimates as a model of another simulator.

    Args:
        robot: The robot, or the name of its pipeline.
        identification: The identification, or its folder.
        to: ``mjcf``, ``mjlab``, ``isaaclab``, ``json``, or ``card``, which is a folder.

    Raises:
        UsageError: The identification was interrupted or is of another robot, or the target cannot hold the model.
    """
    robot, document, out = robot_of(robot), identification_of(identification), Path(out)
    if to not in FORMATS:
        raise UsageError(f"cannot export to {to!r}. Available: {', '.join(FORMATS)}")
    if document.pipeline != robot.name:
        raise UsageError(f"these are parameters of pipeline {document.pipeline!r}, not of {robot.name!r}")
    in_memory = isinstance(identification, Identification)
    write_export(document, robot, to, out, None if in_memory else Path(identification).resolve().parent)
    return out


def write_export(
    identification: Identification, robot: RecordedRobot, to: str, out: Path, run_dir: Path | None
) -> None:
    """Write one file, or the folder of a card.

    Args:
        run_dir: Folder of the run, in which a card looks for the log.
    """
    identification.needed_posterior(f"sim2real identify {identification.pipeline}")
    # Describe the source at the head of the file.
    robot, fitting = identified_robot(identification, robot)
    model, status = robot.identifiable(fitting.max_delay_s), identification.verdict.status
    log = [("log", f"{log.path} {log.sha256}") for log in identification.logs[:1]]
    about = [("pipeline", identification.pipeline), ("verdict", status), *log, ("sim2real", version())]
    if status != "accepted":
        note(f"verdict: {status}; the file contains the verdict, too")
    # Put the estimates into the robot's model; optional terms that were not identified are switched off.
    off, sides = {p.name: p.nominal for p in model.parameters}, {p.name: p.side for p in model.parameters}
    exported = robot.exported({**off, **identification.values})
    terms = exported and find_terms(identification, lambda values: _text(robot, {**off, **values}), sides)
    # Write the format: JSON and a card need no model, the others need one.
    if to in ("json", "card"):
        about = about if to == "json" else [row for row in about if row[0] != "log"]  # leave out paths of this machine
        document = json_document(identification, terms, find_delays(identification, sides), about)
        if to == "json":
            write_json(out, document)
        else:
            write_model_card(out, identification, robot, model, document, run_dir)
        return
    if exported is None or terms is None:
        raise _no_model(identification, model.parameters, to)
    if terms.unexpressed:
        note(f"not expressed in {to}: {', '.join(terms.unexpressed)}")
        about = [*about, ("not expressed", ", ".join(terms.unexpressed))]
    if to == "mjcf":
        content = late_mjcf(exported.mjcf, terms, exported.late, about)
    else:
        title = f"Actuators and randomisation of {identification.pipeline!r}, as sim2real identified them."
        content = source_of(to, terms, title, about)
    out.write_text(content, encoding="utf-8")


def write_model_card(
    folder: Path,
    identification: Identification,
    robot: RecordedRobot,
    model: IdentifiableModel,
    document: Mapping[str, Json],
    run_dir: Path | None,
) -> None:
    """Write the card of an identification, and a note for each figure that plain MuJoCo misses.

    Args:
        document: The results, as ``json_document`` returns them.
        run_dir: Folder of the run, in which the log lies; None: the card has no facts about the hardware.

    Raises:
        UsageError: The folder has files of something else.
    """
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir()) and not (folder / "card.json").is_file()):
        raise UsageError(f"{folder} exists and is no model card", hint="name another folder with --out")
    exported = robot.exported({p.name: p.nominal for p in model.parameters} | identification.values)
    plain = None if exported is None else exported.plain()
    card, signals = write_card(
        folder, identification, model, plain, document, _session(identification, SENSOR, run_dir)
    )
    for sentence in [*card["notes"], *differing(folder)]:
        note(sentence)
    from sim2real.view.model_card import model_card_page  # matplotlib and jinja2 take 0.5 s to import

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
    # A measurement replaces the value at the begin of the recording.
    for name, rows in episode.outputs.get(sensor, {}).items():
        for fact in _SESSION:
            if rows.size and fact in name:
                unit = episode.units.get(sensor, {}).get(name, "")
                facts.pop(fact, None)
                facts[name] = f"{np.min(rows):.4g} to {np.max(rows):.4g} {unit}".rstrip()
    return facts


def _of_motors(values: Json) -> str:
    """Return a fact about the motors as text: one value, or each value with its motors."""
    if not isinstance(values, dict):
        return str(values)
    motors: dict[str, list[str]] = {}
    for motor, value in values.items():
        motors.setdefault(str(value), []).append(motor)
    if len(motors) == 1 and len(values) > 1:
        return f"{next(iter(motors))}, all motors"
    return "; ".join(f"{value}: {', '.join(names)}" for value, names in motors.items())


def _text(robot: RecordedRobot, values: Mapping[str, float]) -> str:
    if (exported := robot.exported(values)) is None:
        raise UsageError(f"robot {type(robot).__name__} has a MuJoCo model for some values and none for others")
    return exported.mjcf


def _no_model(identification: Identification, table: ParameterTable, to: str) -> UsageError:
    """Return the error for a robot without a MuJoCo world, with the parameters that an MJCF would lack."""
    leaves = {p.name: str(p.leaf).rpartition(".")[2].partition("[")[0] for p in table if p.leaf}
    lost = [p.name for p in identification.parameters if leaves.get(p.name, "delay") not in _PLAIN]
    return UsageError(
        f"the world of pipeline {identification.pipeline!r} is not MuJoCo's, so there is no model to export to "
        f"{to}. Joints and drives of MuJoCo's have nothing for: {', '.join(lost) or 'its equations of motion'}",
        hint="--to json has all parameters, their intervals and the posterior",
    )
