"""Finds a pattern of steps and ticks that all episodes of a timeline repeat, where rates do not divide.

A policy of 30 Hz over a world of 100 Hz makes 3 steps in 10 ticks. Rows of 3 ticks need a row without a policy step now
and then, so each result in a row is masked. A row of 10 ticks with three steps at fixed ticks, as in a loop written by
hand, needs no mask. It exists if the steps of all episodes have slack at the same ticks.
"""

from fractions import Fraction

import numpy as np

from sim2real.runtime.compilation.placement import Placement, Placer, get_heard
from sim2real.runtime.compilation.slots import Steps

LONGEST = 16
"""Most ticks of a pattern: XLA compiles each of them."""


def find_pattern(placer: Placer) -> Placement | None:
    """Return the placement in rows that are patterns; None if rates divide, or an episode departs from the pattern.

    Such a row has ticks between its slots, see ``Placement.offsets``. The last row may have fewer ticks.
    """
    if placer.world is None or placer.supervisor not in placer.others:
        return None
    rate = placer.nodes[placer.world].rate
    ticks, steps = Fraction(rate / placer.nodes[placer.supervisor].rate).limit_denominator(LONGEST).as_integer_ratio()
    counts = {n: ticks * placer.nodes[n].rate / rate for n in placer.others}
    if steps == 1 or ticks > LONGEST or any(abs(c - round(c)) > 1e-6 or round(c) < 1 for c in counts.values()):
        return None
    tick = _ticks(placer, ticks, {n: round(c) for n, c in counts.items()})
    return None if tick is None else _fill(placer, ticks, tick)


def _ticks(placer: Placer, ticks: int, counts: dict[str, int]) -> Steps | None:
    """Return the tick before which each step is computed: the same in each repetition and episode, early.

    Steps that depend on ticks after the last one are not computed.
    """
    # The range of ticks of each step, and the first tick of each repetition.
    lowest, highest = placer.slack(2 * ticks)
    base = {n: placer.steps(n) // counts[n] * ticks for n in placer.others}

    def repeated(name: str, tick: np.ndarray) -> np.ndarray:
        """Return the latest of the given ticks ``(E, N)`` over all repetitions, for each step ``(E, N)``."""
        count = counts[name]
        ahead = np.where(placer.valid(name), tick - base[name], 0).max(axis=0, initial=0)
        return base[name] + np.array([ahead[i::count].max(initial=0) for i in range(count)])[placer.steps(name) % count]

    # Move readers behind their senders until nothing changes; give up if one leaves its range.
    tick = {n: repeated(n, lowest[n]) for n in placer.others}
    changed = True
    while changed:
        changed = False
        for reader, edge, newest in placer.live():
            if placer.world in (reader, edge.sender):
                continue
            new = repeated(reader, np.maximum(tick[reader], get_heard(tick[edge.sender], newest)))
            changed |= bool((new != tick[reader]).any())
            tick[reader] = new
            if (new > highest[reader])[placer.valid(reader)].any():
                return None
    # Steps that start after the last tick stay there.
    fits = all((tick[n] <= highest[n])[placer.valid(n)].all() and (np.diff(tick[n]) >= 0).all() for n in placer.others)
    count = int(placer.timeline.vertices[placer.world or ""].count.min())
    return {n: np.where(lowest[n] > count, count + 2 * ticks, t) for n, t in tick.items()} if fits else None


def _fill(placer: Placer, ticks: int, tick: Steps) -> Placement:
    """Return the placement for given ticks of the steps."""
    count = int(placer.timeline.vertices[placer.world or ""].count.min())
    rows = -(-count // ticks)
    every = placer.fill(1, rows * ticks, tick)  # as if there were a boundary before each tick
    # Keep the slots that are used at any boundary of a row.
    size = len(every.slots)
    used = np.zeros(ticks * size, bool)
    for n in placer.others:
        used[(tick[n] % ticks * size + every.slot[n])[placer.valid(n) & (tick[n] < rows * ticks)]] = True
    number = np.cumsum(used) - 1
    return Placement(
        ticks=ticks,
        rows=rows,
        row={n: t // ticks for n, t in tick.items()},
        slot={n: number[t % ticks * size + every.slot[n]] for n, t in tick.items()},
        slots=tuple(every.slots[i % size] for i in np.flatnonzero(used)),
        offsets=tuple(int(i) // size for i in np.flatnonzero(used)),
        last=count - (rows - 1) * ticks,
    )
