"""``sim2real export identified``: the estimates as a model of another simulator."""

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
    """Write the file, print the parameters that it lacks, and return its path.

    Raises:
        UsageError: There is no identification, it was interrupted, or the target cannot hold the robot's model.
    """
    file = find_parameters(config)
    identification = Identification.load(file)
    out = config.out or Path(f"{identification.pipeline}_{_FILES[config.to]}")
    _export(identification, pipeline_beside(file, identification), config.to, out, str(file))
    wrote(out)
    return out


def export(
    robot: RecordedRobot | Pipeline | str,
    identification: AnyIdentification,
    out: AnyPath,
    to: Literal["mjcf", "mjlab", "isaaclab", "json"] = "mjcf",
) -> Path:
    """Write the estimates as a model of another simulator.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        identification: The identification, or its folder.
        to: ``mjcf``, ``mjlab``, ``isaaclab`` or ``json``.

    Returns:
        The file.

    Raises:
        UsageError: The identification was interrupted or is of another robot, or the target cannot hold the model.
    """
    pipeline, document, out = python_arguments.pipeline_of(robot), identification_of(identification), Path(out)
    if to not in _FILES:
        raise UsageError(f"cannot export to {to!r}. Available: {', '.join(_FILES)}")
    if document.pipeline != pipeline.name:
        raise UsageError(f"these are parameters of pipeline {document.pipeline!r}, not of {pipeline.name!r}")
    _export(
        document, pipeline, to, out, "memory" if isinstance(identification, Identification) else str(identification)
    )
    return out


def _export(identification: Identification, pipeline: Pipeline, to: str, out: Path, where: str) -> None:
    if identification.posterior is None:
        ended = UNFINISHED.get(identification.verdict.status, "has no intervals")
        raise UsageError(
            f"the identification in {where} {ended}: its estimates may be far off",
            hint=identification.verdict.next or f"sim2real identify {identification.pipeline}",
        )
    # Describe the source at the head of the file.
    robot = having(pipeline.load(), [p.name for p in identification.parameters])
    table = robot.identifiable(pipeline.identify.max_delay_s).parameters
    about = [
        ("pipeline", identification.pipeline),
        ("verdict", identification.verdict.status),
        *(("log", f"{log.path} {log.sha256}") for log in identification.logs[:1]),
        ("sim2real", metadata.version("sim2real")),
    ]
    if identification.verdict.status != "accepted":
        note(f"verdict: {identification.verdict.status}; the file contains the verdict, too")
    write(to, out, identification, robot, table, about)


def write(
    to: str,
    out: Path,
    identification: Identification,
    robot: RecordedRobot,
    table: ParameterTable,
    about: list[tuple[str, str]],
) -> None:
    """Write one file.

    Args:
        to: ``mjcf``, ``mjlab``, ``isaaclab`` or ``json``.
    """
    # Put the estimates into the robot's model.
    sides = {p.name: p.side for p in table}
    # Optional terms that were not identified have their nominal values, which switch them off.
    off = {p.name: p.nominal for p in table}
    text = robot.identified_mjcf({**off, **values_of(identification)})
    terms = None if text is None else find_terms(identification, lambda values: _text(robot, {**off, **values}), sides)
    # Write the format: JSON needs no model, the others need one.
    if to == "json":
        write_json(out, json_document(identification, terms, find_delays(identification, sides), about))
        return
    if text is None or terms is None:
        raise _no_model(identification, table, to)
    if terms.unexpressed:
        note(f"not expressed in {to}: {', '.join(terms.unexpressed)}")
        about = [*about, ("not expressed", ", ".join(terms.unexpressed))]
    if to == "mjcf":
        content = late_mjcf(text, terms, Late(robot.export_lead_s, robot.profile_rad_s), about)
    else:
        source = mjlab_source if to == "mjlab" else isaaclab_source
        content = source(
            terms, f"Actuators and randomisation of {identification.pipeline!r}, as sim2real identified them.", about
        )
    out.write_text(content, encoding="utf-8")


def find_parameters(config: ExportConfig) -> Path:
    """Return the file of the identification that the configuration names."""
    source = config.source
    if source is None:
        raise UsageError(
            f"export needs a run folder, a pipeline or a {PARAMETERS}. Pipelines: {', '.join(sorted(available()))}",
            hint="sim2real export identified PIPELINE --to mjcf",
        )
    # A file or a stage folder, then a pipeline's name, then a run.
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


def _no_model(identification: Identification, table: ParameterTable, to: str) -> UsageError:
    """Return the error for a robot whose world is not MuJoCo's: it names what an MJCF would lack."""
    leaves = {p.name: str(p.leaf).rpartition(".")[2].partition("[")[0] for p in table if p.leaf}
    lost = [p.name for p in identification.parameters if leaves.get(p.name.partition("@")[0], "delay") not in _PLAIN]
    return UsageError(
        f"the world of pipeline {identification.pipeline!r} is not MuJoCo's, so there is no model to export to "
        f"{to}. Joints and drives of MuJoCo's have nothing for: {', '.join(lost) or 'its equations of motion'}",
        hint="--to json has all parameters, their intervals and the posterior",
    )
