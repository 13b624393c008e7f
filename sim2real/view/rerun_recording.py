"""A run as a Rerun recording: signals, schedule and a 3-D scene on one timeline.

The data is sent after the run, so that no control loop waits for a viewer, and by columns, which is 17 times faster.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.run import finished_stages, pipeline_of
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import TICKS_PER_S, Episode
from sim2real.view.rerun_content import IDLE, Curve, Tab, readable, states_of, tabs_of
from sim2real.view.rerun_viewer import open_viewer, rerun_module
from sim2real.view.timing import color_of, in_order, slowest_period_s

TIMELINE = "time"
"""The only timeline, so that the viewer has no choice of another one."""

Scene = Callable[[Any, np.ndarray, Mapping[str, np.ndarray], str, bool], None]
"""Draws a robot: ``log_scene(recording, t_s, columns, entity, ghost)``.

``recording`` is a ``rerun.RecordingStream``, ``t_s`` ``(N,)`` [s], ``columns`` the fields ``(N,)`` by name. Parts
that do not move are logged as static below ``entity``, moving parts by columns on the timeline ``time``. A ghost is a
model's prediction, drawn so that it can overlap the robot.
"""

# Readable on the viewer's dark background and on its light one; measured, identified, ... as on the page.
_COLORS = {
    "measured": (150, 162, 176), "identified": (66, 150, 230), "truth": (36, 176, 118),
    "command": (190, 112, 192),
}  # fmt: skip
_WIDTHS = {"measured": 2.0, "identified": 1.6, "truth": 1.2, "command": 1.6}
_STATES = {"waiting": (110, 120, 132), "late": (226, 138, 48), "computing": (66, 150, 230)}
_ROWS = 7
"""Largest number of plots below each other."""
_PERIODS = 1.5
"""Visible part of the schedule on either side of the time cursor [periods of the slowest node]."""


def view(
    run_dir: Path, save: Path | None = None, scene: Scene | None = None, serve: Callable[[str], None] | None = None
) -> None:
    """Open a run in the Rerun viewer, or save it as a recording, or serve it on a page for browsers.

    Args:
        save: Write this file (``.rrd``) instead of opening the viewer.
        scene: Draws the robot in 3-D; None: no 3-D view.
        serve: Called with the address of the page, which is served until it returns; None: a window.

    Raises:
        Sim2RealError: When Rerun is not installed, no recording or deployment is finished, or what a stage wrote is
            malformed.
    """
    rr = rerun_module()
    tabs = tabs_of(finished_stages(run_dir))  # before a viewer opens
    if not tabs:
        raise Sim2RealError(f"{run_dir} has no recording and no deployment to show", hint="its page has the rest")
    name = f"{pipeline_of(run_dir)} {Path(run_dir).resolve().name}"
    # Use one application for each run, as the viewer stores one arrangement per application.
    recording = rr.RecordingStream(f"sim2real {name}")
    line = open_viewer(recording, str(save) if save else "web" if serve else "window")
    build(recording, tabs, name, scene)
    if serve:
        serve(line)
    recording.disconnect()


def build(recording: Any, tabs: Sequence[Tab], name: str, scene: Scene | None = None) -> None:
    """Send the content of a run and its arrangement to a recording.

    Args:
        recording: A ``rerun.RecordingStream``.
        tabs: The content, see ``content.tabs_of``.
        scene: Draws the robot in 3-D; None: no 3-D view.
    """
    recording.send_recording_name(name)
    for tab in tabs:
        for curve in (c for curves in tab.plots.values() for c in curves):
            send_curve(recording, curve)
        if tab.episode is not None:
            _send_timing(recording, tab.entity, tab.episode)
        for motion in tab.motions if scene else ():
            if scene and len(motion.t_s):
                scene(recording, motion.t_s, motion.columns, motion.entity, motion.ghost)
    recording.send_blueprint(blueprint_of(tabs, scene is not None))
    recording.flush()


def send_curve(recording: Any, curve: Curve) -> None:
    """Send a curve and its style."""
    send_style(recording, curve)
    send_values(recording, curve, time_column(curve.t_s))


def send_style(recording: Any, curve: Curve) -> None:
    """Send the style of a curve, which Rerun needs once."""
    looks = rerun_module().SeriesLines(
        names=curve.label, colors=_COLORS.get(curve.look), widths=_WIDTHS.get(curve.look, 1.4)
    )
    recording.log(curve.entity, looks, static=True)


def send_values(recording: Any, curve: Curve, time: Any) -> None:
    """Send the values of a curve.

    Args:
        time: Its times, see ``time_column``.
    """
    recording.send_columns(curve.entity, [time], rerun_module().Scalars.columns(scalars=curve.values))


def _send_timing(recording: Any, folder: str, episode: Episode) -> None:
    """Send each node's states as lanes, and its lateness as a curve; the page has the ages of inputs in a table."""
    rr = rerun_module()
    for node in in_order(episode):
        steps = episode.steps[node]
        if not len(steps):
            continue
        lane = f"{folder}/schedule/{node}"
        # Send an invisible idle state: the viewer accepts null, but Rerun's `rrd verify` rejects it.
        color = _own_color(episode, node)
        looks = {**_STATES, **({"computing": color} if color else {})}
        named = rr.StateConfiguration(
            values=[*_STATES, IDLE],
            labels=[*_STATES, IDLE],
            colors=[*looks.values(), (0, 0, 0)],
            visible=[*(True for _ in _STATES), False],
        )
        recording.log(lane, named, static=True)
        times, states = states_of(steps)
        recording.send_columns(lane, [time_column(times)], rr.StateChange.columns(state=states))
        lateness = f"{folder}/lateness/{node}"
        recording.log(lateness, rr.SeriesLines(names=node, widths=1.2, colors=color), static=True)
        late_ms = (steps.woken - steps.start) / 1e3
        times = time_column(steps.woken / TICKS_PER_S)
        recording.send_columns(lateness, [times], rr.Scalars.columns(scalars=late_ms))


