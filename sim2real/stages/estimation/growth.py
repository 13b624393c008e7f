"""How errors of predictions grow with the motion: logs of many kinds need a bound for each, not the widest."""

from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.artifacts.identification import Growth
from sim2real.graph.episode import Episode
from sim2real.identify.model import Channel, IdentifiableModel, position_of
from sim2real.identify.problem.segments import Span, rates

LEAST = 12
"""Fewest recordings from which a growth is estimated."""
_GAIN = 0.75
"""Largest ratio of the errors' scatter about a growth to their scatter without one. Each error is compared with the
growth that is fitted to the other errors, because one of seven sizes fits a few errors by chance."""

Sizes = Mapping[str, float]
Motions = Mapping[str, Mapping[str, Sizes]]
"""Recording -> column -> the sizes of its motion."""


def sizes(
    model: IdentifiableModel, recordings: Sequence[Episode], spans: Sequence[Span], length_s: float
) -> dict[str, Sizes]:
    """Return the sizes of the motion of each position in some segments: column -> size -> value.

    Args:
        length_s: Length of a segment [s].
    """
    result: dict[str, Sizes] = {}
    for c in model.channels:
        parts = [_of_segment(model, recordings[s.recording], c, s.begin_s, s.begin_s + length_s) for s in spans]
        if not (parts := [part for part in parts if part]):
            continue
        names = set.intersection(*(set(part) for part in parts))
        columns = {n: np.array([part[n] for part in parts]) for n in sorted(names)}
        result[position_of(c)] = {
            n: float(np.sqrt(np.mean(v**2)) if n.startswith("mean") else v.max()) for n, v in columns.items()
        }
    return result


def _of_segment(model: IdentifiableModel, log: Episode, c: Channel, begin_s: float, end_s: float) -> dict[str, float]:
    """Return the sizes of a position's motion in a segment."""
    t = log.steps[model.sensor].begun_s
    inside = (t >= begin_s) & (t <= end_s)
    if inside.sum() < 2:
        return {}
    t, q = t[inside], np.asarray(c.of(log.outputs[model.sensor][c.position]), np.float64)[inside]
    speed = rates(t, q[:, None])[:, 0]
    result = {"range": float(np.ptp(q))}
    if speed.size:
        result |= {"largest speed": float(np.abs(speed).max()), "mean speed": float(np.sqrt(np.mean(speed**2)))}
    for node in model.given:
        if c.goal is None or c.goal not in log.outputs[node]:
            continue
        # Take the goals from the newest one before the segment on.
        sent_s = log.steps[node].begun_s
        goals = np.asarray(c.of(log.outputs[node][c.goal]), np.float64)
        first, last = max(0, np.searchsorted(sent_s, begin_s) - 1), np.searchsorted(sent_s, end_s)
        newest = np.clip(np.searchsorted(sent_s, t, side="right") - 1, 0, len(goals) - 1)
        off = np.abs(goals[newest] - q)
        steps = np.abs(np.diff(goals[first:last]))
        result |= {"largest lag": float(off.max()), "mean lag": float(np.sqrt(np.mean(off**2)))}
        result |= {"largest step": float(steps.max())} if steps.size else {}
    return result


def growth(errors: Sequence[float], motions: Sequence[Sizes]) -> Growth | None:
    """Return how errors grow with the size of the motion that explains them best; None if no size explains enough.

    Args:
        errors: Errors on recordings.
        motions: The sizes of each recording's motion.
    """
    if len(errors) < LEAST:
        return None
    logs, count = np.log(np.maximum(errors, 1e-300)), len(errors)
    off = logs - logs.mean()
    best, least = None, _GAIN * float(off.std()) * count / (count - 1)
    for name in sorted(set.intersection(*(set(m) for m in motions))):
        values = np.array([m[name] for m in motions])
        if values.min() <= 0.0 or np.ptp(x := np.log(values)) < 1e-6:
            continue
        x = x - x.mean()
        power, leverage = float(x @ off / (x @ x)), 1.0 / count + x**2 / (x @ x)
        scatter = float(np.sqrt(np.mean(((off - power * x) / np.maximum(1.0 - leverage, 1e-9)) ** 2)))
        if power > 0.0 and scatter < least:
            ends = float(values.min()), float(values.max())
            best, least = Growth(name, power, float(np.median(values)), *ends), scatter
    return best
