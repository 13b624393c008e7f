"""The search for the second in which the identified model explains a joint worst."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sim2real.artifacts.identification import WorstSecond, worst_window
from sim2real.identify.validation.verdict import NOISE, Position


def worst_second(
    samples: Mapping[str, np.ndarray], positions: Sequence[Position], settle_s: float
) -> WorstSecond | None:
    """Return the worst second of all joints, recordings and segments, fitted and held-out ones; None without samples.

    The second with the largest error beyond the noise, as a share of the joint's motion, is the worst: so a joint that
    moves little, and a joint that moves much, can both be it. If all errors are noise, it is the second with the
    largest error in deviations of a measurement.

    Args:
        samples: Result of ``prediction.samples``.
        settle_s: First part of held-out segments, to which initial states were fitted; it does not count [s].
    """
    best: tuple[tuple[float, float], WorstSecond] | None = None
    segments = list(_segments(samples, settle_s)) if samples else []
    for p in positions:
        if f"{p.column}_identified" not in samples:
            continue
        measured = samples[f"{p.column}_measured"].astype(np.float64)
        squares = (measured - samples[f"{p.column}_identified"]) ** 2
        motion = {r: float(np.std(measured[samples["recording"] == r])) for r in np.unique(samples["recording"])}
        for rows in segments:
            recording = int(samples["recording"][rows[0]])
            begin_s, end_s, error = worst_window(samples["t"][rows], squares[rows])
            # A joint that does not move is compared with its noise.
            still = max(motion[recording], NOISE * p.sigma)
            score = (max(error - NOISE * p.sigma, 0.0) / still, error / p.sigma)
            if best is None or score > best[0]:
                sizes = (error, error / p.sigma, error / still) if math.isfinite(error) else (None, None, None)
                segment = int(samples["segment"][rows[0]])
                best = score, WorstSecond(p.name, p.column, p.unit, recording, segment, begin_s, end_s, *sizes)
    return None if best is None else best[1]


def _segments(samples: Mapping[str, np.ndarray], settle_s: float) -> Iterator[np.ndarray]:
    """Yield the rows of each segment that count."""
    counts = ~samples["held_out"].astype(bool) | (samples["into"] > settle_s)
    for segment in np.unique(samples["segment"][counts]):
        yield np.flatnonzero(counts & (samples["segment"] == segment))
