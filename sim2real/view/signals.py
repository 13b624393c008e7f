"""Time series out of an episode: what was measured, what was commanded, and what was true."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, Steps
from sim2real.hardware.truth import read_truth
from sim2real.log import TruncatedLogWarning, read_log


@dataclass(frozen=True)
class Series:
    """One quantity over time.

    Attributes:
        name: Name of the field, with its index where the field has several entries.
        source: Who says so: a node, or a model.
        t_s: Times ``(N,)`` [s].
        values: Values ``(N,)``.
    """

    name: str
    source: str
    t_s: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Recording:
    """A log, made ready for plotting.

    Attributes:
        episode: The log.
        measured: Outputs of nodes that read nothing of the graph, at the time of the sample.
        commanded: Outputs of the other nodes, at the time of sending.
        truth: True states by name, where an embedded robot told them.
        units: Field -> unit, where the session names them.
        warnings: What the log lacks.
    """

    episode: Episode
    measured: list[Series]
    commanded: list[Series]
    truth: dict[str, Series]
    units: Mapping[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @property
    def dry(self) -> bool:
        """Whether nothing was moved: what was commanded was not sent."""
        return is_dry(self.episode)

    def last_command(self) -> list[Series]:
        """Return the outputs of the nodes that no other node reads: what reaches the motors."""
        graph = self.episode.metadata.get("graph", {})
        read = {i.get("from") for node in graph.values() for i in node.get("inputs", {}).values()}
        last = [s for s in self.commanded if s.source not in read]
        return last or self.commanded


def is_dry(episode: Episode) -> bool:
    """Return whether a log is of a dry run."""
    return episode.metadata.get("dry_run") is True


def read_recording(log: Path, truth: Path | None = None) -> Recording:
    """Read a log and, if there is one, the embedded robot's account of the truth.

    Raises:
        Sim2RealError: When the log cannot be read, or holds no step.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TruncatedLogWarning)
        episode = read_log(log)
    if not episode.duration_s:
        raise Sim2RealError(f"the log {log} holds no step", hint="record for longer")
    graph = episode.metadata.get("graph", {})
    measured, commanded = [], []
    for node, steps in episode.steps.items():
        inputs = graph.get(node, {}).get("inputs", {}) or [k for k in episode.messages if k[0] == node]
        outputs = episode.outputs.get(node, {})
        if inputs:
            commanded += _node_series(node, steps.end / 1e6, outputs)
        else:
            measured += _node_series(node, sample_times_s(steps), outputs)
    return Recording(
        episode,
        measured,
        commanded,
        _true_states(episode, truth),
        units=episode.metadata.get("units", {}),
        warnings=[str(w.message) for w in caught if issubclass(w.category, TruncatedLogWarning)],
    )


def sample_times_s(steps: Steps) -> np.ndarray:
    """Return when each step's sample was taken ``(N,)`` [s]: the time that the step set itself, else its start."""
    return np.where(steps.ts_overwrite >= 0, steps.ts_overwrite, steps.start) / 1e6


def components(name: str, source: str, t_s: np.ndarray, values: np.ndarray) -> list[Series]:
    """Return one series for each entry of a field with shape ``(N, ...)``; none for what is no number."""
    values = np.asarray(values)
    if values.dtype.kind not in "fiub" or not values.size:
        return []
    flat = values.reshape(len(values), -1).astype(np.float64)
    if flat.shape[1] == 1:
        return [Series(name, source, t_s, flat[:, 0])]
    return [Series(f"{name}[{i}]", source, t_s, flat[:, i]) for i in range(flat.shape[1])]


def unit_of(name: str, units: Mapping[str, str]) -> str:
    """Return the unit of a series by the name of its field, or an empty string."""
    return units.get(name, units.get(name.partition("[")[0], ""))


def _node_series(node: str, times_s: np.ndarray, outputs: Mapping[str, np.ndarray]) -> list[Series]:
    return [s for name, values in outputs.items() for s in components(name, node, times_s, values)]


def _true_states(episode: Episode, path: Path | None) -> dict[str, Series]:
    end: Mapping[str, Any] = episode.metadata.get("log", {}).get("session_end") or {}
    if path is None or "monotonic_ns" not in end:
        return {}
    t_ns, states = read_truth(path).states()
    t_s = (t_ns - end["monotonic_ns"]) / 1e9
    # The embedded robot runs before the episode starts and after it ends.
    inside = (t_s >= 0) & (t_s <= episode.duration_s)
    return {name: Series(name, "truth", t_s[inside], values[inside]) for name, values in states.items()}
