"""The error to expect of an identification on later data.

The expected error of a joint is 1.25 times its worst error on the held-out parts of the recordings, each predicted by a
fit without that part. With ten parts or more, the worst tenth does not count. A motion that is faster, or goes further,
than the fitted motion has larger errors: its expected error is multiplied by a factor.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import (
    ComparedError,
    ExpectedError,
    Identification,
)
from sim2real.identification.held_out import MOVES, HeldOutPart
from sim2real.identification.predictions import NOISE, Position
from sim2real.identification.segments import Extent

_MARGIN = 1.25
"""Ratio of the expected error to the worst error on held-out parts."""
_LEAST_PARTS = 2
"""Fewest held-out parts that give an expected error."""
_MANY, _SHARE = 10, 0.9
"""From this number of errors on, the worst tenth does not count: the worst of 17 parts of an XL330's logs, with a gain
that no other log had, was 3.5 times the median.
"""
_WIDEST = 4.0
"""Largest factor for a motion beyond the fitted range; beyond it no error is expected."""


def wider_for(
    fitted: Mapping[str, Extent], later: Mapping[str, Extent], positions: Sequence[Position]
) -> dict[str, float]:
    """Return joint -> factor of the expected error, for data whose motion goes beyond the fitted one.

    The factor is the larger of two: the ratio of the largest speeds; and 1 plus the part of any position's range
    outside of its fitted range, as a share of the fitted range. A hinge that was fitted over a whole turn is never
    outside.

    Args:
        fitted: Motion of the fitted segments; see ``segments.extents``.
        later: Motion of the data.
    """
    excess, faster = 0.0, dict[str, float]()
    for p in positions:
        if p.name not in fitted or p.name not in later:
            continue
        (low, high, before), (lowest, highest, now) = fitted[p.name], later[p.name]
        further = max(low - lowest, 0.0) + max(highest - high, 0.0)
        if p.unit == "rad":
            further = min(further, max(2 * math.pi - (high - low), 0.0))
        if high > low:
            excess = max(excess, further / (high - low))
        faster[p.name] = now / before if before > 0.0 else 1.0
    return {joint: min(max(ratio, 1.0 + excess), _WIDEST) for joint, ratio in faster.items()}


def with_expected_errors(
    document: Identification,
    positions: Sequence[Position],
    parts: Sequence[HeldOutPart],
    names: Sequence[str],
    wider: Sequence[Mapping[str, float]],
) -> Identification:
    """Return an identification with the expected errors, and its errors on the held-out end of each log.

    The end of a log is compared with the expected error of the held-out parts alone. A log that comes later may differ
    in temperature, so the error on the end of a single recording counts as one more part in the expected error.

    Args:
        document: With samples, free runs, and the errors on all held-out parts.
        names: Names of the logs.
        wider: For each log the result of ``wider_for`` for its held-out part.
    """
    compared, expected, judged = list[ComparedError](), list[ExpectedError](), dict[str, ComparedError]()
    whole = {row.joint: row for row in document.held_out}
    for p in positions:
        for free_run in (False, True):
            # A joint that rests in a part has no error there.
            those = [(part.free if free_run else part.ahead).get(p.column) for part in parts]
            errors = [e if math.isfinite(e) else math.inf for e in those if e is not None]
            limit, rows, later = _expected(errors, p), list[ComparedError](), list[float]()
            for r, error, seconds in _on_held_out(document, p, free_run, len(names)):
                factor = wider[r].get(p.name, 1.0)
                expects = None if limit is None or not math.isfinite(limit) else factor * limit
                size = error if math.isfinite(error) else None
                rows.append(ComparedError(names[r], p.name, p.unit, seconds, size, free_run, expects, field=p.column))
                later.append(error / factor if math.isfinite(error) else math.inf)
            if not free_run and rows and len(names) == 1 and p.name in whole:  # a single log has one part
                judged[p.name] = replace(whole[p.name], expected=rows[0].expected)
            else:
                compared += rows
            everything = _expected([*errors, *later], p) if len(errors) >= _LEAST_PARTS else None
            if everything is not None and math.isfinite(everything):
                runs = [part.run_s for part in parts] if free_run else []
                seconds = max([*(row.seconds for row in rows), *runs], default=0.0)
                expected.append(ExpectedError(p.name, p.unit, seconds, everything, free_run))
    # The joint with the largest expected error, relative to its noise, comes first.
    sigma, sizes = {p.name: p.sigma for p in positions}, dict[str, float]()
    for row in expected:
        sizes[row.joint] = max(sizes.get(row.joint, 0.0), row.error / sigma[row.joint])
    expected.sort(key=lambda row: -sizes[row.joint])
    errors = [judged.get(row.joint, row) if row in document.held_out else row for row in document.errors]
    return replace(document, expected_error=tuple(expected), errors=(*errors, *compared))


def expected_at(document: Identification, joint: str, error_at_horizon: float) -> float:
    """Return the expected error of a joint at a shorter horizon than the longest one.

    Its ratio to the error on held-out parts is that of the longest horizon.

    Args:
        error_at_horizon: The error on held-out parts at the shorter horizon.
    """
    expected = document.expected_of(joint)
    longest = next((row.error for row in document.held_out if row.joint == joint), None)
    if expected is None or not longest:
        return error_at_horizon
    return error_at_horizon * max(1.0, expected.error / longest)


def _expected(errors: Sequence[float], p: Position) -> float | None:
    """Return the expected error; infinite if a part diverged, None with too few parts."""
    if len(errors) < _LEAST_PARTS:
        return None
    worst = max(errors) if len(errors) < _MANY or math.inf in errors else float(np.quantile(errors, _SHARE))
    return max(_MARGIN * worst, NOISE * p.sigma)


def _on_held_out(
    document: Identification, p: Position, free_run: bool, logs: int
) -> Iterator[tuple[int, float, float]]:
    """Yield for each log its number, the error of a position on its held-out part, and the prediction's length [s].

    A log in which the joint rests is left out: no model beats the baseline of standing still there.
    """
    columns = document.free if free_run else document.samples
    if not columns:
        return
    counted = columns["held_out"].astype(bool) & (columns["into"] > document.internal.settle_s)
    horizons = {row.seconds for row in document.errors if not row.log}
    for r in range(logs):
        pick = counted & (columns["recording"] == r)
        measured = columns[f"{p.column}_measured"][pick]
        if not measured.size or np.ptp(measured) <= MOVES * p.sigma:
            continue
        off = columns[f"{p.column}_identified"][pick] - measured
        length_s = float(columns["into"][pick].max()) - document.internal.settle_s
        if not free_run:  # the last sample is up to a period before the horizon
            length_s = min((h for h in horizons if h >= length_s), default=length_s)
        yield r, float(np.sqrt(np.mean(off**2))), length_s
