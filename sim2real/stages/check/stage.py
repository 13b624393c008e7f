"""Predict which parameters a recording, or a planned one, can determine, before a search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

from sim2real.errors import NotInstalled
from sim2real.identify.problem.segments import check_log
from sim2real.installation import has_jax
from sim2real.robots.contract import RecordedRobot
from sim2real.robots.worlds import in_world
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.check.result import Checked
from sim2real.stages.check.show import show, show_json, show_recordings
from sim2real.stages.check.sources import JudgedLogs, find_source
from sim2real.stages.estimation import recording_advice
from sim2real.stages.pipeline.pipeline import Pipeline, pipeline_of
from sim2real.stages.pipeline.python_arguments import AnyRecording, config_of, recordings_of
from sim2real.stages.terminal.console import progress, shown
from sim2real.types import Json


def run(pipeline: Pipeline, config: CheckConfig) -> bool:
    """Judge recordings and print the result.

    Returns:
        Whether every parameter is determined; of the delays the sum suffices.
    """
    checked = check(pipeline, None, config)
    if config.json:
        show_json(checked)
    else:
        show(asdict(checked))
    return checked.determined


def check(
    robot: RecordedRobot | Pipeline | str,
    recording: AnyRecording | Sequence[AnyRecording] | None = None,
    config: CheckConfig | Mapping[str, Json] | None = None,
) -> Checked:
    """Predict which parameters recordings can determine, before a search.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        recording: One recording, or several; or the paths of their logs. None: the logs that ``config`` names, the
            newest recording in its ``runs``, or, without one, the planned excitation.
        config: A dict holds the fields that differ from the default.

    Raises:
        NotInstalled: JAX is not installed; the tables of the recordings are printed before.
    """
    # Make the model that identify would fit.
    pipeline = pipeline_of(robot)
    config = config_of(config, CheckConfig(record=pipeline.record))
    robot = in_world(pipeline.load(), config.world)
    # The squared loss, because a robust loss would hide the errors of the nominal model.
    fitting = replace(pipeline.identify, bounds=config.bounds, fix=config.fix, loss="squared")
    model = robot.identifiable(fitting.max_delay_s)
    parameters = model.parameters.with_bounds(config.bounds).with_fixed(config.fix)

    # Open the recordings, or simulate the planned one.
    if recording is None:
        source = find_source(pipeline, config, model, parameters, fitting)
    else:
        logs = recordings_of(recording, pipeline)
        config = replace(config, log=tuple(str(log.path) for log in logs), plan=False)
        source = JudgedLogs([shown(log.path) for log in logs], [log.episode for log in logs], False)

    # Refuse logs that no parameter can be determined from, also without JAX.
    for episode in source.episodes:
        check_log(episode, model)
    # Judge them, and recommend the next command.
    from sim2real.stages.check.determination import covered, judge  # 0.3 s

    try:
        with progress(None, "check: simulate"):
            judgement = judge(model, source, fitting, parameters, robot.units)
    except (NotInstalled, ModuleNotFoundError, AttributeError):  # of JAX, or of its arrays
        if has_jax():
            raise
        show_recordings(covered(model, source, robot.units), config.json)
        raise NotInstalled(
            "which parameters this recording determines is computed with JAX, which is not installed here",
            hint=f"copy it to a computer with sim2real: `sim2real check {pipeline.name} --log LOG`",
        ) from None
    flags = {"log": config.log, "bounds": config.bounds, "fix": config.fix, "world": config.world}
    identify = recording_advice.command(pipeline, replace(pipeline.identify, **flags), config.runs)
    record = f"sim2real record {pipeline.name}"
    recommendation = recording_advice.recommend({"pipeline": pipeline.name, **judgement}, identify, record)
    return Checked(pipeline.name, **judgement, recommendation=recommendation)
