"""Which parameters recordings determine, from the residuals linearised at the nominal values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.artifacts.files import number
from sim2real.artifacts.identification import ROUND_TRIP, Determined
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.uncertainty import identifiability, uncertainty
from sim2real.identify.uncertainty.round_trip import SURE_S
from sim2real.stages.check.coverage import coverage
from sim2real.stages.check.sources import PLANNED, JudgedLogs
from sim2real.stages.estimation.segment_split import reach
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.types import Json

_MIN_SEGMENT_S = 0.3
_MAX_SEGMENTS = 120
"""Of a longer log this many segments are simulated, evenly distributed: more do not change the result."""


def judge(
    model: IdentifiableModel,
    source: JudgedLogs,
    config: IdentifyConfig,
    parameters: ParameterTable,
    units: Mapping[str, str],
) -> dict[str, Json]:
    """Return the coverage of the recordings and the parameters that they determine, as JSON.

    Args:
        units: Field -> unit.
    """
    # Simulate all segments at the nominal values, with derivatives.
    spans, length_s = cut_segments(source.episodes, config)
    problem = Problem(model, source.episodes, spans, length_s, config, parameters)
    linearised = uncertainty.linearise(problem, problem.table.start())
    determined = identifiability.from_linearised(problem, linearised)
    rows = _parameter_rows(problem, determined)
    round_trip = _round_trip_row(problem, linearised)
    # With free initial states only the sum of the delays is determined. That suffices, so it is no open group.
    messages = list(determined.messages)
    delays = [c.label for c in problem.table.columns if c.parameter.kind == "delay"]
    only_delays = [g for g in determined.undetermined if round_trip and set(g) <= set(delays)]
    open_groups = [list(g) for g in determined.undetermined if g not in only_delays]
    if round_trip and round_trip["determined"] == "no":
        open_groups.append(delays)
        messages.append(f"not even the sum of {' and '.join(delays)} is determined: let the commands change more")
    return {
        "source": PLANNED if source.planned else "log",
        "recordings": covered(model, source, units),
        "segments": problem.segments,
        "segment_s": length_s,
        "condition": determined.condition,
        "determined": not open_groups,
        "undetermined": open_groups,
        "only_sum_of_delays": bool(only_delays) and delays not in open_groups,
        "messages": messages,
        "parameters": [*rows, *([round_trip] if round_trip else [])],
    }


def covered(model: IdentifiableModel, source: JudgedLogs, units: Mapping[str, str]) -> list[dict[str, Json]]:
    """Return the coverage of each recording."""
    pairs = zip(source.names, source.episodes, strict=True)
    return [{"name": name, **coverage(episode, model, units)} for name, episode in pairs]


def cut_segments(episodes: Sequence[Episode], config: IdentifyConfig) -> tuple[list[Span], float]:
    """Return segments side by side, all of them fitted, and their length [s]."""
    usable = [reach(e, config) for e in episodes]
    shortest_s = min(end - begin for begin, end in usable)
    length_s = min(config.settle_s + config.horizon_s, shortest_s)
    if length_s < _MIN_SEGMENT_S:
        raise UsageError(
            f"the shortest recording lasts {min(e.duration_s for e in episodes):.2f} s: too short for a segment",
            hint="record for at least 12 s",
        )
    spans = [
        Span(r, float(b))
        for r, (begin, end) in enumerate(usable)
        for b in np.arange(begin, end - length_s + 1e-6, length_s)
    ]
    if len(spans) > _MAX_SEGMENTS:
        spans = [spans[i] for i in np.linspace(0, len(spans) - 1, _MAX_SEGMENTS).round().astype(int)]
    return spans, length_s


def _parameter_rows(problem: Problem, determined: Determined) -> list[dict[str, Json]]:
    """Return a row for each parameter, with the standard error to expect from one minute of such data."""
    grouped = {name for group in determined.undetermined for name in group}
    rows = []
    for column, error in zip(problem.table.columns, determined.standard_error_per_minute.values(), strict=True):
        p = column.parameter
        rows.append(
            {
                "name": column.label,
                "unit": p.unit,
                "nominal": p.nominal,
                "standard_error_per_minute": number(error),
                "percent_of_nominal": 100 * number(error) / abs(p.nominal) if p.nominal else None,
                "determined": "in a group" if column.label in grouped else "alone",
                "excite": p.excite,
            }
        )
    return rows


def _round_trip_row(problem: Problem, linearised: uncertainty.Linearised) -> dict[str, Json] | None:
    """Return the row of the sum of the delays; None if the model has no direction that shifts the delays in time."""
    shift = uncertainty.time_shift(problem.table)
    if not shift.any():
        return None
    # Hold the sensor's delay: the other delays then have the variance of the sum.
    free = np.flatnonzero(~(shift > 0))
    jacobian = linearised.jacobian.reshape(-1, len(linearised.x))[:, free]
    delays = [int(np.flatnonzero(free == i)[0]) for i in np.flatnonzero(shift < 0)]
    # A longer recording has information in proportion to its duration.
    duration_s = problem.segment_s * len(problem.train)

    def standard_error(seconds: float) -> float:
        information = jacobian.T @ jacobian * seconds / duration_s + linearised.prior[np.ix_(free, free)]
        return float(np.sqrt(np.linalg.inv(information)[np.ix_(delays, delays)].sum()))

    return {
        "name": ROUND_TRIP,
        "unit": "s",
        "nominal": None,
        "standard_error_per_minute": standard_error(60.0),
        "percent_of_nominal": None,
        "determined": "alone" if standard_error(duration_s) < SURE_S else "no",
    }
