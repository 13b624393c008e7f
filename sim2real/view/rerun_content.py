"""The content of a Rerun recording, independent of Rerun: one tab for each episode, with curves and a scene."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import StageFolder
from sim2real.graph.episode import TICKS_PER_S
from sim2real.log.schema import unit_of
from sim2real.log.session import is_imported
from sim2real.view.signals import Series, Signals, signals_of, simulated_beside

LATENESS = "Lateness [ms]"
_MOST_PLOTS = 28
"""Largest number of plots: more cannot be read, and a quadruped's log has 91."""


@dataclass(frozen=True)
class Curve:
    """One line of a plot.

    Attributes:
        entity: Path of the curve in the recording.
        label: Name in the legend.
        look: Style: ``measured``, ``identified``, ``truth``, ``command``; empty: Rerun's default.
        t_s: Times ``(N,)`` [s].
        values: Values ``(N,)``.
    """

    entity: str
    label: str
    look: str
    t_s: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class SceneMotion:
    """A motion of the robot in the 3-D view: a column ``(N,)`` for each field; a ghost is a model's prediction."""

    entity: str
    t_s: np.ndarray
    columns: Mapping[str, np.ndarray]
    ghost: bool


@dataclass(frozen=True)
class Tab:
    """One episode.

    Attributes:
        entity: Prefix of all its entities.
        plots: Title -> curves, from top to bottom.
        motions: Motions in the 3-D view.
        recent_s: Time before the cursor that the plots of a live view show [s]; None: the tab is not live.
    """

    title: str
    entity: str
    plots: Mapping[str, list[Curve]]
    motions: list[SceneMotion]
    recent_s: float | None = None


def tabs_of(artifacts: Mapping[str, StageFolder]) -> list[Tab]:
    """Return the tabs of a run's finished stages.

    Raises:
        Sim2RealError: When a file of the stage is missing or malformed.
    """
    tabs = []
    if "record" in artifacts:
        log = signals_of(Recording.load(artifacts["record"].folder))
        tabs.append(episode_tab(_dry("Record", log), "record", log, []))
    if "deploy" in artifacts:
        deployed = Deployment.load(artifacts["deploy"].folder)
        for i, (recording, simulated) in enumerate(zip(deployed.recordings, deployed.simulated, strict=True)):
            log = signals_of(recording)
            beside = simulated_beside(simulated, log)
            tabs.append(episode_tab(_dry(f"Deploy {i}", log), f"deploy/{i}", log, beside))
    return [tab for tab in tabs if tab.plots]


def _dry(title: str, log: Signals) -> str:
    return f"{title} (dry run)" if log.dry else title


def episode_tab(title: str, entity: str, log: Signals, simulated: list[Series]) -> Tab:
    """Return the tab of a log: measured, true and simulated states, commands of nodes, and lateness."""
    plots: dict[str, list[Curve]] = {}
    models = {s.name: s for s in simulated}
    for series in log.measured:
        curves = [_curve(f"{entity}/{series.source}", series, "measured", f"measured by {series.source}")]
        if series.name in log.truth:
            curves.append(_curve(f"{entity}/truth", log.truth[series.name], "truth", "true state"))
        if series.name in models:
            curves.append(_curve(f"{entity}/simulation", models[series.name], "identified", "simulation"))
        plots[_titled(series.name, log.units)] = curves
    last = log.last_command()
    commands = [n for n in models if n.partition("[")[0] == "command"]
    for index, series in enumerate(last):
        curves = [_curve(f"{entity}/{series.source}", series, "command", f"sent by {series.source}")]
        if index < len(commands):
            curves.append(_curve(f"{entity}/simulation", models[commands[index]], "identified", "simulation"))
        plots.setdefault(_titled(series.name, log.units), []).extend(curves)
    # Put the motors' commands last, so that they replace fields of the same name of other nodes.
    motions = [_motion(f"{entity}/scene/robot", log.measured, [*log.commanded, *last], ghost=False)]
    if simulated:
        states = [s for s in simulated if s.name not in commands]
        motions.append(_motion(f"{entity}/scene/simulation", states, [], ghost=True))
    if not is_imported(log.episode):
        steps = log.episode.steps.items()
        plots[LATENESS] = [
            Curve(f"{entity}/lateness/{n}", n, "", every.woken / TICKS_PER_S, (every.woken - every.start) / 1e3)
            for n, every in steps
            if len(every)
        ]
    return Tab(title, entity, plots, motions)


def with_goals(plots: Mapping[str, list[Curve]]) -> dict[str, list[Curve]]:
    """Return the plots with each joint's goal (``q`` for legs) in the plot of its position."""
    merged = dict(plots)
    for title in plots:
        position = re.sub(r"^(goal|q)(?=\[| |$)", "position", title)
        if position != title and position in plots:
            merged[position] = [*plots[position], *merged.pop(title)]
    return merged


def readable(plots: Mapping[str, list[Curve]]) -> dict[str, list[Curve]]:
    """Return the plots to show; if they are too many, goals join positions, and constant plots are omitted."""
    if len(plots) <= _MOST_PLOTS:
        return dict(plots)
    moving = {t: c for t, c in with_goals(plots).items() if any(len(x.values) and np.ptp(x.values) for x in c)}
    return moving or dict(plots)


def _curve(folder: str, series: Series, look: str, label: str) -> Curve:
    return Curve(f"{folder}/{series.name}", label, look, series.t_s, series.values)


def _motion(entity: str, states: list[Series], commands: list[Series], ghost: bool) -> SceneMotion:
    """Return one motion at the times of the first state; other columns hold their last value."""
    t_s = states[0].t_s if states else np.empty(0)
    columns = {}
    for series in [*commands, *states]:
        last = np.searchsorted(series.t_s, t_s, side="right") - 1
        columns[series.name] = series.values[np.maximum(last, 0)]
    return SceneMotion(entity, t_s, columns, ghost)


def _titled(name: str, units: Mapping[str, str]) -> str:
    unit = unit_of(name, units)
    return f"{name} [{unit}]" if unit else name
