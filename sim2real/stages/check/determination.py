"""Which parameters recordings determine, from the residuals linearised at the nominal values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.files import number
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.uncertainty import identifiability, uncertainty
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.shared.identification import side_by_side, usable

_MIN_SEGMENT_S = 0.3
_MAX_SEGMENTS = 120
"""Of a longer log this many segments are simulated, evenly distributed: more do not change the result."""


@dataclass(frozen=True)
class ParameterCheck:
    """What recordings say of one parameter.

    Attributes:
        standard_error_per_minute: Standard error to expect from one minute of such data.
        determined: ``alone``, or ``in a group`` of which only combinations are determined.
        excite: The motion that determines it, as text.
    """

    name: str
    unit: str
    nominal: float | None
    standard_error_per_minute: float
    determined: str
    excite: str = ""

    @property
    def percent_of_nominal(self) -> float | None:
        """The standard error as a share of the nominal value [%]; None without one."""
        return 100 * self.standard_error_per_minute / abs(self.nominal) if self.nominal else None


@dataclass(frozen=True)
class Determination:
    """Which parameters recordings determine.

    Attributes:
        segment_s: Length of a segment [s].
        condition: Condition number of the Jacobian, its columns in widths of the bounds.
        undetermined: Groups of parameters; only combinations of the parameters in a group are determined.
    """

    segments: int
    segment_s: float
    condition: float | None
    undetermined: tuple[tuple[str, ...], ...]
    messages: tuple[str, ...]
    parameters: tuple[ParameterCheck, ...]


def determine(
    model: IdentifiableModel, episodes: Sequence[Episode], config: IdentifyConfig, parameters: ParameterTable
) -> Determination:
    """Return which parameters recordings determine: their residuals are simulated once, at the nominal values."""
    spans, length_s = cut_segments(episodes, config)
    problem = Problem(model, episodes, spans, length_s, config, parameters)
    linearised = uncertainty.linearise(problem, problem.table.start())
    found = identifiability.from_linearised(problem, linearised)
    grouped = {name for group in found.undetermined for name in group}
    errors = found.standard_error_per_minute.values()
    rows = [
        ParameterCheck(
            *(c.label, c.parameter.unit, c.parameter.nominal, number(error)),
            *("in a group" if c.label in grouped else "alone", c.parameter.excite),
        )
        for c, error in zip(problem.table.columns, errors, strict=True)
    ]
    return Determination(problem.segments, length_s, found.condition, found.undetermined, found.messages, tuple(rows))


def cut_segments(episodes: Sequence[Episode], config: IdentifyConfig) -> tuple[list[Span], float]:
    """Return segments side by side, all of them fitted, and their length [s]."""
    ends = [usable(e, config) for e in episodes]
    shortest_s = min(end - begin for begin, end in ends)
    length_s = min(config.settle_s + config.horizon_s, shortest_s)
    if length_s < _MIN_SEGMENT_S:
        raise UsageError(
            f"the shortest recording lasts {min(e.duration_s for e in episodes):.2f} s: too short for a segment",
            hint="record for at least 12 s",
        )
    spans = [Span(r, begin) for r, e in enumerate(episodes) for begin in side_by_side(e, config, length_s)]
    if len(spans) > _MAX_SEGMENTS:
        spans = [spans[i] for i in np.linspace(0, len(spans) - 1, _MAX_SEGMENTS).round().astype(int)]
    return spans, length_s
