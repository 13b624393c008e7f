"""The files of a training and of a search as a live view shows them: curves, and the best fit so far."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sim2real.view.rerun_content import Curve, Tab, interrupted


class ProgressSource:
    """The new points of a stage's curves, as a tab with a plot for each name.

    Args:
        path: The file, see ``artifacts.progress``.
        entity: Prefix of its entities.
        offset_s: Returns the place of a wall clock's time [ns] on the live view's timeline [s].
    """

    def __init__(self, path: Path, entity: str, offset_s: Callable[[int], float]) -> None:
        self._path, self._entity, self._offset_s, self._read = path, entity, offset_s, 0

    def read(self) -> Tab | None:
        """Return a tab with the points since the last call; None if there are none."""
        # Take whole lines; the last one may still be growing.
        with open(self._path, "rb") as stream:
            stream.seek(self._read)
            data = stream.read()
        data = data[: data.rfind(b"\n") + 1]
        self._read += len(data)
        points = [json.loads(line) for line in data.splitlines()]
        if not points:
            return None
        plots: dict[str, list[Curve]] = {}
        for name, first in points[0]["values"].items():
            some = [p for p in points if name in p["values"]]
            t_s = np.array([self._offset_s(p["epoch_ns"]) for p in some])
            for seed in range(len(first)):
                label = name if len(first) == 1 else f"seed {seed}"
                values = np.array([p["values"][name][seed] for p in some], np.float64)
                plots.setdefault(name, []).append(Curve(f"{self._entity}/{name}/{seed}", label, "", t_s, values))
        return Tab(self._entity, self._entity, plots, [], recent_s=math.inf)


class FitSource:
    """The best fit so far beside the measurements; each one replaces the one before.

    Args:
        path: The file, see ``artifacts.progress``.
        entity: Prefix of its entities.
    """

    def __init__(self, path: Path, entity: str) -> None:
        self._path, self._entity, self._written_ns, self._count = path, entity, 0, 0

    def read(self) -> Tab | None:
        """Return a tab with the best fit; None if it is the one of the last call."""
        if (written_ns := self._path.stat().st_mtime_ns) == self._written_ns:
            return None
        with np.load(self._path) as file:
            columns = dict(file)
        self._written_ns, self._count = written_ns, self._count + 1
        plots = {}
        for recording in np.unique(columns["recording"]):
            chosen = columns["recording"] == recording
            t_s, segment = columns["t"][chosen], columns["segment"][chosen]
            order = np.argsort(t_s, kind="stable")
            for field in (name.removesuffix("_measured") for name in columns if name.endswith("_measured")):
                curves = []
                for model, folder in (("measured", "measured"), ("identified", f"fit_{self._count}")):
                    values = columns[f"{field}_{model}"][chosen].astype(np.float64)[order]
                    label = "best fit so far" if model == "identified" else model
                    entity = f"{self._entity}/{recording}/{folder}/{field}"
                    curves.append(Curve(entity, label, model, *interrupted(t_s[order], values, segment[order])))
                plots[field if recording == 0 else f"{field} of recording {recording}"] = curves
        return Tab(self._entity, self._entity, plots, [], recent_s=math.inf)
