"""How logs are cut into fitted and held-out segments."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.problem.segments import GRID_S, Span, on_grid
from sim2real.stages.identify.config import IdentifyConfig

_WINDOW_SPACING_S = 0.5
"""Distance between the starts of held-out segments [s]."""
_LONG_S = 5.0
"""Length of the segments of the last refinement of a robot that follows no goals [s]."""
_EDGES_S = (0.3, 0.2)
"""Unused time at the beginning and at the end of a log whose initial states are estimated [s]."""


def spans(episodes: Sequence[Episode], fitted: int, config: IdentifyConfig, length_s: float) -> list[Span]:
    """Return segments of one length, fitted and held out.

    Args:
        episodes: The logs; those that are held out whole come last.
        length_s: Length of a segment [s].

    Raises:
        UsageError: When the logs are too short.
    """
    segments: list[Span] = []
    for r, episode in enumerate(episodes):
        begin, end = reach(episode, config)
        split = split_of(episode, r < fitted, config)
        last = end - length_s + 1e-6
        step_s = config.spacing_s or length_s
        segments += [Span(r, float(b)) for b in np.arange(begin, min(split - length_s, last) + 1e-6, step_s)]
        segments += [Span(r, float(b), False) for b in np.arange(split, last, _WINDOW_SPACING_S)]
    fit_count = sum(s.fitted for s in segments)
    if not fit_count or fit_count == len(segments) or (config.initial_state == "free" and fit_count < 3):
        lengths = ", ".join(f"{e.duration_s:.1f} s" for e in episodes)
        raise UsageError(
            f"the logs last {lengths}: that makes {fit_count} segments of {length_s:g} s to fit and "
            f"{len(segments) - fit_count} to hold out",
            hint="record for at least 12 s, or shorten --settle-s and --horizon-s",
        )
    return segments


def with_length(config: IdentifyConfig, model: IdentifiableModel) -> IdentifyConfig:
    """Return the configuration with the length of the segments of the last refinement."""
    follows_goals = any(channel.goal for channel in model.channels)
    return replace(config, long_s=0.0 if follows_goals else _LONG_S) if config.long_s is None else config


def long_spans(episodes: Sequence[Episode], fitted: int, config: IdentifyConfig) -> list[Span]:
    """Return the segments of the last refinement, which together contain all fitted samples; none if no log has two.

    Args:
        fitted: Number of fitted logs; the later ones are held out whole.
    """
    ends = [(reach(e, config)[0], split_of(e, True, config)) for e in episodes[:fitted]]
    return covering(ends, config.long_s or 0.0)


def covering(ends: Sequence[tuple[float, float]], length_s: float) -> list[Span]:
    """Return segments of a length that contain all samples between begin and end [s] of each recording."""
    segments: list[Span] = []
    for r, (begin, end) in enumerate(ends if length_s else ()):
        # The last segment ends at the end; the others are spread evenly, and may overlap.
        if (count := math.ceil((end - begin) / length_s - 1e-6)) > 1:
            after = np.linspace(0.0, end - length_s - begin, count)
            after[:-1] = on_grid(after[:-1], np.ceil)
            segments += [Span(r, float(begin + a)) for a in after]
    return segments


def reach(episode: Episode, config: IdentifyConfig) -> tuple[float, float]:
    """Return the begin and the end of the part of a log that can be cut into segments [s].

    An estimate of an initial state needs samples before and after the start of the segment. The end is 0.05 to
    0.15 s early, at a multiple of the grid: logs of 19.96 s and 20.04 s have the same segments and share programs.
    """
    before, after = _EDGES_S if config.initial_state == "free" else (0.0, 0.0)
    begin = max(before, config.after_s)
    return begin, begin + float(on_grid(episode.duration_s - after - begin - GRID_S / 2, np.floor))


def split_of(episode: Episode, fitted: bool, config: IdentifyConfig) -> float:
    """Return the begin of the held-out part of a log [s].

    Args:
        fitted: Whether the log is fitted; else it is held out whole.
    """
    begin, end = reach(episode, config)
    return begin + float(on_grid((1.0 - config.held_out) * (end - begin), np.floor)) if fitted else begin
