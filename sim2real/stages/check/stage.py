"""Predict which parameters a recording, or a planned one, can determine, before a search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.artifacts.files import plain, to_json
from sim2real.artifacts.run.run_folder import newest
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import NotInstalled, Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.model import IdentifiableModel, measured_channels
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.segments import check_log
from sim2real.installation import has_jax
from sim2real.robots.robot import RecordedRobot, Robot, in_world
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.check.coverage import Coverage, coverage, problems
from sim2real.stages.excitation.played import played
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.open_log import open_recording
from sim2real.stages.pipeline.pipeline import Pipeline, pipeline_of
from sim2real.stages.pipeline.python_arguments import AnyRecording, config_of, recordings_of
from sim2real.stages.shared.identification import command
from sim2real.stages.terminal.console import artifact_table, note, pairs, progress, shown
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.stages.check.determination import Determination, ParameterCheck

PLANNED = "planned excitation"
_GOAL = 0.01
"""Standard error to reach, as a fraction of the nominal value."""


@dataclass(frozen=True, repr=False)
class Checked(Shown):
    """Which parameters recordings, or a planned one, determine.

    Attributes:
        source: ``log``, or ``planned excitation``.
        recommendation: The problems of the data, then the next step.
    """

    pipeline: str
    source: str
    recordings: tuple[Coverage, ...]
    determination: Determination
    recommendation: tuple[str, ...] = ()

    @property
    def parameters(self) -> tuple[ParameterCheck, ...]:
        """What the recordings say of each parameter."""
        return self.determination.parameters

    @property
    def undetermined(self) -> tuple[tuple[str, ...], ...]:
        """Groups of parameters; only combinations of the parameters in a group are determined."""
        return self.determination.undetermined

    @property
    def determined(self) -> bool:
        """Whether every parameter is determined; of the delays the sum suffices."""
        return not self.undetermined

    @property
    def messages(self) -> tuple[str, ...]:
        """A sentence for each group."""
        return self.determination.messages

    def about(self) -> dict[str, Json]:
        """Return name -> value of the main figures."""
        figures = {"pipeline": self.pipeline, "source": self.source, "determined": "yes" if self.determined else "no"}
        return figures | {"why": "; ".join(self.messages), "next": "; ".join(self.recommendation)}

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter."""
        headers = ("parameter", "nominal", "s.e. from a minute", "unit", "of nominal", "determined")
        share = lambda p: None if p.percent_of_nominal is None else f"{p.percent_of_nominal:.2g} %"  # noqa: E731
        rows = [
            [p.name, p.nominal, p.standard_error_per_minute, p.unit, share(p), p.determined] for p in self.parameters
        ]
        return ArtifactTable(headers, rows)


def run(pipeline: Pipeline, config: CheckConfig) -> bool:
    """Judge recordings and print the result.

    Returns:
        Whether every parameter is determined; of the delays the sum suffices.
    """
    checked = check(pipeline, None, config)
    if config.json:
        document = {**plain(checked), "determined": checked.determined, **plain(checked.determination)}
        print(to_json({n: v for n, v in document.items() if n != "determination"}).decode())
        return checked.determined
    show_coverage(checked.recordings)
    print(artifact_table(checked.rows()))
    condition, left = checked.determination.condition, len(checked.undetermined)
    about = {"condition number": "infinite" if condition is None else f"{condition:.2g}", "directions left open": left}
    print(f"\n{pairs(about)}")
    for message in [*checked.messages, *checked.recommendation]:
        print(f"- {message}")
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
        NotInstalled: JAX is not installed; the coverage of the recordings is printed before.
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
        logs = find_logs(pipeline, config)
        planned = not logs
        logs = logs or {PLANNED: _planned(pipeline, config, model, parameters, fitting)}
    else:
        recordings = recordings_of(recording, pipeline)
        config, planned = replace(config, log=tuple(str(log.path) for log in recordings), plan=False), False
        logs = {shown(log.path): log.episode for log in recordings}
    model = measured_channels(model, list(logs.values()))
    # Refuse logs that no parameter can be determined from, also without JAX.
    for episode in logs.values():
        check_log(episode, model)
    covered = tuple(coverage(name, episode, model, robot.units) for name, episode in logs.items())
    if not has_jax():
        if config.json:
            print(to_json({"recordings": covered}).decode())
        else:
            show_coverage(covered)
        raise NotInstalled(
            "which parameters this recording determines is computed with JAX, which is not installed here",
            hint=f"copy it to a computer with sim2real: `sim2real check {pipeline.name} --log LOG`",
        )
    from sim2real.stages.check.determination import determine  # imports JAX

    with progress(None, "check: simulate"):
        found = determine(model, list(logs.values()), fitting, parameters)
    flags = {"log": config.log, "bounds": config.bounds, "fix": config.fix, "world": config.world}
    identify = command(pipeline, replace(pipeline.identify, **flags), config.runs)
    following = f"sim2real record {pipeline.name}" if planned else identify
    checked = Checked(pipeline.name, PLANNED if planned else "log", covered, found)
    return replace(checked, recommendation=tuple(recommend(checked, following)))


