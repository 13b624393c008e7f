"""The ledger of promises: each predicted error beside the bound that was given before it, and bounds on later errors.

A bound follows from the errors on parts of the recordings, each of a fit without it. With a single recording the parts
are blocks of it, which are alike; what comes after it differs, in time and in temperature. So the held-out quarter
counts as a part, and the bound on later data begins at its error if that is larger.

Many recordings are of several kinds: steps are predicted ten times worse than sines. From twelve on, errors are
compared in proportion to a power of the motion's size, and each log has a bound of its own (``growth``).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from sim2real.artifacts.identification import (
    AHEAD,
    FREE_RUN,
    Bound,
    Growth,
    HeldOutPart,
    Identification,
    Promise,
    Reach,
    too_many_broken,
)
from sim2real.identify.validation.draws import SPREAD
from sim2real.identify.validation.folds import MOVES
from sim2real.identify.validation.verdict import Position
from sim2real.stages.estimation.growth import Motions, growth
from sim2real.stages.estimation.predicted_logs import LEAST_PARTS, Predicted

_PRIOR_DEVIATION, _PRIOR_PARTS = 0.3, 4.0
"""The deviation of the logarithm of errors between parts before any error, and the number of parts that it counts
as."""
_NOISE = 2.0
"""Errors below this many deviations of the measurement count as noise: no bound is below."""
_VAGUE = 4.0
"""Ratio of a bound to the worst error above which the text asks for more recordings."""
_MOST = 3
"""Most broken promises that are named."""
_SHARE = 0.95
"""Share of later errors below their bound."""
Growths = Mapping[tuple[str, Reach], Growth]
NO_GROWTHS: Growths = {}
THIS_RECORDING, SUCH_RECORDINGS = "this recording", "recordings like these"


def further(errors: np.ndarray, later: np.ndarray | None = None) -> float:
    """Return the error below which a further part stays with 95 % probability.

    Errors are taken as log-normal. The deviation of their logarithms is pooled with a prior, as few parts may be alike,
    or differ, by chance. The result is the upper end of a one-sided prediction interval (Student). Of many errors, the
    one that a further error is below with this probability, for any distribution, is the least bound.

    Args:
        errors: Shape ``(K,)``: errors on parts.
        later: Shape ``(L,)``: errors on what came after the fitted data. If these are larger, the interval's centre is
            theirs.
    """
    groups = [np.log(np.maximum(e, 1e-300)) for e in (errors, later) if e is not None and e.size]
    count = sum(map(len, groups))
    # Pool the deviation about the mean of each group: the step between the groups moves the centre instead.
    freedom = _PRIOR_PARTS + count - len(groups)
    squares = _PRIOR_PARTS * _PRIOR_DEVIATION**2 + sum(float(np.sum((g - g.mean()) ** 2)) for g in groups)
    centre = max(float(np.concatenate(groups).mean()), float(groups[-1].mean()) if len(groups) > 1 else -math.inf)
    width = stdtrit(freedom, _SHARE) * math.sqrt(squares / freedom * (1.0 + 1.0 / count))
    rank = math.ceil(_SHARE * (count + 1) - 1e-9)
    every = np.sort(np.concatenate(groups))
    return math.exp(max(centre + width, every[rank - 1] if rank <= count else -math.inf))


def ledger(
    document: Identification,
    parts: Sequence[HeldOutPart],
    positions: Sequence[Position],
    recordings: Sequence[Predicted],
    motions: Motions | None = None,
    growths: Growths = NO_GROWTHS,
) -> tuple[Promise, ...]:
    """Return each error on held-out parts and on held-out data, beside the bound from the other parts.

    Args:
        document: With predictions and free runs.
        motions: The sizes of the parts' motions.
        growths: Result of ``growths_of``.
    """
    rows = []
    for p in positions:
        for reach in (AHEAD, FREE_RUN):
            held_out = _held_out(document, p, reach, recordings)
            seconds = max((run_s for _, _, run_s in held_out), default=0.0)
            errors = [(part, _of_part(part, p, reach)) for part in parts]
            errors = [(part, error) for part, error in errors if error is not None]
            # Each held-out part beside the other parts, then held-out data beside all parts.
            grown = growths.get((p.column, reach))
            sizes = [(motions or {}).get(part.name, {}).get(p.column, {}) for part, _ in errors]
            factors = [grown.factor(those, 1.0) if grown else 1.0 for those in sizes]
            usual = [error / factor for (_, error), factor in zip(errors, factors, strict=True)]
            for k, (part, error) in enumerate(errors):
                others, run_s = usual[:k] + usual[k + 1 :], seconds if reach == AHEAD else part.run_s
                rows.append(_promise(p, part.name, False, reach, run_s, error, others, factors[k]))
            for recording, error, run_s in held_out:
                stretch = recording.stretch.get(p.column, 1.0)
                factor = grown.factor(recording.sizes.get(p.column, {}), stretch) if grown else stretch
                rows.append(_promise(p, recording.source, True, reach, run_s, error, usual, factor))
    return tuple(rows)


def growths_of(parts: Sequence[HeldOutPart], positions: Sequence[Position], motions: Motions) -> Growths:
    """Return with which size of the motion errors on held-out parts grow: column and reach -> growth."""
    growths = {}
    for p in positions:
        for reach in (AHEAD, FREE_RUN):
            errors = [(part.name, _of_part(part, p, reach)) for part in parts]
            errors = [(name, error) for name, error in errors if error is not None and math.isfinite(error)]
            grown = growth([e for _, e in errors], [motions.get(name, {}).get(p.column, {}) for name, _ in errors])
            growths |= {(p.column, reach): grown} if grown else {}
    return growths


def bounds(
    document: Identification, recordings: Sequence[Predicted], blocks: bool, growths: Growths = NO_GROWTHS
) -> tuple[Bound, ...]:
    """Return the bounds on errors of later logs.

    Args:
        document: With its ledger.
        blocks: Whether the held-out parts are blocks of recordings instead of whole ones.
        growths: Result of ``growths_of``.
    """
    later = {r.source for r in recordings if r.later}
    groups: dict[tuple[str, Reach], list[Promise]] = {}
    for row in document.promises:
        groups.setdefault((row.column, row.reach), []).append(row)
    result = []
    for (column, reach), rows in groups.items():
        # Where a prediction diverged, there is no bound on later errors.
        if any(row.error is None for row in rows):
            continue
        counted = [row for row in rows if not row.fresh or row.source in later]
        if not counted:
            continue

        def limit(stretched: bool, those: Sequence[Promise] = counted, column: str = column) -> float:
            """Return the bound on errors, or on errors over the factors of their motions."""
            fresh = [r.fresh for r in those]
            errors = np.array([(r.error or 0.0) / (r.stretch if stretched else 1.0) for r in those])
            inside, after = errors[~np.array(fresh)], errors[fresh]
            return max(further(inside, after), _NOISE * document.sigma.get(column, 0.0))

        # The bound is for any motion, that of a growth for a usual one.
        grown = growths.get((column, reach))
        scope, seconds = THIS_RECORDING if blocks else SUCH_RECORDINGS, max(row.seconds for row in rows)
        grown = replace(grown, bound=limit(True)) if grown else None
        result.append(Bound(column, rows[0].name, rows[0].unit, reach, seconds, limit(not grown), scope, grown))
    return tuple(result)


def of(document: Identification) -> dict[tuple[str, Reach], Bound]:
    """Return the bounds of an identification: column and reach -> bound.

    A file of version 0.1 has the errors on held-out parts only: from these follow its bounds.
    """
    if document.bounds or document.promises:
        return {(b.column, b.reach): b for b in document.bounds}
    result, horizon_s = {}, max((r.horizon_s for r in document.held_out), default=0.0)
    for row in document.held_out:
        errors = _finite([part.ahead.get(row.column) for part in document.left_out])
        if errors.size >= LEAST_PARTS:
            bound = Bound(row.column, row.name, row.unit, AHEAD, horizon_s, further(errors), SUCH_RECORDINGS)
            result[row.column, AHEAD] = bound
    return result


def on_later_logs(
    document: Identification,
    positions: Sequence[Position],
    logs: Sequence[Predicted],
    limits: Mapping[tuple[str, Reach], Bound],
) -> list[Promise]:
    """Return the errors on logs that were not fitted beside their bounds.

    Args:
        document: With predictions and free runs of these logs.
    """
    rows = []
    for p in positions:
        for reach in (AHEAD, FREE_RUN):
            bound = limits.get((p.column, reach))
            for log, error, seconds in _held_out(document, p, reach, logs):
                row = Promise(log.source, True, p.column, p.name, p.unit, reach, seconds, _or_none(error))
                if bound is not None:
                    limit, factor = bound.on(log.sizes.get(p.column, {}), log.stretch.get(p.column, 1.0))
                    size = math.hypot(limit, _spread(document, p, reach, logs.index(log)))
                    row = replace(row, bound=size, stretch=factor)
                rows.append(row)
    return rows


def _spread(document: Identification, p: Position, reach: Reach, recording: int) -> float:
    """Return the root mean square distance of draws of the posterior from the estimate's free run; 0 without draws.

    The parts of the recordings had errors of the parameters, too. Where the drawn trajectories part, as where an arm
    sticks, this log's are larger than theirs.
    """
    columns = document.free
    if reach == AHEAD or f"{p.column}_{SPREAD}" not in columns:
        return 0.0
    pick = (columns["into"] > document.settle_s) & (columns["recording"] == recording)
    return float(np.sqrt(np.mean(columns[f"{p.column}_{SPREAD}"][pick] ** 2))) if pick.any() else 0.0


def sentences(document: Identification, positions: Sequence[Position]) -> list[str]:
    """Return a sentence for each position and reach: errors on held-out parts, and the bound on later errors."""
    texts, limits = [], of(document)
    for p in positions:
        for reach in (AHEAD, FREE_RUN):
            rows = [r for r in document.promises if r.column == p.column and r.reach == reach]
            errors, bound = _finite([r.error for r in rows if not r.fresh]), limits.get((p.column, reach))
            if errors.size < LEAST_PARTS or bound is None:
                continue
            unit = f" {p.unit}".rstrip()
            how = f"up to {bound.seconds:.3g} s ahead" if reach == AHEAD else "in a free run"
            promise = f"95 % of later parts of {bound.scope} stay below {bound.bound:.2g}{unit}"
            if bound.growth is not None:
                g, per = bound.growth, "/s" if "speed" in bound.growth.size else ""
                promise = f"95 % of later {bound.scope} stay below {g.bound:.2g}{unit} where the {g.size} is the usual "
                promise += f"{g.usual:.2g}{unit}{per}, elsewhere in proportion to its power {g.power:.2g}"
            elif bound.bound > _VAGUE * _finite([r.error for r in rows]).max():
                promise = f"few parts that differ widely promise no more than {bound.bound:.2g}{unit}: record more"
            texts.append(
                f"{p.name}, {how}, on held-out parts: off by {errors.mean():.2g}{unit} on average, "
                f"{errors.max():.2g}{unit} at worst of {errors.size}; {promise}"
            )
    return texts


def broken(rows: Sequence[Promise]) -> list[Promise]:
    """Return the broken promises about data that no estimate depended on, the largest ratio first."""
    return sorted((r for r in rows if r.fresh and r.broken), key=lambda r: -(r.ratio or 0.0))


def broken_sentences(rows: Sequence[Promise]) -> list[str]:
    """Return a sentence for each broken promise, at most ``_MOST``; a single one where so few may be broken."""
    sentences = [f"a promise is broken: {row.sentence()}" for row in broken(rows)]
    if sentences and not too_many_broken(rows):
        count = sum(r.fresh and r.ratio is not None for r in rows)
        return [f"{len(sentences)} of {count} promises are broken, no more than one in twenty; {sentences[0]}"]
    return sentences[:_MOST] + [f"{len(sentences) - _MOST} more promises are broken"] * (len(sentences) > _MOST)


def room(document: Identification, column: str) -> float:
    """Return the ratio of a position's bound to its error on held-out data: the same at each horizon.

    The bound is that for the held-out motion: where it went further than the fitted one, its error was larger for that.
    """
    bound = of(document).get((column, AHEAD))
    error = next((row.rmse["identified"] or 0.0 for row in document.held_out if row.column == column), 0.0)
    if bound is None or error <= 0.0:
        return 1.0
    rows = [r.stretch for r in document.promises if r.fresh and (r.column, r.reach) == (column, AHEAD)]
    stretch = 1.0 if bound.growth else max(rows, default=1.0)
    return max(1.0, stretch * bound.bound / error)


def _promise(
    p: Position,
    source: str,
    fresh: bool,
    reach: Reach,
    seconds: float,
    error: float,
    others: Sequence[float],
    stretch: float = 1.0,
) -> Promise:
    """Return an error beside the bound from the errors on other parts."""
    finite = _finite(others)
    bound = max(stretch * further(finite), _NOISE * p.sigma) if finite.size >= LEAST_PARTS else None
    return Promise(source, fresh, p.column, p.name, p.unit, reach, seconds, _or_none(error), bound, stretch)


def _of_part(part: HeldOutPart, p: Position, reach: Reach) -> float | None:
    """Return the error of a position on a held-out part; None if its joint rests there."""
    return (part.ahead if reach == AHEAD else part.free).get(p.column)


def _held_out(
    document: Identification, p: Position, reach: Reach, recordings: Sequence[Predicted]
) -> list[tuple[Predicted, float, float]]:
    """Return the errors of a position on held-out data: recording, error and length of the prediction [s]."""
    rows, columns = [], document.samples if reach == AHEAD else document.free
    if not columns:
        return []
    counted = columns["held_out"] & (columns["into"] > document.settle_s)
    horizons = {prediction.horizon_s for prediction in document.prediction}
    for r, recording in enumerate(recordings):
        pick = counted & (columns["recording"] == r)
        measured = columns[f"{p.column}_measured"][pick]
        if measured.size and np.ptp(measured) > MOVES * p.sigma:
            off = columns[f"{p.column}_identified"][pick] - measured
            length_s = float(columns["into"][pick].max()) - document.settle_s
            if reach == AHEAD:  # the last sample is up to a period before the horizon
                length_s = min((h for h in horizons if h >= length_s), default=length_s)
            rows.append((recording, float(np.sqrt(np.mean(off**2))), length_s))
    return rows


def _or_none(error: float) -> float | None:
    return error if math.isfinite(error) else None


def _finite(errors: Sequence[float | None]) -> np.ndarray:
    return np.array([e for e in errors if e is not None and math.isfinite(e)])
