"""Score an identification on later logs: held-out errors beside the promised ones."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.manifest import plain
from sim2real.errors import UsageError
from sim2real.log.importing.mapping import load_mapping
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.pipeline import from_model, python_arguments
from sim2real.stages.pipeline.open_log import open_recording
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.pipeline.python_arguments import AnyIdentification, AnyRecording
from sim2real.stages.terminal.console import shown
from sim2real.stages.validate.config import ValidateConfig
from sim2real.stages.validate.result import Validation
from sim2real.stages.validate.score import score
from sim2real.stages.validate.show import show
from sim2real.types import Json


def run(config: ValidateConfig) -> bool:
    """Score an identification and print the result.

    Returns:
        Whether every position is predicted better than by every baseline.

    Raises:
        UsageError: There are no parameters or no log, or a log was fitted.
    """
    if config.parameters is None or not config.log:
        raise UsageError(
            "validate needs parameters and a log", hint="sim2real validate RUN/identify/parameters.json --log new.mcap"
        )
    identification = Identification.load(config.parameters)
    pipeline = pipeline_of(config.parameters, identification, config)
    logs = [open_recording(Path(path), pipeline) for path in config.log]
    result = score(identification, pipeline, logs, config)
    result = {"parameters": shown(config.parameters), "logs": list(config.log), **result}
    if config.json:
        ledger = [{**plain(row), "ratio": plain(row.ratio), "kept": row.kept} for row in result["ledger"]]
        print(json.dumps({**plain(result), "ledger": ledger}, indent=1))
    else:
        show(result)
    return bool(result["better"])


def validate(
    robot: RecordedRobot | Pipeline | str,
    identification: AnyIdentification,
    recording: AnyRecording | Sequence[AnyRecording],
    config: ValidateConfig | Mapping[str, Json] | None = None,
) -> Validation:
    """Score an identification on later recordings.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        identification: The identification, or its folder.
        recording: One recording that was not fitted, or several; or the paths of their logs.
        config: A dict holds the fields that differ from the default.
    """
    pipeline = python_arguments.pipeline_of(robot)
    document = python_arguments.identification_of(identification)
    if document.pipeline != pipeline.name:
        raise UsageError(f"these are parameters of pipeline {document.pipeline!r}, not of {pipeline.name!r}")
    logs = python_arguments.recordings_of(recording, pipeline)
    return Validation(**score(document, pipeline, logs, python_arguments.config_of(config, ValidateConfig())))


def pipeline_of(path: Path, identification: Identification, config: ValidateConfig) -> Pipeline:
    """Return the pipeline of an identification; a robot without a pipeline is described beside the parameters."""
    pipeline = from_model.pipeline_beside(path, identification)
    if not isinstance(pipeline, from_model.DescribedPipeline):
        return pipeline
    mapping = load_mapping(config.mapping, pipeline.name).of_joints() if config.mapping else None
    return pipeline.reading(config.log, mapping)
