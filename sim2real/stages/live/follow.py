"""``view RUN --follow``: joins a run whose stages are still running."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

from sim2real.stages.live.viewer_process import PERIOD_S
from sim2real.stages.terminal.console import note, shown
from sim2real.view.live.follower import Follower
from sim2real.view.rerun_recording import Scene
from sim2real.view.rerun_viewer import open_viewer, rerun_module


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
