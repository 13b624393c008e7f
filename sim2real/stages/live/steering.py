"""What steers a walking robot: keys, and a gamepad at Linux's device of a joystick."""

from __future__ import annotations

import os
import select
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.stages.terminal.console import note

Follow = Callable[[np.ndarray], None]
"""Changes the commanded velocity ``(3,)``: forwards, to the left [m/s], yaw rate [rad/s]."""
_SPACE = 32
_KEYS = {265: (0, 0.1), 264: (0, -0.1), 44: (1, 0.1), 46: (1, -0.1), 263: (2, 0.1), 262: (2, -0.1)}
"""Key of GLFW -> entry of the command, and its change: arrows, comma, full stop."""
_IN_TERMINAL = {b"\x1b[A": 265, b"\x1b[B": 264, b"\x1b[D": 263, b"\x1b[C": 262, b",": 44, b".": 46, b" ": _SPACE}
"""Bytes of a terminal -> key."""
_EVENT = struct.Struct("=IhBB")
"""``struct js_event`` of linux/joystick.h: time, value, kind, and number of the axis."""
_AXIS, _AT_START, _LARGEST, _REST = 0x02, 0x80, 32767.0, 0.1
"""Kind of an axis's event, flag of the state at the start, largest value, and share of it at which a stick rests."""
_STICKS = {1: 0, 0: 1, 3: 2}
"""Axis -> entry of the command: left stick up and down, from side to side, and the right one from side to side."""


def steer(wanted: np.ndarray, key: int) -> None:
    """Change the commanded velocity ``(3,)`` by a key."""
    if key == _SPACE:
        wanted[:] = 0.0
    elif key in _KEYS:
        entry, change = _KEYS[key]
        wanted[entry] = np.clip(wanted[entry] + change, -1.0, 1.0)


def gamepad(device: Path, most: Sequence[float]) -> Follow:
    """Return what sets the command by the sticks of a gamepad; one that is pulled out commands standing still.

    Args:
        device: Such as ``/dev/input/js0``.
        most: Commands of sticks at their ends.
    """
    try:
        descriptor = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
    except OSError as error:
        hint = "`ls /dev/input/js*` lists gamepads; reading one may need the group input"
        raise UsageError(f"no gamepad at {device}: {error.strerror}", hint=hint) from error
    gone = False

    def follow(wanted: np.ndarray) -> None:
        nonlocal gone
        while not gone:
            try:
                data = os.read(descriptor, _EVENT.size)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if len(data) < _EVENT.size:
                gone, wanted[:] = True, 0.0
                note(f"warning: the gamepad at {device} is gone: the robot stands still")
                return
            _, value, kind, number = _EVENT.unpack(data)
            if kind & ~_AT_START == _AXIS and number in _STICKS:
                entry, share = _STICKS[number], -value / _LARGEST  # up and left are negative
                wanted[entry] = share * most[entry] if abs(share) > _REST else 0.0

    return follow


@contextmanager
def terminal_keys() -> Iterator[Follow]:
    """Yield what follows the keys of this terminal, which echoes none of them meanwhile; nothing without a terminal."""
    if not sys.stdin.isatty():
        yield lambda wanted: None
        return
    import termios  # not on Windows
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def follow(wanted: np.ndarray) -> None:
        data = b""
        while select.select([descriptor], [], [], 0.0)[0] and (more := os.read(descriptor, 64)):
            data += more
        while data:
            pressed = next((k for k in _IN_TERMINAL if data.startswith(k)), data[:1])
            steer(wanted, _IN_TERMINAL.get(pressed, 0))
            data = data[len(pressed) :]

    try:
        tty.setcbreak(descriptor)
        note("keys: arrows forwards, backwards and turn, comma and full stop sideways, space stops")
        yield follow
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
