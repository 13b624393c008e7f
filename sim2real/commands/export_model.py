"""``sim2real export identified``: what was identified, in the terms of another simulator."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Literal

from sim2real.artifacts.files import write_json
from sim2real.artifacts.identification import PARAMETERS, UNFINISHED, Identification
from sim2real.artifacts.run.run_folder import newest, pipeline_of
from sim2real.commands.config import ExportConfig
from sim2real.errors import UsageError
from sim2real.identify.export.document import json_document
from sim2real.identify.export.isaaclab import isaaclab_source
from sim2real.identify.export.mjcf import Late, late_mjcf
from sim2real.identify.export.mjlab import mjlab_source
from sim2real.identify.export.terms import find_delays, find_terms, values_of
from sim2real.identify.parameters import ParameterTable
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.estimation.held_out_parts import having
from sim2real.stages.pipeline import python_arguments
from sim2real.stages.pipeline.find_run import find_run, warn_of_stale
from sim2real.stages.pipeline.from_model import pipeline_beside
from sim2real.stages.pipeline.pipeline import Pipeline, available
from sim2real.stages.pipeline.python_arguments import AnyIdentification, AnyPath, identification_of
from sim2real.stages.terminal.console import note, wrote

_FILES = {"mjcf": "identified.xml", "mjlab": "mjlab.py", "isaaclab": "isaaclab.py", "json": "identified.json"}
_PLAIN = {"gain", "stiffness", "damping", "viscous", "coulomb", "armature", "gravity", "delay"}
"""Leaves of parameters that have a counterpart in MuJoCo's joints and drives."""


def run(config: ExportConfig) -> Path:
    """Write the file and say what is not in it.

    Args:
        config: What to export, and as what.

    Returns:
        The file.

    Raises:
        UsageError: When there is no identification, it was interrupted, or the target cannot hold the robot's model.
    """
    file = find_parameters(config)
    found = Identification.load(file)
    out = config.out or Path(f"{found.pipeline}_{_FILES[config.to]}")
    _export(found, pipeline_beside(file, found), config.to, out, str(file))
    wrote(out)
    return out


def export(
    robot: RecordedRobot | Pipeline | str,
    identification: AnyIdentification,
    out: AnyPath,
    to: Literal["mjcf", "mjlab", "isaaclab", "json"] = "mjcf",
) -> Path:
    """Write what was identified in the terms of another simulator.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        identification: What was identified, or its folder.
        to: ``mjcf``, ``mjlab``, ``isaaclab`` or ``json``.

    Returns:
        The file.

    Raises:
        UsageError: When it was interrupted, is of another robot, or the target cannot hold the robot's model.
    """
    pipeline, found, out = python_arguments.pipeline_of(robot), identification_of(identification), Path(out)
    if to not in _FILES:
        raise UsageError(f"cannot export to {to!r}. Available: {', '.join(_FILES)}")
    if found.pipeline != pipeline.name:
        raise UsageError(f"these are parameters of pipeline {found.pipeline!r}, not of {pipeline.name!r}")
    _export(found, pipeline, to, out, "memory" if isinstance(identification, Identification) else str(identification))
    return out


def _export(found: Identification, pipeline: Pipeline, to: str, out: Path, where: str) -> None:
    if found.posterior is None:
        ended = UNFINISHED.get(found.verdict.status, "has no intervals")
        raise UsageError(
            f"the identification in {where} {ended}: its estimates may be far off",
            hint=found.verdict.next or f"sim2real identify {found.pipeline}",
        )
    robot = having(pipeline.load(), [p.name for p in found.parameters])
    table = robot.identifiable(pipeline.identify.max_delay_s).parameters
    about = [
        ("pipeline", found.pipeline),
        ("verdict", found.verdict.status),
        *(("log", f"{log.path} {log.sha256}") for log in found.logs[:1]),
        ("sim2real", metadata.version("sim2real")),
    ]
    if found.verdict.status != "accepted":
        note(f"verdict: {found.verdict.status}; the file says so too")
    write(to, out, found, robot, table, about)


def write(
    to: str,
    out: Path,
    found: Identification,
    robot: RecordedRobot,
    table: ParameterTable,
    about: list[tuple[str, str]],
) -> None:
    """Write one file.

    Args:
        to: ``mjcf``, ``mjlab``, ``isaaclab`` or ``json``.
    """
    sides = {p.name: p.side for p in table}
    off = {p.name: p.nominal for p in table}  # of optional terms that nobody asked for
    text = robot.identified_mjcf({**off, **values_of(found)})
    terms = None if text is None else find_terms(found, lambda values: _text(robot, {**off, **values}), sides)
    if to == "json":
        write_json(out, json_document(found, terms, find_delays(found, sides), about))
        return
    if text is None or terms is None:
        raise _no_model(found, table, to)
    if terms.unexpressed:
        note(f"not expressed in {to}: {', '.join(terms.unexpressed)}")
        about = [*about, ("not expressed", ", ".join(terms.unexpressed))]
    if to == "mjcf":
        content = late_mjcf(text, terms, Late(robot.export_lead_s, robot.profile_rad_s), about)
    else:
        source = mjlab_source if to == "mjlab" else isaaclab_source
        content = source(
            terms, f"Actuators and randomisation of {found.pipeline!r}, as sim2real identified them.", about
        )
    out.write_text(content, encoding="utf-8")


def find_parameters(config: ExportConfig) -> Path:
    """Return the file with the identification that is meant.

    Raises:
        UsageError: When none was named, or there is none.
    """
    source = config.source
    if source is None:
        raise UsageError(
            f"export needs a run folder, a pipeline or a {PARAMETERS}. Pipelines: {', '.join(sorted(available()))}",
            hint="sim2real export identified PIPELINE --to mjcf",
        )
    path = Path(source)
    if path.is_file():
        return path
    if (path / PARAMETERS).is_file():
        return path / PARAMETERS
    if source in available():
        return warn_of_stale(newest(config.runs, source, "identify")).output("parameters")
    run_dir = find_run(config.runs, source)
    return warn_of_stale(newest(config.runs, pipeline_of(run_dir), "identify", run_dir)).output("parameters")


def _text(robot: RecordedRobot, values: Mapping[str, float]) -> str:
    text = robot.identified_mjcf(values)
    if text is None:
        raise UsageError(f"robot {type(robot).__name__} has a MuJoCo model for some values and none for others")
    return text


def _no_model(found: Identification, table: ParameterTable, to: str) -> UsageError:
    """Return the error for a robot whose world is not MuJoCo's: it names what an MJCF would lack."""
    leaves = {p.name: str(p.leaf).rpartition(".")[2].partition("[")[0] for p in table if p.leaf}
    lost = [p.name for p in found.parameters if leaves.get(p.name.partition("@")[0], "delay") not in _PLAIN]
    return UsageError(
        f"the world of pipeline {found.pipeline!r} is not MuJoCo's, so there is no model to export to {to}. Joints and "
        f"drives of MuJoCo's have nothing for: {', '.join(lost) or 'its equations of motion'}",
        hint="--to json has all parameters, their intervals and the posterior",
    )
