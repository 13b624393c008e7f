"""A deployment's commands, played again to the models of its robot, and its parameters tested."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.deployment import Replay
from sim2real.artifacts.estimation.drift import Drift
from sim2real.artifacts.identification import UNFINISHED, Identification
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.identify.drift import drift_test
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.search.refine import refine
from sim2real.identify.validation import prediction
from sim2real.identify.validation.folds import MOVES
from sim2real.identify.validation.verdict import positions
from sim2real.robots.contract import RecordedRobot
from sim2real.robots.worlds import in_world
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import Pipeline

AS_HERE = "as in this log"
"""The model with the parameters that the deployment's own log has."""
_SEGMENT_S = 0.4
"""Length of a segment at least [s]; a balanced pendulum's errors grow tenfold in 0.2 s: longer ones say little."""
_LEAST, _LEAST_S = 4, 5.0
"""Segments with motion that a test needs at least, and length of all logs [s]."""
_NOISE = 2.0
"""Errors below this many deviations of the measurement are its noise."""


def tested(pipeline: Pipeline, found: Identification, episodes: Sequence[Episode]) -> tuple[list[Replay], Drift]:
    """Play recorded commands to the identified and to the nominal model, and test the parameters.

    What is compared is what the sensor said with what the model's sensor would say, as late and at the log's times.

    Raises:
        Sim2RealError: When the logs are too short, or what was identified does not fit the robot.
    """
    robot = held_out_parts.having(in_world(pipeline.load(), found.world), [p.name for p in found.parameters])
    late = [p.upper for p in found.parameters if p.kind == "delay" and p.upper is not None]
    longest_s = max([pipeline.identify.max_delay_s, *late])
    config = replace(pipeline.identify, settle_s=found.settle_s, max_delay_s=longest_s)
    problem, ahead_s = segments(robot, found, episodes, config)
    if found.posterior is None:
        ended = UNFINISHED.get(found.verdict.status, "has no intervals")
        raise Sim2RealError(
            f"this identification {ended}: its estimates may be far off", hint=found.verdict.next or None
        )
    drifted, x = drift_test.drift(problem, found.posterior, found.widening or 1.0, robot.causes)
    z = refine(problem, problem.table.at_scale(x)[None], settle=False).z
    here = {n: float(np.ravel(v)[0]) for n, v in problem.table.decode(z).items()}
    nominal = {p.name: p.nominal for p in problem.model.parameters}
    models = {"identified": {n: found.values.get(n, v) for n, v in nominal.items()}, AS_HERE: here, "nominal": nominal}
    every = np.ones(problem.segments, bool)
    columns = prediction.samples(problem, models, config.settle_s, every)
    errors = prediction.errors(problem, columns, list(models), config.settle_s, [ahead_s])
    promised, still = (_held_out(found, model, ahead_s) for model in ("identified", "hold"))
    rows = []
    for position in positions(problem.model, robot.units):
        rmse = {e.model: e.rmse.get(position.column) for e in errors if e.held_out}
        rmse = {m: e if e is not None and math.isfinite(e) else None for m, e in rmse.items()}
        own, moved, now = promised.get(position.column), still.get(position.column), rmse.get("hold")
        if own is not None:  # a model's error grows with the motion
            own = max(own, _NOISE * position.sigma) * max(1.0, now / moved if now and moved else 1.0)
        free = _free_run(found, position.column)
        rows.append(Replay(position.name, position.unit, ahead_s, rmse, own, position.column, free))
    return rows, drifted


def segments(
    robot: RecordedRobot, found: Identification, episodes: Sequence[Episode], config: IdentifyConfig
) -> tuple[Problem, float]:
    """Return logs in short segments, with the parameters that were identified, and how far ahead they predict [s].

    Raises:
        Sim2RealError: When there is too little to test.
    """
    model = robot.watched(config.max_delay_s)
    if own := [p.name for p in model.parameters if p.free and p.per_recording]:
        raise Sim2RealError(f"{', '.join(own)} differ from recording to recording: of a new log they are not known")
    horizons = sorted({p.horizon_s for p in found.prediction})
    length_s = max(_SEGMENT_S, config.settle_s + (horizons[0] if horizons else 0.0))
    ahead_s = max([h for h in horizons if config.settle_s + h <= length_s + 1e-9], default=length_s - config.settle_s)
    spans = []
    for r, episode in enumerate(episodes):
        begin, end = reach(episode, config)
        begins = np.arange(begin, end - length_s + 1e-6, length_s)
        spans += [Span(r, float(b)) for b in begins if _moves(model, episode, b, length_s)]
    seconds = sum(e.duration_s for e in episodes)
    if len(spans) < _LEAST or seconds < _LEAST_S:
        moving = f", {length_s * len(spans):.1f} s of them in motion,"
        raise Sim2RealError(f"{seconds:.1f} s of deployment{moving} are too little to test the model on")
    own = {p.name for p in robot.identifiable(config.max_delay_s).parameters if p.free}
    watched = {p.name for p in model.parameters if p.free} - own
    table = known_table(model.parameters, found, watched)
    return Problem(model, list(episodes), spans, length_s, config, table), ahead_s


def known_table(parameters: ParameterTable, found: Identification, watched: Container[str] = ()) -> ParameterTable:
    """Return parameters with the terms that were identified and what was fixed then, and bounds that hold the search's.

    Args:
        watched: Names of those that stay free though they were fixed, from what they were taken to be: a payload.
    """
    terms = {p.term for p in parameters if p.term and (p.free or p.term in (found.terms or ()))}
    fixed = {p.name: p.estimate for p in found.parameters if p.verdict == "fixed"}
    known = {n: v for n, v in fixed.items() if n in {p.name for p in parameters}}
    table = parameters.with_terms(terms).with_nominal(known)
    table = table.with_fixed({n: v for n, v in known.items() if n not in watched})
    free = {p.name for p in table if p.free}
    wider = {
        p.name: (min(p.lower, table[p.name].low), max(p.upper, table[p.name].high))
        for p in found.parameters
        if p.name in free and p.kind != "delay" and p.lower is not None and p.upper is not None
    }
    return table.with_bounds(wider)


def _moves(model: IdentifiableModel, episode: Episode, begin_s: float, length_s: float) -> bool:
    """Return whether any joint moves in a part of a log [s].

    Segments without motion do not count: all are alike, so that they are one, and where a joint sticks a model with
    smooth friction creeps.
    """
    t = episode.steps[model.sensor].begun_s
    inside = (t >= begin_s) & (t <= begin_s + length_s)
    read = episode.outputs[model.sensor]
    return any(
        inside.any() and float(np.ptp(c.of(read[c.position][inside]))) > MOVES * c.position_sigma
        for c in model.channels
    )


def _held_out(found: Identification, model: str, ahead_s: float) -> Mapping[str, float]:
    """Return a model's error on the data that identification held out, by field."""
    rows = [p for p in found.prediction if p.model == model and p.held_out and p.horizon_s == ahead_s]
    return {n: e for row in rows for n, e in row.rmse.items() if e is not None}


def _free_run(found: Identification, column: str) -> float | None:
    """Return how far the model was off a position in free runs over held-out data, on average; None where unknown."""
    rows = [r.rmse for r in found.free_run if r.model == "identified" and r.held_out and r.field == column]
    errors = [e for e in rows if e is not None]
    return float(np.mean(errors)) if errors and len(errors) == len(rows) else None
