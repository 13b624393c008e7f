"""The residuals of later logs, such as of a deployment, with the parameters of an identification."""

from collections.abc import Container, Sequence

import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.identify.model import ChecksLogs, IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.validation.folds import MOVES
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.identify.config import IdentifyConfig

_SEGMENT_S = 0.4
"""Shortest segment [s]. Errors of a balanced pendulum grow tenfold in 0.2 s, so long segments do not separate
models."""
_LEAST, _LEAST_S = 4, 5.0
"""Fewest segments with motion for a test, and the shortest length of all logs [s]."""


def longest_delay_s(robot: RecordedRobot, identification: Identification, least_s: float) -> float:
    """Return the ``max_delay_s`` whose model has room for the delays of an identification [s].

    Args:
        least_s: Its smallest value [s].
    """
    highs = {p.name: p.high for p in robot.identifiable(1.0).parameters if p.kind == "delay"}
    uppers = {p.name: p.upper for p in identification.parameters if p.kind == "delay" and p.verdict != "fixed"}
    return max([least_s, *(u / highs[n] for n, u in uppers.items() if u is not None and n in highs)])


def problem_of_logs(
    robot: RecordedRobot, identification: Identification, episodes: Sequence[Episode], config: IdentifyConfig
) -> tuple[Problem, float]:
    """Return later logs in short segments, with the identified parameters, and the horizon of the predictions [s].

    Raises:
        Sim2RealError: When the logs are too short or of another motion, or parameters differ between recordings.
    """
    model = robot.watched(config.max_delay_s)
    if separate := [p.name for p in model.parameters if p.free and p.per_recording]:
        raise Sim2RealError(f"{', '.join(separate)} differ between recordings: a new log has no values for them")
    if isinstance(model, ChecksLogs):
        for episode in episodes:
            model.check(episode)
    # Choose the length of segments and the horizon.
    horizons = sorted({p.horizon_s for p in identification.prediction})
    length_s = max(_SEGMENT_S, config.settle_s + (horizons[0] if horizons else 0.0))
    ahead_s = max([h for h in horizons if config.settle_s + h <= length_s + 1e-9], default=length_s - config.settle_s)

    # Cut the logs; parts without motion are dropped.
    spans = []
    for r, episode in enumerate(episodes):
        begin, end = reach(episode, config)
        begins = np.arange(begin, end - length_s + 1e-6, length_s)
        spans += [Span(r, float(b)) for b in begins if _moves(model, episode, b, length_s)]
    seconds = sum(e.duration_s for e in episodes)
    if len(spans) < _LEAST or seconds < _LEAST_S:
        moving = f", {length_s * len(spans):.1f} s of them in motion,"
        raise Sim2RealError(f"{seconds:.1f} s of deployment{moving} are too little to test the model on")

    # Free the parameters that may have changed since.
    identified = {p.name for p in robot.identifiable(config.max_delay_s).parameters if p.free}
    watched = {p.name for p in model.parameters if p.free} - identified
    table = _table(model.parameters, identification, watched)
    return Problem(model, list(episodes), spans, length_s, config, table), ahead_s


def _table(parameters: ParameterTable, identification: Identification, watched: Container[str] = ()) -> ParameterTable:
    """Return parameters with the identified terms, the values that were fixed, and bounds that include the search's.

    Args:
        watched: Names of parameters that are free although they were fixed, such as a payload.
    """
    terms = {p.term for p in parameters if p.term and (p.free or p.term in (identification.terms or ()))}
    fixed = {p.name: p.estimate for p in identification.parameters if p.verdict == "fixed"}
    fixed_here = {n: v for n, v in fixed.items() if n in {p.name for p in parameters}}
    table = parameters.with_terms(terms).with_nominal(fixed_here)
    table = table.with_fixed({n: v for n, v in fixed_here.items() if n not in watched})
    free = {p.name for p in table if p.free}
    wider = {
        p.name: (min(p.lower, table[p.name].low), max(p.upper, table[p.name].high))
        for p in identification.parameters
        if p.name in free and p.kind != "delay" and p.lower is not None and p.upper is not None
    }
    return table.with_bounds(wider)


def _moves(model: IdentifiableModel, episode: Episode, begin_s: float, length_s: float) -> bool:
    """Return whether any joint moves in a part of a log [s].

    Segments without motion do not count: all are alike, and a joint that sticks creeps in a model with smooth friction.
    """
    t = episode.steps[model.sensor].begun_s
    inside = (t >= begin_s) & (t <= begin_s + length_s)
    read = episode.outputs[model.sensor]
    return any(
        inside.any() and float(np.ptp(c.of(read[c.position][inside]))) > MOVES * c.position_sigma
        for c in model.channels
    )
