"""Starts the process of a live view beside a stage, and ends it after the stage."""

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from sim2real.stages.terminal.console import note
from sim2real.types import Json

_START_S = 30.0
"""Longest wait for the viewer, before torque goes on [s]."""
_END_S, _LEAVE_S = 5.0, 1.0
"""Longest waits for the last rows after the stage, and for the end of the process [s]."""


@contextmanager
def live_view(target: str | None, folder: Path, name: str, scene: Callable[[], Mapping[str, Json]]) -> Iterator[None]:
    """Show the files of a folder in a viewer while the block runs.

    A viewer that does not start, or ends early, is a warning: the stage runs on.

    Args:
        target: Value of the flag ``--view``; None: no viewer.
        name: Name of the application in the viewer, which keeps one arrangement for each.
        scene: Returns the robot to draw in 3-D, see ``live.scene``.
    """
    if target is None:
        yield
        return
    process = _started(target, folder, name, scene())
    try:
        yield
    finally:
        if process is not None:
            _end(process)


def _started(target: str, folder: Path, name: str, scene: Mapping[str, Json]) -> subprocess.Popen[str] | None:
    """Start the process, and wait until its viewer is open; None if it does not open."""
    is_file = target.endswith(".rrd") and "://" not in target
    order = {
        "target": str(Path(target).absolute()) if is_file else target,
        "folder": str(Path(folder).absolute()),
        "name": name,
        **scene,
    }
    # In a session of its own, as Ctrl-C ends the stage, and the last rows come after it.
    process = subprocess.Popen(
        [sys.executable, "-m", "sim2real.stages.live.viewer_process"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu", "RUST_LOG": "off"},
    )
    with suppress(OSError):
        print(json.dumps(order), file=process.stdin, flush=True)
    message = _message(process, _START_S)
    if "line" in message:
        note(f"view: {message['line']}", urgent=True)
        return process
    silent = f"hangs for {_START_S:g} s" if process.poll() is None else "ended"
    note(f"warning: no live view: {message.get('error') or f'its process {silent}'}")
    if message.get("hint"):
        note(f"hint: {message['hint']}")
    _stop(process)
    return None


def _end(process: subprocess.Popen[str]) -> None:
    """Let the process send the last rows; warn if it has failed."""
    if process.stdin is not None:
        with suppress(OSError):
            process.stdin.close()  # the process then sends the last rows, and ends
    message = _message(process, _END_S)
    problem = message.get("error")
    if not message:
        problem = f"its process {'ended early' if process.poll() is not None else 'hangs'}"
    elif message.get("dropped"):
        problem = f"the viewer did not take {message['dropped']} updates"
    if problem:
        note(f"warning: the live view is not whole: {problem}; the stage and its files are")
    _stop(process)


def _stop(process: subprocess.Popen[str]) -> None:
    with suppress(subprocess.TimeoutExpired):
        process.wait(_LEAVE_S)
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


def _message(process: subprocess.Popen[str], wait_s: float) -> Mapping[str, Json]:
    """Return the next message of the process; empty if none comes in time."""
    if process.stdout is None or not select.select([process.stdout], [], [], wait_s)[0]:
        return {}
    line = process.stdout.readline()
    return json.loads(line) if line.startswith("{") else {}
