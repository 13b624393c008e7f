"""``sim2real export identified``: the estimates as a model of another simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from sim2real.artifacts.identification import PARAMETERS, UNFINISHED, Identification
from sim2real.artifacts.run.run_folder import newest, pipeline_of
from sim2real.commands.config import ExportConfig
from sim2real.commands.export.formats import FILES, write
from sim2real.errors import UsageError
from sim2real.installation import version
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.estimation.held_out_parts import having
from sim2real.stages.pipeline import python_arguments
from sim2real.stages.pipeline.find_run import find_run, warn_of_stale
from sim2real.stages.pipeline.from_model import pipeline_beside
from sim2real.stages.pipeline.pipeline import Pipeline, available
from sim2real.stages.pipeline.python_arguments import AnyIdentification, AnyPath, identification_of
from sim2real.stages.terminal.console import note, wrote


def run(config: ExportConfig) -> Path:
    """Write the file, print the parameters that it lacks, and return its path.

    Raises:
        UsageError: There is no identification, it was interrupted, or the target cannot hold the robot's model.
    """
    file = find_parameters(config)
    identification = Identification.load(file)
    out = config.out or Path(f"{identification.pipeline}_{FILES[config.to]}")
    pipeline = pipeline_beside(file, identification)
    _export(identification, pipeline, config.to, out, str(file), file.resolve().parent.parent)
    wrote(out)
    return out


def export(
    robot: RecordedRobot | Pipeline | str,
    identification: AnyIdentification,
    out: AnyPath,
    to: Literal["mjcf", "mjlab", "isaaclab", "json", "card"] = "mjcf",
) -> Path:
    """Write the estimates as a model of another simulator.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        identification: The identification, or its folder.
        to: ``mjcf``, ``mjlab``, ``isaaclab``, ``json``, or ``card``, which is a folder.

    Raises:
        UsageError: The identification was interrupted or is of another robot, or the target cannot hold the model.
    """
    pipeline, document, out = python_arguments.pipeline_of(robot), identification_of(identification), Path(out)
    if to not in FILES:
        raise UsageError(f"cannot export to {to!r}. Available: {', '.join(FILES)}")
    if document.pipeline != pipeline.name:
        raise UsageError(f"these are parameters of pipeline {document.pipeline!r}, not of {pipeline.name!r}")
    in_memory = isinstance(identification, Identification)
    where, run_dir = ("memory", None) if in_memory else (str(identification), Path(identification).resolve().parent)
    _export(document, pipeline, to, out, where, run_dir)
    return out


def _export(
    identification: Identification, pipeline: Pipeline, to: str, out: Path, where: str, run_dir: Path | None
) -> None:
    if identification.posterior is None:
        ended = UNFINISHED.get(identification.verdict.status, "has no intervals")
        raise UsageError(
            f"the identification in {where} {ended}: its estimates may be far off",
            hint=identification.verdict.next or f"sim2real identify {identification.pipeline}",
        )
    # Describe the source at the head of the file.
    robot = having(pipeline.load(), [p.name for p in identification.parameters])
    model = robot.identifiable(pipeline.identify.max_delay_s)
    about = [
        ("pipeline", identification.pipeline),
        ("verdict", identification.verdict.status),
        *(("log", f"{log.path} {log.sha256}") for log in identification.logs[:1]),
        ("sim2real", version()),
    ]
    if identification.verdict.status != "accepted":
        note(f"verdict: {identification.verdict.status}; the file contains the verdict, too")
    write(to, out, identification, robot, model, about, run_dir)


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
