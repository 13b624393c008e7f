"""A growing log as a live view shows it: at most 50 rows a second, and of each group of steps the latest one."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.graph.episode import TICKS_PER_S, Episode, Steps
from sim2real.log.reader import LogTail
from sim2real.view.rerun_content import Curve, Tab, episode_tab, with_goals
from sim2real.view.signals import outputs_of

ROWS_PER_S = 50.0
"""Largest number of rows that a viewer gets for each node [1/s]."""
RECENT_S = 10.0
"""Part before the newest data that the plots show [s]."""


class LogSource:
    """The new steps of a log, as a tab.

    Args:
        entity: Prefix of its entities.
        offset_s: Returns the begin of a log on the live view's timeline [s], from its wall clock at time 0 [ns].
    """

    def __init__(self, path: Path, entity: str, offset_s: Callable[[int], float]) -> None:
        self._tail, self._entity, self._offset_s = LogTail(path), entity, offset_s

    def read(self) -> Tab | None:
        """Return a tab with the rows since the last call; None if there are none."""
        episode = self._tail.read()
        if episode is None:
            return None
        thinned, lateness = _thinned(episode)
        tab = episode_tab(self._entity, self._entity, outputs_of(thinned), [])
        # The lateness of all steps goes into the last plot, and no schedule is drawn: it needs every step.
        curves = [
            Curve(f"{self._entity}/lateness/{node}", node, "", steps.woken / TICKS_PER_S, lateness[node])
            for node, steps in thinned.steps.items()
        ]
        return _moved(
            replace(tab, plots={**with_goals(tab.plots), "Lateness [ms]": curves}, episode=None, recent_s=RECENT_S),
            self._offset_s(self._tail.epoch_ns),
        )


def _thinned(episode: Episode) -> tuple[Episode, dict[str, np.ndarray]]:
    """Return an episode with the latest step of each group of steps, and the lateness of these steps [ms]."""
    steps, outputs, lateness = {}, {}, {}
    for node, every in episode.steps.items():
        rate_hz = float(episode.metadata.get("graph", {}).get(node, {}).get("rate_hz", ROWS_PER_S))
        size, late = max(1, math.ceil(rate_hz / ROWS_PER_S - 1e-6)), (every.woken - every.start) / 1e3
        rows = np.array([i + int(late[i : i + size].argmax()) for i in range(0, len(every), size)], np.int64)
        steps[node] = Steps(*(getattr(every, name)[rows] for name in Steps.__dataclass_fields__))
        outputs[node] = {name: values[rows] for name, values in episode.outputs.get(node, {}).items()}
        lateness[node] = late[rows]
    return replace(episode, steps=steps, outputs=outputs), lateness


def _moved(tab: Tab, offset_s: float) -> Tab:
    """Return a tab with all times moved; curves that share their times still do."""
    # Move each array of times once: the receiver makes one column of each.
    every = {id(c.t_s): c.t_s for curves in tab.plots.values() for c in curves}
    moved = {number: t_s + offset_s for number, t_s in every.items()}
    plots = {title: [replace(c, t_s=moved[id(c.t_s)]) for c in curves] for title, curves in tab.plots.items()}
    return replace(tab, plots=plots, motions=[replace(m, t_s=m.t_s + offset_s) for m in tab.motions])