def recommend(checked: Checked, following: str) -> list[str]:
    """Return sentences: first the problems of the data, then the next step.

    Args:
        following: The command that follows if every parameter is determined.
    """
    texts = problems(checked.recordings)
    if not checked.determined:
        names = ", ".join(dict.fromkeys(n for group in checked.undetermined for n in group))
        texts.append(f"do not identify yet: some of {names} would be guesses; --fix NAME VALUE holds a known one")
        motions = [p.excite for p in checked.parameters if p.excite and p.name in names.split(", ")]
        texts += [f"record instead: {'; '.join(dict.fromkeys(motions))}"] if motions else []
    # How long to record follows from the parameter with the largest standard error.
    alone = [(p.percent_of_nominal, p) for p in checked.parameters if p.determined == "alone" and p.percent_of_nominal]
    if alone:
        percent, worst = max(alone, key=lambda pair: pair[0])
        seconds, have_s = 60.0 * (percent / (100 * _GOAL)) ** 2, sum(r.duration_s for r in checked.recordings)
        about = f"{worst.name} is least certain: {percent:.2g} % of nominal from a minute"
        if seconds <= have_s:
            texts.append(f"{about}; {have_s:.0f} s are enough for {_GOAL:.0%}, if the model is right")
        else:
            texts.append(f"{about}; {_GOAL:.0%} takes {_time(seconds)} of such data, or a better excitation")
    return [*texts, f"next: {following}"] if checked.determined else texts


def find_logs(pipeline: Pipeline, config: CheckConfig) -> dict[str, Episode]:
    """Return the logs that the configuration names, or the newest recording; empty if an excitation is planned."""
    paths, robot = [Path(p) for p in config.log], pipeline.load()
    if not paths and not config.plan:
        try:
            paths = newest(config.runs, pipeline.name, "record").logs()
        except Sim2RealError as error:
            if not isinstance(robot, Robot):
                raise UsageError(
                    f"there is no recording of {pipeline.name!r} in {shown(config.runs)}, and the pipeline has no "
                    "excitation to plan one with",
                    hint=f"name a log with --log FILE, or `sim2real import FILE --pipeline {pipeline.name}`",
                ) from error
            note(f"no recording of {pipeline.name} in {shown(config.runs)}: the planned excitation is simulated")
    return {shown(p): open_recording(p, pipeline, robot).episode for p in paths}


def show_coverage(recordings: Sequence[Coverage]) -> None:
    """Print the sampling of recordings, the motion of their joints and the ranges of their commands."""
    for recording in recordings:
        print(f"{pairs({recording.name: recording.sampling()})}\n\n{artifact_table(recording.rows())}\n")


def _planned(
    pipeline: Pipeline,
    config: CheckConfig,
    model: IdentifiableModel,
    parameters: ParameterTable,
    fitting: IdentifyConfig,
) -> Episode:
    """Return a simulation of the planned excitation, at the nominal values."""
    if not isinstance(pipeline.load(), Robot):
        raise UsageError(
            f"pipeline {pipeline.name!r} has no excitation to plan a recording with", hint="name a log with --log FILE"
        )
    if config.record.by_hand:
        raise UsageError(
            "a recording by hand determines no parameter: torque is off, and the hand's torque is not measured",
            hint="record it, play it with `sim2real record PIPELINE --excitation LOG`, and check that",
        )
    if config.record.standing:
        raise UsageError("a recording of standing determines the load alone", hint="plan another --record.excitation")
    if not has_jax():
        raise NotInstalled("a plan is simulated with JAX, which is not installed here", hint="name a log with --log")
    from sim2real.stages.excitation.simulated_log import simulate  # JAX programs

    moving = moving_robot(pipeline)
    signal = moving.drive.around(played(config.record, pipeline, moving))
    table = parameters.for_recordings(1)
    values = table.of_recording(table.decode(table.start()), 0)
    return simulate(model, moving, signal, values, fitting, config.record.seed)


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min" if seconds < 7200 else "hours"
