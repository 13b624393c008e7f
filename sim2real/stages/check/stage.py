"""Judge what a recording, or a planned one, can tell about the parameters, before anything is searched."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sim2real.artifacts.files import number
from sim2real.artifacts.identification import ROUND_TRIP, Determined
from sim2real.artifacts.run.manifest import plain
from sim2real.artifacts.run.run_folder import newest
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span, check_log
from sim2real.identify.uncertainty import identifiability, recording_coverage, uncertainty
from sim2real.identify.uncertainty.round_trip import SURE_S
from sim2real.identify.validation.prediction import position_of
from sim2real.log.schema import unit_of
from sim2real.robots.contract import RecordedRobot, Robot
from sim2real.robots.worlds import in_world
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.check.result import Checked
from sim2real.stages.estimation import recording_advice
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.excitation.signals import excitation as command_signal
from sim2real.stages.excitation.simulated_log import simulate
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.open_log import open_recording
from sim2real.stages.pipeline.pipeline import Pipeline, pipeline_of
from sim2real.stages.pipeline.python_arguments import AnyRecording, config_of, recordings_of
from sim2real.stages.terminal.console import note, pairs, progress, shown, table

PLANNED = "planned excitation"
_LEAST_S = 0.3
_MOST_SEGMENTS = 120
"""More than this many segments say nothing new: of a longer log so many are taken, evenly."""


@dataclass(frozen=True)
class JudgedLogs:
    """What is judged: recordings, or one that was simulated."""

    names: list[str]
    episodes: list[Episode]
    planned: bool


def run(pipeline: Pipeline, config: CheckConfig) -> bool:
    """Judge and print.

    Returns:
        Whether everything is determined, up to the time shift between delays.
    """
    found = check(pipeline, None, config)
    if config.json:
        print(json.dumps(plain(asdict(found)), indent=1))
    else:
        show(asdict(found))
    return found.determined


def check(
    robot: RecordedRobot | Pipeline | str,
    recording: AnyRecording | Sequence[AnyRecording] | None = None,
    config: CheckConfig | Mapping[str, Any] | None = None,
) -> Checked:
    """Judge what recordings can tell about the parameters, before anything is searched.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        recording: One recording, or several; or the paths of their logs. None: those that ``config`` names, the newest
            recording in its ``runs``, or, without one, the planned excitation.
        config: How. A dict has what is different from the default.
    """
    pipeline = pipeline_of(robot)
    config = config_of(config, CheckConfig(record=pipeline.record))
    robot = in_world(pipeline.load(), config.world)
    # A robust loss would hide what is wrong with the nominal model.
    fitting = replace(pipeline.identify, bounds=config.bounds, fix=config.fix, loss="squared")
    model = robot.identifiable(fitting.max_delay_s)
    parameters = model.parameters.with_bounds(config.bounds).with_fixed(config.fix)
    if recording is None:
        source = find_source(pipeline, config, model, parameters, fitting)
    else:
        logs = recordings_of(recording, pipeline)
        config = replace(config, log=tuple(str(log.path) for log in logs), plan=False)
        source = JudgedLogs([shown(log.path) for log in logs], [log.episode for log in logs], False)
    with progress(None, "check: simulate"):
        found = judge(model, source, fitting, parameters, dict(robot.units))
    own = {"log": config.log, "bounds": config.bounds, "fix": config.fix, "world": config.world}
    identify = recording_advice.command(pipeline, replace(pipeline.identify, **own), config.runs)
    advised = recording_advice.recommend(
        {"pipeline": pipeline.name, **found}, identify, f"sim2real record {pipeline.name}"
    )
    return Checked(pipeline.name, **found, recommendation=advised)


def find_source(
    pipeline: Pipeline,
    config: CheckConfig,
    model: IdentifiableModel,
    parameters: ParameterTable,
    fitting: IdentifyConfig,
) -> JudgedLogs:
    """Return the logs that were named, the newest recording, or what recording would give.

    Args:
        config: Names logs, or asks for the planned excitation.
        parameters: Its parameters, whose nominal values are simulated.

    Raises:
        UsageError: When there is neither a recording nor an excitation to plan one with.
    """
    paths, robot = [Path(p) for p in config.log], pipeline.load()
    if not paths and not config.plan:
        try:
            recorded = newest(config.runs, pipeline.name, "record")
        except Sim2RealError as error:
            if not isinstance(robot, Robot):
                raise UsageError(
                    f"there is no recording of {pipeline.name!r} in {shown(config.runs)}, and the pipeline has no "
                    "excitation to plan one with",
                    hint=f"name a log with --log FILE, or `sim2real import FILE --pipeline {pipeline.name}`",
                ) from error
            note(f"no recording of {pipeline.name} in {shown(config.runs)}: the planned excitation is simulated")
        else:
            paths = [recorded.output("log")]
    if paths:
        return JudgedLogs([shown(p) for p in paths], [open_recording(p, pipeline, robot).episode for p in paths], False)
    if not isinstance(robot, Robot):
        raise UsageError(
            f"pipeline {pipeline.name!r} has no excitation to plan a recording with",
            hint="name a log with --log FILE",
        )
    moving = moving_robot(pipeline)
    commands = len(moving.action)
    signal = moving.around(command_signal(config.record, moving.rate_hz, commands).reshape(-1, commands))
    table = parameters.for_recordings(1)
    values = table.of_recording(table.decode(table.start()), 0)
    return JudgedLogs([PLANNED], [simulate(model, moving, signal, values, fitting, config.record.seed)], True)


def judge(
    model: IdentifiableModel,
    source: JudgedLogs,
    config: IdentifyConfig,
    parameters: ParameterTable,
    units: dict[str, str],
) -> dict[str, Any]:
    """Return what the recordings show, and what they determine at the nominal values, as JSON takes it.

    Args:
        units: Field -> unit.
    """
    for episode in source.episodes:
        check_log(episode, model)
    spans, length_s = cut(source.episodes, config)
    problem = Problem(model, source.episodes, spans, length_s, config, parameters)
    z = problem.table.start()
    at = uncertainty.linearise(problem, z)
    check = identifiability.from_linearised(problem, at)
    delays = [c.label for c in problem.table.columns if c.parameter.kind == "delay"]
    rows, total = _parameters(problem, at, check), _round_trip(problem, at)
    messages = list(check.messages)
    # Only the sum of the delays can be told where initial states are free: then that is all that must be.
    harmless = [g for g in check.undetermined if total and set(g) <= set(delays)]
    open_groups = [list(g) for g in check.undetermined if g not in harmless]
    if total and total["determined"] == "no":
        open_groups.append(delays)
        messages.append(f"not even the sum of {' and '.join(delays)} is determined: let the commands change more")
    return {
        "source": PLANNED if source.planned else "log",
        "recordings": [
            {"name": n, **coverage(e, model, units)} for n, e in zip(source.names, source.episodes, strict=True)
        ],
        "segments": len(spans),
        "segment_s": length_s,
        "condition": check.condition,
        "determined": not open_groups,
        "undetermined": open_groups,
        "only_sum_of_delays": bool(harmless) and delays not in open_groups,
        "messages": messages,
        "parameters": [*rows, *([total] if total else [])],
    }


def coverage(episode: Episode, model: IdentifiableModel, units: dict[str, str]) -> dict[str, Any]:
    """Return when a recording was sampled, what its joints did, and what drove them.

    Args:
        model: Says which nodes and fields matter.
        units: Field -> unit.
    """
    t_s = episode.steps[model.sensor].begun_s
    outputs = episode.outputs[model.sensor]
    joints = []
    for c in model.channels:
        position = np.asarray(c.of(outputs[c.position]), np.float64)
        velocity = (
            recording_coverage.speed(t_s, position) if c.velocity is None else np.asarray(c.of(outputs[c.velocity]))
        )
        own = {"position": recording_coverage.spread(position), "velocity": recording_coverage.spread(velocity)}
        joints.append(
            {
                "name": c.name,
                "unit": unit_of(position_of(c), units),
                **{k: _as_json(v) for k, v in own.items()},
                **asdict(recording_coverage.motion_of(t_s, position)),
            }
        )
    commands = []
    for node, tree in model.given.items():
        sent_s = episode.steps[node].end / TICKS_PER_S
        for field in jax.tree_util.tree_leaves(tree):
            rows = np.asarray(episode.outputs[node][field], np.float64).reshape(len(sent_s), -1)
            for i, values in enumerate(rows.T):
                band = recording_coverage.band(sent_s, values)
                name = f"{node}.{field}" + (f"[{i}]" if rows.shape[1] > 1 else "")
                commands.append(
                    {
                        "name": name,
                        "unit": unit_of(f"{field}[{i}]", units),
                        **_as_json(recording_coverage.spread(values)),
                        **(asdict(band) if band else {"low_hz": None, "high_hz": None}),
                    }
                )
    return {"sampling": asdict(recording_coverage.sampling(t_s)), "joints": joints, "commands": commands}


def cut(episodes: Sequence[Episode], config: IdentifyConfig) -> tuple[list[Span], float]:
    """Return segments side by side, all of them fitted, and their length [s].

    Raises:
        UsageError: When the shortest recording holds none.
    """
    usable = [reach(e, config) for e in episodes]
    shortest = min(end - begin for begin, end in usable)
    length_s = min(config.settle_s + config.horizon_s, shortest)
    if length_s < _LEAST_S:
        raise UsageError(
            f"the shortest recording lasts {min(e.duration_s for e in episodes):.2f} s: too short for a segment",
            hint="record for at least 12 s",
        )
    spans = [
        Span(r, float(b))
        for r, (begin, end) in enumerate(usable)
        for b in np.arange(begin, end - length_s + 1e-6, length_s)
    ]
    if len(spans) > _MOST_SEGMENTS:
        spans = [spans[i] for i in np.linspace(0, len(spans) - 1, _MOST_SEGMENTS).round().astype(int)]
    return spans, length_s


def show(found: dict[str, Any]) -> None:
    """Print what was found, for people."""
    for r in found["recordings"]:
        s = r["sampling"]
        gaps = f"{s['gaps']}, the longest {s['longest_gap_s']:.3g} s" if s["gaps"] else "none"
        print(
            pairs(
                {r["name"]: f"{s['samples']} samples in {s['duration_s']:.1f} s, {s['rate_hz']:.4g} Hz, gaps: {gaps}"}
            )
        )
        print()
        print(table(*_signal_rows(r)))
        print()
        print(table(*_motion_rows(r["joints"])))
        print()
        for c in r["commands"]:
            said = "it is constant" if c["low_hz"] is None else f"{c['low_hz']:.2g} to {c['high_hz']:.2g} Hz"
            print(f"95 % of the power of {c['name']}: {said}")
        print()
    rows = [
        [
            p["name"],
            p["nominal"],
            p["standard_error_per_minute"],
            p["unit"],
            None if p["percent_of_nominal"] is None else f"{p['percent_of_nominal']:.2g} %",
            p["determined"],
        ]
        for p in found["parameters"]
    ]
    print(table(rows, ["parameter", "nominal", "s.e. from a minute", "unit", "of nominal", "determined"]))
    about = {"condition number": f"{found['condition']:.2g}", "directions left open": len(found["undetermined"])}
    print(f"\n{pairs(about)}")
    for message in [*found["messages"], *found["recommendation"]]:
        print(f"- {message}")


def _parameters(problem: Problem, at: uncertainty.Linearised, check: Determined) -> list[dict[str, Any]]:
    """Return the error to expect of each parameter from one minute of such data."""
    loose = {n for group in check.undetermined for n in group}
    rows = []
    for c, error in zip(problem.table.columns, check.standard_error_per_minute.values(), strict=True):
        p = c.parameter
        share = 100 * number(error) / abs(p.nominal) if p.nominal else None
        rows.append(
            {
                "name": c.label,
                "unit": p.unit,
                "nominal": p.nominal,
                "standard_error_per_minute": number(error),
                "percent_of_nominal": share,
                "determined": "alone" if c.label not in loose else "in a group",
                "excite": p.excite,
            }
        )
    return rows


def _round_trip(problem: Problem, at: uncertainty.Linearised) -> dict[str, Any] | None:
    """Return the error to expect of the sum of the delays, where only that can be told."""
    shift = uncertainty.time_shift(problem.table)
    if not shift.any():
        return None
    # With the sensor's delay held, the others move as their sum does.
    rest = np.flatnonzero(~(shift > 0))
    J = at.jacobian.reshape(-1, len(at.x))[:, rest]
    duration_s = problem.segment_s * len(problem.train)
    behind = [int(np.flatnonzero(rest == i)[0]) for i in np.flatnonzero(shift < 0)]

    def error(seconds: float) -> float:
        information = J.T @ J * seconds / duration_s + at.prior[np.ix_(rest, rest)]
        return float(np.sqrt(np.linalg.inv(information)[np.ix_(behind, behind)].sum()))

    return {
        "name": ROUND_TRIP,
        "unit": "s",
        "nominal": None,
        "standard_error_per_minute": error(60.0),
        "percent_of_nominal": None,
        "determined": "alone" if error(duration_s) < SURE_S else "no",
    }


def _signal_rows(recording: dict[str, Any]) -> tuple[list[list[Any]], list[str]]:
    """Return a row for each position, velocity and command: its range, and how it is spread over it."""
    signals = [(c["name"], c["unit"], c) for c in recording["commands"]]
    for j in reversed(recording["joints"]):
        rate = f"{j['unit']}/s" if j["unit"] else ""
        signals[:0] = [(j["name"], j["unit"], j["position"]), (f"speed of {j['name']}", rate, j["velocity"])]
    rows = [
        [
            name,
            f"{s['low']:.3g} to {s['high']:.3g} {unit}".rstrip(),
            f"{s['covered']:.0%}",
            " ".join(f"{100 * share:3.0f}" for share in s["shares"]),
        ]
        for name, unit, s in signals
    ]
    return rows, ["signal", "range", "covered", "samples in each tenth of the range [%]"]


def _motion_rows(joints: Sequence[dict[str, Any]]) -> tuple[list[list[Any]], list[str]]:
    rows = [[j["name"], f"{j['moving']:.0%}", f"{j['forward']:.0%}", j["reversals"]] for j in joints]
    return rows, ["joint", "time in motion", "of it upwards", "reversals"]


def _as_json(found: recording_coverage.Histogram) -> dict[str, Any]:
    return {**asdict(found), "covered": found.covered}
