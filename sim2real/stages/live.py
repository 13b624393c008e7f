"""A live viewer for ``--view``: a separate process shows the files that a stage writes.

The process runs at low priority. It shares no lock, no queue and no memory with the stage, so it can slow a control
loop down only by the processor time that it takes.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.artifacts.paths import shown
from sim2real.errors import Sim2RealError
from sim2real.robots.robot import RecordedRobot, Robot, joint_columns
from sim2real.stages.terminal.console import note
from sim2real.types import Json
from sim2real.view.model_scene import ModelScene
from sim2real.view.rerun_viewer import open_viewer, rerun_module

if TYPE_CHECKING:
    from sim2real.view.rerun_recording import Scene

_START_S = 30.0
"""Longest wait for the viewer, before torque goes on [s]."""
_END_S, _LEAVE_S = 5.0, 1.0
"""Longest waits after the stage: for the last rows, and for the end of the process [s]."""
_NICENESS = 10
_READY, _WHOLE = "view:", "all rows are sent"
"""First and last line that the process prints, if nothing goes wrong."""


def scene_of(robot: RecordedRobot) -> dict[str, Json]:
    """Return the data with which another process draws a robot; empty if the robot has no model."""
    if not isinstance(robot, Robot):
        return {}
    columns = {name: fields["position"] for name, fields in joint_columns(robot.drive.channels).items()}
    if (exported := robot.exported(robot.nominal())) is not None:
        return {"mjcf": exported.mjcf, "columns": columns}
    file = getattr(robot, "mjcf", None)  # a walking robot, whose model is not exported
    return {"mjcf": str(file) if file else None, "columns": columns}


def drawn(scene: Mapping[str, Json]) -> Scene | None:
    """Return the scene that ``scene_of`` describes; None without one."""
    return ModelScene(scene["mjcf"], scene["columns"]) if scene.get("mjcf") else None


# -- the stage's side


@contextmanager
def live_view(target: str | None, folder: Path, name: str, scene: Callable[[], Mapping[str, Json]]) -> Iterator[None]:
    """Show the files of a folder in a viewer while the block runs.

    A viewer that does not start, or ends early, is a warning: the stage runs on.

    Args:
        target: Value of the flag ``--view``; None: no viewer.
        name: Name of the application, under which the viewer stores the arrangement of its panels.
        scene: Returns the robot to draw in 3-D, see ``scene_of``.
    """
    if target is None:
        yield
        return
    is_file = target.endswith(".rrd") and "://" not in target
    where = str(Path(target).absolute()) if is_file else target
    order = {"target": where, "folder": str(Path(folder).absolute()), "name": name, **scene()}
    # In a new session: Ctrl-C must end only the stage, because the viewer still shows the last rows.
    process = subprocess.Popen(
        [sys.executable, "-m", "sim2real.stages.live"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu", "RUST_LOG": "off"},
    )
    with suppress(OSError):
        print(json.dumps(order), file=process.stdin, flush=True)
    # Wait until the viewer is open: it must not take the processor while torque is on.
    ready = _line(process, _START_S)
    note(ready or "warning: no live view: its process does not answer", urgent=True)
    try:
        yield
    finally:
        if process.stdin is not None:
            with suppress(OSError):
                process.stdin.close()  # the process then sends the last rows, and ends
        last = _line(process, _END_S)
        if ready.startswith(_READY) and last != _WHOLE:
            note(last or "warning: the live view is not whole: its process ended early; the stage and its files are")
        with suppress(subprocess.TimeoutExpired):
            process.wait(_LEAVE_S)
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()


def _line(process: subprocess.Popen[str], wait_s: float) -> str:
    """Return the next line of the process; "" if none comes in time."""
    out = process.stdout
    return out.readline().strip() if out is not None and select.select([out], [], [], wait_s)[0] else ""


# -- the process, which feeds the viewer until its standard input closes


def main() -> None:
    """Show the folder that the first line of the standard input names, while it grows."""
    from sim2real.view.live import PERIOD_S, Follower  # needs matplotlib, which a robot's computer lacks

    # The viewer inherits the priority: every other program comes first. Only Linux has the second one.
    with suppress(OSError):
        os.nice(_NICENESS)
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    order = json.loads(sys.stdin.readline())
    try:
        recording = rerun_module().RecordingStream(f"sim2real {order['name']}")
        print(f"{_READY} {open_viewer(recording, order['target'])}", flush=True)
        follower = Follower(recording, lambda: [Path(order["folder"])], drawn(order))
        while not select.select([sys.stdin], [], [], PERIOD_S)[0]:
            follower.poll()
        follower.poll()
        dropped = follower.close()
        print(f"warning: the viewer did not take {dropped} updates" if dropped else _WHOLE, flush=True)
    except Sim2RealError as error:
        print(f"warning: no live view: {error.args[0]}{f'; hint: {error.hint}' if error.hint else ''}", flush=True)


# -- viewers that a command keeps open


def follow(run_dir: Path, name: str, target: str, scene: Scene | None) -> None:
    """Show the stages of a run while they write, from their beginning, until Ctrl-C.

    Args:
        target: See ``open_viewer``.

    Raises:
        Sim2RealError: The viewer does not start.
    """
    from sim2real.view.live import PERIOD_S, Follower

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


if __name__ == "__main__":
    main()
