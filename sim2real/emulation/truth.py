"""The emulator's log of true states and true latencies, with which tests and reports compare results.

The file is one line of JSON (the header), followed by rows of fixed size, so that a truncated file can be read. All
times are nanoseconds of the robot's clock.
"""

import contextlib
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

import numpy as np

from sim2real.errors import Sim2RealError

_FIXED: Final = "<BB6xqqqq"
_MIN_VALUES: Final = 3  # a sample's position, velocity and load


class Kind(IntEnum):
    """The kind of a row, which determines the meaning of its times and values.

    In every row `t_host_ns` is the time at which the emulator received the instruction's last bytes from the host.

    Attributes:
        SAMPLE: An answered read of present values. `t_ns`: time of the sample; `t_done_ns`: time at which the host got
            the answer; `late_ns`: lateness against the plan. Values: position [rad], velocity [rad/s] and load, before
            quantisation.
        EFFECT: A command took effect. `t_ns`: when, at a time step of the plant; for legs half a step earlier, as their
            integrator moves joints; `late_ns`: lateness against the plan, possibly negative. Values: mode and goal.
            `t_host_ns` is 0 for the servo's own command.
        STATE: The plant's true state at `t_ns`. Values: in the order of the header's `state_names`.
        WATCHDOG: The bus watchdog tripped at `t_ns`.
        LOSS: An answer was lost; times as for SAMPLE.
        REPLY: Any other answer. `t_ns`: time at which the instruction was complete on the wire; else as for SAMPLE.
    """

    SAMPLE = 1
    EFFECT = 2
    STATE = 3
    WATCHDOG = 4
    LOSS = 5
    REPLY = 6


def _dtype(values: int) -> np.dtype:
    return np.dtype(
        [
            ("kind", "u1"),
            ("servo_id", "u1"),
            ("_", "V6"),
            ("t_host_ns", "<i8"),
            ("t_ns", "<i8"),
            ("t_done_ns", "<i8"),
            ("late_ns", "<i8"),
            ("values", "<f8", (values,)),
        ]
    )


class TruthLog:
    """Appends rows to a truth file; if the file cannot be written, the log ends, and the emulated robot goes on.

    Args:
        path: The file; an existing one is replaced.
        header: The header: JSON-able, with `state_names`.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        self._values = max(_MIN_VALUES, len(header["state_names"]))
        self._struct = struct.Struct(f"{_FIXED}{self._values}d")
        self._padding = (0.0,) * self._values
        self._file = path.open("wb", buffering=1 << 16)
        self._file.write(json.dumps({**header, "values": self._values}).encode() + b"\n")

    def write(
        self,
        kind: Kind,
        servo_id: int,
        t_host_ns: int,
        t_ns: int,
        t_done_ns: int,
        late_ns: int,
        values: Sequence[float] = (),
    ) -> None:
        """Write one row; see `Kind` for times and values. ``servo_id`` 0 stands for the whole plant."""
        padded = (*values, *self._padding[len(values) :])
        with contextlib.suppress(OSError):
            self._file.write(self._struct.pack(kind, servo_id, t_host_ns, t_ns, t_done_ns, late_ns, *padded))

    def flush(self) -> None:
        """Pass all rows on to the file."""
        with contextlib.suppress(OSError):
            self._file.flush()

    def close(self) -> None:
        """Close the file; may be called twice."""
        with contextlib.suppress(OSError):
            self._file.close()


@dataclass(frozen=True)
class Truth:
    """A truth file in memory.

    Args:
        header: The emulator's `config`, `servo_ids`, `state_names`, and the plant's parameters (`truth`).
        rows: Structured array of shape (N,), see `Kind`; `values` has shape (N, V).
    """

    header: dict[str, Any]
    rows: np.ndarray

    def of(self, kind: Kind, servo_id: int | None = None) -> np.ndarray:
        """Return the rows of one kind, optionally of one servo only, in the order in which they were written."""
        selected = self.rows["kind"] == kind
        if servo_id is not None:
            selected &= self.rows["servo_id"] == servo_id
        return self.rows[selected]

    @property
    def parameters(self) -> dict[str, Any]:
        """The plant's true parameters."""
        return self.header["truth"]

    def states(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return times, shape (N,) [ns], and true states by name, each of shape (N,), sampled at 200 Hz."""
        rows = self.of(Kind.STATE)
        return rows["t_ns"], {name: rows["values"][:, i] for i, name in enumerate(self.header["state_names"])}


def read_truth(path: Path | str) -> Truth:
    """Read a truth file without an incomplete last row; raise Sim2RealError if it does not exist or has no header."""
    path = Path(path)
    if not path.is_file():
        raise Sim2RealError(f"there is no truth file {path}")
    head, newline, body = path.read_bytes().partition(b"\n")
    if not newline:
        raise Sim2RealError(f"truth file {path} has no header", hint="was the emulator killed while it started?")
    header = json.loads(head)
    dtype = _dtype(header["values"])
    return Truth(header, np.frombuffer(body[: len(body) // dtype.itemsize * dtype.itemsize], dtype))
