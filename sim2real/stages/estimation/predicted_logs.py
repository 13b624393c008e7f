"""Logs with data that was not fitted, and how much further their motion goes than the fitted one."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sim2real.artifacts.identification import HeldOutPart
from sim2real.identify.problem.segments import Signal, range_of, speed_range_of
from sim2real.identify.validation.verdict import Position

LEAST_PARTS = 2
"""Fewest errors from which a bound on another part follows."""
_MAX_STRETCH = 10.0
"""Largest factor of a bound: for a motion that differs more the bound is no estimate of anything."""


@dataclass(frozen=True)
class Predicted:
    """A recording with held-out data.

    Attributes:
        source: Its held-out data, for people.
        later: Whether the bounds on later logs follow from its errors, too.
        stretch: Column -> factor of the bound; see ``stretches``.
        sizes: Column -> sizes of its motion; see ``growth.sizes``.
    """

    source: str
    later: bool
    stretch: Mapping[str, float] = field(default_factory=dict)
    sizes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def stretches(
    fitted: Mapping[str, Signal], later: Mapping[str, Signal], positions: Sequence[Position]
) -> dict[str, float]:
    """Return the factor of each position's bound for data whose motion is faster or reaches further than the fitted.

    The factor is the ratio of the largest speeds, times one more than the excess of the range of any position, as a
    share of its fitted range. A hinge has been everywhere after a whole turn, and goes nowhere else by more turns.

    Args:
        fitted: Ranges of the fitted segments; see ``segments.ranges``.
        later: Ranges of the data.
    """
    if not fitted or not later:
        return {p.column: 1.0 for p in positions}
    excess, faster = 0.0, dict[str, float]()
    for p in positions:
        (low, high), (lowest, highest) = (range_of(r, p.column) for r in (fitted, later))
        further = max(low - lowest, 0.0) + max(highest - high, 0.0)
        if p.unit == "rad":
            further = min(further, max(2 * math.pi - (high - low), 0.0))
        excess = max(excess, further / max(high - low, 1e-300))
        before, now = (max(map(abs, speed_range_of(r, p.column))) for r in (fitted, later))
        faster[p.column] = max(1.0, now / before) if before > 0.0 else 1.0
    return {column: min(ratio * (1.0 + excess), _MAX_STRETCH) for column, ratio in faster.items()}


def predicted(
    names: Sequence[str],
    fitted: int,
    parts: Sequence[HeldOutPart],
    stretch: Sequence[Mapping[str, float]] = (),
    sizes: Sequence[Mapping[str, Mapping[str, float]]] = (),
) -> list[Predicted]:
    """Return the recordings of an identification, in their order.

    The last quarter of a fitted recording comes after all blocks of it. Beside a held-out recording it is no further
    draw, as the rest of its recording was fitted.

    Args:
        names: The names of the logs; those that are held out whole come last.
        stretch: For each log the factor of each position's bound.
        sizes: For each log the sizes of its motion.
    """
    blocks = in_blocks(names[:fitted], parts)
    ends = [f"the held-out end of {name}" if fitted > 1 else "the held-out end" for name in names[:fitted]]
    sources = [(end, blocks) for end in ends] + [(name, True) for name in names[fitted:]]
    factors, moved = ([*rows, *({} for _ in names[len(rows) :])] for rows in (stretch, sizes))
    return [Predicted(*source, f, m) for source, f, m in zip(sources, factors, moved, strict=True)]


def in_blocks(names: Sequence[str], parts: Sequence[HeldOutPart]) -> bool:
    """Return whether the parts are blocks of recordings instead of whole ones."""
    return len(names) < LEAST_PARTS or len(parts) > len(names)
