"""A run as a Rerun recording: signals, lateness and a 3-D scene on one timeline.

The data is sent after the run, so that no control loop waits for a viewer, and by columns, which is 17 times faster.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.run import finished_stages, pipeline_of
from sim2real.errors import Sim2RealError
from sim2real.view.rerun_content import Curve, Tab, readable, tabs_of
from sim2real.view.rerun_viewer import open_viewer, rerun_module

TIMELINE = "time"
"""The only timeline, so that the viewer has no choice of another one."""

Scene = Callable[[Any, np.ndarray, Mapping[str, np.ndarray], str, bool], None]
"""Draws a robot: ``log_scene(recording, t_s, columns, entity, ghost)``.

``recording`` is a ``rerun.RecordingStream``, ``t_s`` ``(N,)`` [s], ``columns`` the fields ``(N,)`` by name. Parts
that do not move are logged as static below ``entity``, moving parts by columns on the timeline ``time``. A ghost is a
model's prediction, drawn so that it can overlap the robot.
"""

# Colours that are readable on the viewer's dark and light backgrounds, as on the page.
_COLORS = {
    "measured": (150, 162, 176), "identified": (66, 150, 230), "truth": (36, 176, 118),
    "command": (190, 112, 192),
}  # fmt: skip
_WIDTHS = {"measured": 2.0, "identified": 1.6, "truth": 1.2, "command": 1.6}
_ROWS = 7
"""Largest number of plots in a column."""


def view(
    run_dir: Path, save: Path | None = None, scene: Scene | None = None, serve: Callable[[str], None] | None = None
) -> None:
    """Open a run in the Rerun viewer, or save it as a recording, or serve it on a page for browsers.

    Args:
        save: Write this file (``.rrd``) instead of opening the viewer.
        scene: Draws the robot in 3-D; None: no 3-D view.
        serve: Called with the address of the page, which is served until it returns; None: a window.

    Raises:
        Sim2RealError: Rerun is not installed, no recording or deployment is finished, or a stage's file is malformed.
    """
    rr = rerun_module()
    tabs = tabs_of(finished_stages(run_dir))  # raises an error before a viewer opens
    if not tabs:
        raise Sim2RealError(f"{run_dir} has no recording and no deployment to show", hint="its page has the rest")
    name = f"{pipeline_of(run_dir)} {Path(run_dir).resolve().name}"
    # Use one application for each run: the viewer stores one arrangement per application.
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


def blueprint_of(tabs: Sequence[Tab], with_scene: bool) -> Any:
    """Return the arrangement of the tabs; of live tabs, the newest is open."""
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
    """Return a tab's arrangement: plots on the left, the scene on the right."""
    import rerun.blueprint as rrb

    legend = rrb.PlotLegend(corner=rrb.Corner2D.RightTop)
    if tab.recent_s is None:
        # The timeline is as long as the longest episode; each tab shows its own.
        last = max(float(c.t_s[-1]) for curves in tab.plots.values() for c in curves if len(c.t_s))
        begin, end = (rrb.TimeRangeBoundary.absolute(seconds=t_s) for t_s in (0.0, last))
    else:
        begin, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=t_s) for t_s in (-tab.recent_s, 0.0))
    whole = rrb.TimeAxis(view_range=rrb.TimeRange(start=begin, end=end))
    plots = [
        rrb.TimeSeriesView(name=title, contents=[c.entity for c in curves], plot_legend=legend, axis_x=whole)
        for title, curves in readable(tab.plots).items()
    ]
    # Arrange many plots, such as those of several joints, in columns.
    columns = -(-len(plots) // _ROWS)
    left = (
        rrb.Grid(*plots, grid_columns=columns, name=tab.title) if columns > 1 else rrb.Vertical(*plots, name=tab.title)
    )
    if not (with_scene and tab.motions):
        return left
    scene = rrb.Spatial3DView(name="Robot", origin=f"/{tab.entity}/scene")
    return rrb.Horizontal(left, scene, column_shares=[3, 2], name=tab.title)


def time_column(t_s: np.ndarray) -> Any:
    """Return times ``(N,)`` [s] on the only timeline."""
    return rerun_module().TimeColumn(TIMELINE, duration=t_s)
