"""How logs are cut into segments: those that are fitted, and those that are held out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.problem.segments import Span
from sim2real.stages.identify.config import IdentifyConfig

_WINDOW_SPACING_S = 0.5
_EDGES_S = (0.3, 0.2)
"""What is left out at the beginning and at the end of a log where initial states are estimated [s]."""


def spans(
    episodes: Sequence[Episode],
    fitted: int,
    config: IdentifyConfig,
    length_s: float,
    spacing_s: float = _WINDOW_SPACING_S,
) -> list[Span]:
    """Return segments of one length, those to fit and those that are held out.

    Args:
        episodes: The logs; those that are held out whole come last.
        config: Which share of each is held out, and how far apart segments start.
        length_s: Of a segment [s].
        spacing_s: Between the starts of segments that are held out [s].

    Raises:
        UsageError: When the logs are too short.
    """
    found: list[Span] = []
    for r, episode in enumerate(episodes):
        begin, end = reach(episode, config)
        split = split_of(episode, r < fitted, config)
        last = end - length_s + 1e-6
        step_s = config.spacing_s or length_s
        found += [Span(r, float(b)) for b in np.arange(begin, min(split - length_s, last) + 1e-6, step_s)]
        found += [Span(r, float(b), False) for b in np.arange(split, last, spacing_s)]
    used = sum(s.fitted for s in found)
    if not used or used == len(found) or (config.initial_state == "free" and used < 3):
        lengths = ", ".join(f"{e.duration_s:.1f} s" for e in episodes)
        raise UsageError(
            f"the logs last {lengths}: that makes {used} segments of {length_s:g} s to fit and "
            f"{len(found) - used} to hold out",
            hint="record for at least 12 s, or shorten --settle-s and --horizon-s",
        )
    return found


def reach(episode: Episode, config: IdentifyConfig) -> tuple[float, float]:
    """Return from when to when a log can be cut into segments [s].

    Where initial states are estimated, samples before and after a segment's start must be there.
    """
    if config.initial_state != "free":
        return 0.0, episode.duration_s
    return _EDGES_S[0], episode.duration_s - _EDGES_S[1]


def split_of(episode: Episode, fitted: bool, config: IdentifyConfig) -> float:
    """Return when the held-out part of a log begins [s].

    Args:
        fitted: Whether it is fitted at all; else all of it is held out.
    """
    begin, end = reach(episode, config)
    return begin + (1.0 - config.held_out) * (end - begin) if fitted else begin