def _own_color(episode: Episode, node: str) -> tuple[int, int, int] | None:
    """Return a node's configured colour, if any."""
    color = color_of(episode, node, "")
    return (int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)) if color else None


def blueprint_of(tabs: Sequence[Tab], with_scene: bool) -> Any:
    """Return the arrangement of the tabs; of live ones the newest is open."""
    import rerun.blueprint as rrb

    # The time cursor stays at the newest data of a live view, which opens its newest tab.
    live = tabs[-1].recent_s is not None
    panels = [
        rrb.TopPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, playback_speed=1.0, play_state="following" if live else None
        ),
    ]
    pages = [_page(tab, with_scene) for tab in tabs]
    newest = len(pages) - 1 if live else 0
    return rrb.Blueprint(rrb.Tabs(*pages, active_tab=newest) if len(pages) > 1 else pages[0], *panels)


def _page(tab: Tab, with_scene: bool) -> Any:
    """Return a tab's arrangement: plots on the left; scene, schedule and lateness on the right."""
    import rerun.blueprint as rrb

    legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop)
    if tab.recent_s is None:
        # The timeline is as long as the longest episode; each tab shows its own.
        last = max(float(c.t_s[-1]) for curves in tab.plots.values() for c in curves if len(c.t_s))
        begin, end = (rrb.TimeRangeBoundary.absolute(seconds=t_s) for t_s in (0.0, last))
    elif math.isinf(tab.recent_s):
        begin, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite()
    else:
        begin, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=t_s) for t_s in (-tab.recent_s, 0.0))
    whole = rrb.TimeAxis(view_range=rrb.TimeRange(start=begin, end=end))
    plots = [
        rrb.TimeSeriesView(name=title, contents=[c.entity for c in curves], plot_legend=legend, axis_x=whole)
        for title, curves in readable(tab.plots).items()
    ]
    side: list[Any] = []
    if with_scene and tab.motions:
        side.append(rrb.Spatial3DView(name="Robot", origin=f"/{tab.entity}/scene"))
    if tab.episode is not None:
        around_s = _PERIODS * slowest_period_s(tab.episode)
        near = rrb.TimeRange(
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-around_s),
            end=rrb.TimeRangeBoundary.cursor_relative(seconds=around_s),
        )
        side += [
            rrb.StateTimelineView(
                name="Schedule", origin=f"/{tab.entity}/schedule", time_view=rrb.TimeAxis(view_range=near)
            ),
            rrb.TimeSeriesView(
                name="Lateness [ms]", origin=f"/{tab.entity}/lateness", plot_legend=legend, axis_x=whole
            ),
        ]
    # Many plots, such as those of several joints, stand in columns.
    columns = -(-len(plots) // _ROWS)
    left = (
        rrb.Grid(*plots, grid_columns=columns, name=tab.title) if columns > 1 else rrb.Vertical(*plots, name=tab.title)
    )
    if not side:
        return left
    shares = [3, *([2, 2] if len(side) > 1 else [])][-len(side) :] if with_scene else None
    return rrb.Horizontal(left, rrb.Vertical(*side, row_shares=shares), column_shares=[3, 2], name=tab.title)


def time_column(t_s: np.ndarray) -> Any:
    """Return times ``(N,)`` [s] on the only timeline."""
    return rerun_module().TimeColumn(TIMELINE, duration=t_s)
