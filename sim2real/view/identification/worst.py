"""The figure beside the verdict on an identification: the worst joint in its worst second."""

from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.identification import Identification, WorstSecond
from sim2real.log.schema import unit_of
from sim2real.view.blocks import FigureBlock
from sim2real.view.identification.figures import GOAL
from sim2real.view.panels import Line, compared, with_gaps

_AROUND_S = 1.0
"""Time that is drawn before and after the worst second [s]."""
_RESIDUAL = "residual"


@dataclass(frozen=True)
class WorstLines:
    """The lines of the figure.

    Attributes:
        lines: Command if it is a position, measurement and prediction, with gaps between segments.
        residual: Measured minus identified.
    """

    worst: WorstSecond
    lines: tuple[Line, ...]
    residual: Line


def worst_lines(result: Identification) -> WorstLines | None:
    """Return the lines of the figure; None if the worst second or the samples are missing."""
    worst = result.worst
    if worst is None or f"{worst.column}_identified" not in result.samples:
        return None
    s = result.samples
    # The segment of the worst second comes first, then those around it that do not overlap it.
    begin_s, end_s = worst.begin_s - _AROUND_S, worst.end_s + _AROUND_S
    inside = s["segment"] == worst.segment
    first_s, last_s = float(s["t"][inside].min()), float(s["t"][inside].max())
    others = (
        result.disjoint() & ~inside & (s["recording"] == worst.recording) & ((s["t"] < first_s) | (s["t"] > last_s))
    )
    rows = np.flatnonzero((inside | others) & (s["t"] >= begin_s) & (s["t"] <= end_s))
    rows = rows[np.argsort(s["t"][rows], kind="stable")]
    # Collect the lines; a command has a column only if it is a position.
    roles = {GOAL: "command", "measured": "measured", "identified": "identified"}
    lines = tuple(
        Line(*with_gaps(s["t"][rows], s[f"{worst.column}_{column}"][rows], s["segment"][rows]), role, role)
        for column, role in roles.items()
        if f"{worst.column}_{column}" in s
    )
    unit, scale = unit_of(worst.column, result.units) or worst.unit, 1.0
    rest = s[f"{worst.column}_measured"][rows].astype(float) - s[f"{worst.column}_identified"][rows]
    if unit in ("rad", "m") and worst.rmse is not None and worst.rmse < 0.1:
        unit, scale = f"m{unit}", 1e3
    label = f"{_RESIDUAL} [{unit}]" if unit else _RESIDUAL
    residual = Line(*with_gaps(s["t"][rows], scale * rest, s["segment"][rows]), label, "residual")
    return WorstLines(worst, lines, residual)


def worst_figure(result: Identification, name: str) -> FigureBlock | None:
    """Return the figure; None if the worst second is unknown."""
    drawn = worst_lines(result)
    if drawn is None:
        return None
    worst = drawn.worst
    unit = unit_of(worst.column, result.units) or worst.unit
    label = f"{worst.name} [{unit}]" if unit else worst.name
    svg = compared(drawn.lines, drawn.residual, label, (worst.begin_s, worst.end_s), name)
    size = ""
    if worst.of_motion is not None and worst.times_noise is not None:
        size = f", {worst.of_motion:.0%} of the joint's motion and {worst.times_noise:.0f} times the noise"
    residual = "Residual: measured \u2212 identified; the error is its root mean square in this second."
    return FigureBlock(svg, f"The worst second: {worst.text(result.logs)}{size}. {residual}")
