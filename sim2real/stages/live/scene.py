"""The robot in 3-D in a viewer, and viewers that a command keeps open."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.stages.terminal.console import note, shown
from sim2real.types import Json
from sim2real.view.live.follower import PERIOD_S, Follower
from sim2real.view.model_scene import ModelScene
from sim2real.view.rerun_recording import Scene
from sim2real.view.rerun_viewer import open_viewer, rerun_module


def scene_of(robot: RecordedRobot) -> dict[str, Json]:
    """Return what another process needs to draw a robot; empty if the robot has no model."""
    if not isinstance(robot, Robot):
        return {}
    columns = {name: fields["position"] for name, fields in robot.sensor.joints.items() if "position" in fields}
    file = getattr(robot, "mjcf", None)  # of a walking robot, which has no model for others
    return {"mjcf": robot.identified_mjcf(robot.nominal()) or (str(file) if file else None), "columns": columns}


def drawn(scene: Mapping[str, Json]) -> Scene | None:
    """Return the scene that ``scene_of`` describes; None without one."""
    return ModelScene(scene["mjcf"], scene["columns"]) if scene.get("mjcf") else None


def follow(run_dir: Path, name: str, target: str, scene: Scene | None) -> None:
    """Show the stages of a run while they write, from their beginning, until Ctrl-C.

    Args:
        target: See ``open_viewer``.

    Raises:
        Sim2RealError: The viewer does not start.
    """
    recording = rerun_module().RecordingStream(f"sim2real {name}")
    note(f"view: {open_viewer(recording, target)}")
    follower = Follower(recording, lambda: sorted(p for p in run_dir.iterdir() if p.is_dir()), scene)
    note(f"following {shown(run_dir)}; Ctrl-C ends the view, not the run")
    with suppress(KeyboardInterrupt):
        while True:
            follower.poll()
            time.sleep(PERIOD_S)
    follower.close()


def serve(line: str) -> None:
    """Print the address of a page, and wait for Ctrl-C."""
    note(f"view: {line}; Ctrl-C ends it")
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(1.0)
