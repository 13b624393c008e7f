"""A live view: follows the growing logs of stages, and sends new rows to a Rerun recording.

It sends at most 50 rows per second of a log: of each group of steps, the one with the largest lateness.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.graph.episode import TICKS_PER_S, Episode, Steps
from sim2real.log.reader import LogTail
from sim2real.view.rerun_content import LATENESS, Curve, Tab, episode_tab, with_goals
from sim2real.view.rerun_recording import Scene, blueprint_of, send_style, send_values, time_column
from sim2real.view.signals import outputs_of

PERIOD_S = 0.2
"""Time between two reads: two flushes of a log's writer [s]."""
ROWS_PER_S = 50.0
"""Largest number of rows that a viewer gets for each node [1/s]."""
RECENT_S = 10.0
"""Time before the newest data that the plots show [s]."""
_PATIENCE_S = 0.5
"""The viewer is behind if it does not take the rows of one round within this time [s]; then rows are dropped."""


class Follower:
    """Sends the logs of stages to a viewer as they grow.

    While a viewer does not take the last rows, no further rows are sent, so that the memory of this process stays
    small.

    Args:
        recording: A ``rerun.RecordingStream`` with a viewer.
        folders: Returns the folders of the stages to follow.
        scene: Draws the robot in 3-D; None: no 3-D view.
    """

    def __init__(self, recording: Any, folders: Callable[[], list[Path]], scene: Scene | None) -> None:
        self._recording, self._folders, self._scene = recording, folders, scene
        self._once = _StaticOnce(recording)
        self._sources: dict[Path, LogSource] = {}
        self._tabs: dict[Path, Tab] = {}
        self._curves: dict[Path, set[str]] = {}
        self._styled: set[str] = set()
        self._first_ns: int | None = None
        self._dropped = 0

    def poll(self) -> None:
        """Send the rows that are new since the last call."""
        taken = self._flushed()
        for path in (p for folder in self._folders() for p in sorted(folder.iterdir())):
            if path not in self._sources and path.suffix == ".mcap":
                self._sources[path] = LogSource(path, f"{path.parent.name}/{path.stem}", self._offset_s)
        for path, source in self._sources.items():
            with suppress(OSError):
                if (tab := source.read()) is not None:
                    if taken:
                        self._send(path, tab)
                    self._dropped += not taken

    def close(self) -> int:
        """Wait for the viewer a last time; return the number of updates that it did not get."""
        return self._dropped + (not self._flushed())

    def _send(self, path: Path, tab: Tab) -> None:
        # Arrange the viewer again if a tab has new curves.
        curves = {c.entity for plot in tab.plots.values() for c in plot}
        if not curves <= self._curves.get(path, set()):
            self._curves[path], self._tabs[path] = curves, tab
            self._recording.send_blueprint(blueprint_of(list(self._tabs.values()), self._scene is not None))
        # Curves of a node share their times. A column of times, or a style, takes longer to make than to send.
        columns: dict[int, Any] = {}
        for curve in (c for curves in tab.plots.values() for c in curves):
            if curve.entity not in self._styled:
                self._styled.add(curve.entity)
                send_style(self._recording, curve)
            if id(curve.t_s) not in columns:
                columns[id(curve.t_s)] = time_column(curve.t_s)
            send_values(self._recording, curve, columns[id(curve.t_s)])
        for motion in tab.motions if self._scene else ():
            if self._scene and len(motion.t_s):
                self._scene(self._once, motion.t_s, motion.columns, motion.entity, motion.ghost)

    def _flushed(self) -> bool:
        """Return whether the viewer has taken all rows."""
        try:
            self._recording.flush(timeout_sec=_PATIENCE_S)
        except (RuntimeError, ValueError, OSError):
            return False
        return True

    def _offset_s(self, epoch_ns: int) -> float:
        """Return the time from the begin of the first log to the begin of this one [s]."""
        if self._first_ns is None:
            self._first_ns = epoch_ns
        return (epoch_ns - self._first_ns) / 1e9


class _StaticOnce:
    """Sends static data of an entity once, although shapes and styles are logged with each part of a motion."""

    def __init__(self, recording: Any) -> None:
        self._recording = recording
        self._logged: set[tuple[str, type]] = set()

    def log(self, entity: str, data: Any, static: bool = False) -> None:
        """Log data; static data only if the entity has none of this type yet."""
        key = (entity, type(data))
        if not (static and key in self._logged):
            self._recording.log(entity, data, static=static)
        self._logged.add(key)

    def send_columns(self, *arguments: Any) -> None:
        """Send columns."""
        self._recording.send_columns(*arguments)


class LogSource:
    """The new steps of a log, as a tab.

    Args:
        entity: Prefix of its entities.
        offset_s: Returns the begin of a log on the live view's timeline [s], given the wall clock at the log's time 0
            [ns].
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
        # The last plot shows the lateness of these steps.
        curves = [
            Curve(f"{self._entity}/lateness/{node}", node, "", steps.woken / TICKS_PER_S, lateness[node])
            for node, steps in thinned.steps.items()
        ]
        return _moved(
            replace(tab, plots={**with_goals(tab.plots), LATENESS: curves}, recent_s=RECENT_S),
            self._offset_s(self._tail.epoch_ns),
        )


def _thinned(episode: Episode) -> tuple[Episode, dict[str, np.ndarray]]:
    """Return an episode with the most late step of each group of steps, and the lateness of these steps [ms]."""
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
