"""One axis of an ODrive v3 on a serial line, commanded by speed: its ASCII protocol, as of firmware 0.5."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from operator import xor

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.bus.port import Port, open_port
from sim2real.hardware.device import CommandKind, Counters, Device, Reading, Transaction

SPEED = CommandKind("speeds", "rad/s", stale="zero")
TURN = 2.0 * math.pi  # the board counts in turns
IDLE, CLOSED_LOOP = 1, 8  # axis states
STATE, WATCHDOG = "axis0.current_state", "axis0.config.enable_watchdog"

_ANSWER_S = 0.02  # longest wait for an answer, besides its time on the wire
_LATE_S = 0.004  # the time of the request is uncertain if the answer took longer by this
_LOSSES = 5  # missing answers in a row that mean: it is gone
_CHANGE_S = 0.5  # longest wait for the axis to change its state


def framed(text: str) -> bytes:
    """Return a text with its checksum; the board ignores a line whose checksum is wrong, and puts one on its answer."""
    return f"{text}*{reduce(xor, text.encode(), 0)}\n".encode()


def unframed(line: bytes) -> str | None:
    """Return the text of a line; None if it has no checksum, or another one."""
    text, star, checksum = line.strip().rpartition(b"*")
    return text.decode("ascii", "replace") if star and checksum == str(reduce(xor, text, 0)).encode() else None


_OFF = b"\n" + framed(f"w axis0.requested_state {IDLE}")  # the first end of line closes an unfinished line


@dataclass(frozen=True)
class SpeedLoop:
    """How the board keeps a speed.

    Attributes:
        gain: Torque per error of speed [N m s/rad].
        torque: Largest torque [N m].
        speed: Largest speed [rad/s].
    """

    gain: float = 0.05
    torque: float = 2.0
    speed: float = 20.0

    def properties(self) -> dict[str, float]:
        """Return the settings of the board, name -> value: 2 is speed control, 1 takes speeds without a ramp."""
        control = "axis0.controller.config"
        return {
            f"{control}.control_mode": 2,
            f"{control}.input_mode": 1,
            f"{control}.vel_gain": self.gain * TURN,
            f"{control}.vel_integrator_gain": 0,
            f"{control}.vel_limit": self.speed / TURN,
            "axis0.motor.config.torque_lim": self.torque,
        }


class ODrive(Device):
    """Axis 0 of an ODrive, with torque off until `enable`.

    A speed is not answered: one that is lost is followed by the next. Whether the axis still turns, `check` asks.

    Args:
        port: Device file of the port.
        ids: The axes: (0,).
        drive: How it keeps a speed.
        baud_rate: Bits per second.
        silence_s: Time without a command after which the board takes the torque off [s]; 0: never.

    Raises:
        UsageError: Another axis is requested.
    """

    motors = ("axis 0",)
    commanded = SPEED

    def __init__(self, port: str, ids: Sequence[int], drive: SpeedLoop, *, baud_rate: int, silence_s: float) -> None:
        if tuple(ids) != (0,):
            raise UsageError(f"axes {list(ids)}: this driver knows axis 0 alone")
        self._port, self._loop, self._baud_rate, self.silence_s = port, drive, baud_rate, silence_s
        self._line: Port | None = None
        self._lock = threading.Lock()
        self._halted = self._on = False
        self._speed = np.zeros(1)
        self._answers = self._losses = self._late = 0
        self._late_s: list[float] = []

    # -- its description

    def without_host(self) -> tuple[str, ...]:
        """Return what firmware 0.5 does: it disarms an axis that is not fed (axis.config.watchdog_timeout)."""
        if not self.silence_s:
            return ("ODrive v3 (axis 0) goes on as commanded last (its watchdog is not enabled)",)
        return (f"ODrive v3 (axis 0) takes its torque off after {self.silence_s:g} s",)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the board's limit of speed, either way [rad/s]."""
        return np.array([-self._loop.speed]), np.array([self._loop.speed])

    @property
    def counters(self) -> Counters:
        """What went over the line so far."""
        late_s = np.array(self._late_s)
        return Counters(self._answers, self._losses, self._losses, self._late, late_s)

    # -- from open to close

    def open(self) -> None:
        """Open the port, find the board, take the torque off, and write the settings."""
        self._line = open_port(self._port, self._baud_rate)
        self.clock = self._line.clock  # all waiting and all stamps are on it
        self._halted = self._on = False
        try:
            self.disable()
            self._tell("sc")  # errors of an earlier session
            for name, value in self._loop.properties().items():
                self._set(name, value)
            if self.silence_s:
                self._set("axis0.config.watchdog_timeout", self.silence_s)
        except BaseException:
            self.close()
            raise

    def enable(self) -> np.ndarray:
        """Switch the torque on at speed 0; from then on the board wants to be fed."""
        if self._halted:
            raise SafetyStop("the torque was taken off for good", hint="open the device again")
        self._require_no_error()
        self._on = True
        self._tell("v 0 0 0")  # feeds the watchdog too, which is not enabled before
        self._set(WATCHDOG, bool(self.silence_s))
        self._tell(f"w axis0.requested_state {CLOSED_LOOP}")
        self._await(CLOSED_LOOP)
        if self._halted:
            self.make_safe()  # it may have come just before
        return np.zeros(1)

    def measure(self) -> Reading:
        """Ask for position and velocity."""
        values, transaction = self._ask("f 0", 2)
        self._speed = np.array([TURN * values[1]])
        return Reading(np.array([TURN * values[0]]), self._speed, np.full(1, np.nan), transaction)

    def command(self, values: np.ndarray) -> Transaction:
        """Send a speed, which also feeds the watchdog."""
        if self._halted:
            raise SafetyStop("the torque was taken off for good", hint="open the device again")
        if not np.isfinite(values).all() or np.abs(values).max() > self._loop.speed:
            raise SafetyStop(f"{values} rad/s is no speed that the board would take")
        return self._tell(f"v 0 {values[0] / TURN:.6f} 0")

    def check(self) -> None:
        """Ask whether the axis has stopped itself, which an answer to `f` does not contain."""
        self._require_no_error()
        if self._on and self._read(STATE) != CLOSED_LOOP:
            raise SafetyStop("the axis has left its speed loop", hint="was it switched off from elsewhere?")

    # -- the ways out

    def disable(self) -> None:
        """Switch the torque off, and wait until the axis confirms it."""
        self._on = False
        self._tell(f"w axis0.requested_state {IDLE}")
        self._await(IDLE)
        self._set(WATCHDOG, 0)  # an idle axis that is not fed would report an error

    def make_safe(self) -> None:
        """Take the torque off: no lock and no answer, as the code that was interrupted may hold the one and wait for
        the other.
        """
        self._halted = True
        line = self._line
        if line is not None:
            with suppress(OSError):  # gone, or closed meanwhile
                for _ in range(3):
                    line.write(_OFF)

    def close(self) -> None:
        """Take the torque off, if the board still listens, and close the port."""
        line = self._line
        if line is None:
            return
        self.make_safe()
        with suppress(HardwareLost, SafetyStop):
            self.disable()
        with self._lock, suppress(OSError):
            self._line = None
            line.close()

    # -- lines and answers

    def _tell(self, text: str) -> Transaction:
        """Send a line without an answer."""
        asked_ns = self.clock.now_ns()
        with self._lock:
            line, sent_ns = self._send(text)
            self._answers += 1
            return Transaction(sent_ns, sent_ns - asked_ns, line.clock.now_ns() - sent_ns, 0)

    def _ask(self, text: str, count: int) -> tuple[list[float], Transaction]:
        """Ask until an answer has this many numbers."""
        asked_ns = self.clock.now_ns()
        with self._lock:
            began_ns = self.clock.now_ns()
            for losses in range(_LOSSES):
                line, sent_ns = self._send(text)
                heard = self._receive(line, sent_ns)
                now_ns = line.clock.now_ns()
                numbers = _numbers(unframed(heard))
                if len(numbers) == count:
                    wire_ns = 1e10 * (len(framed(text)) + len(heard)) / self._baud_rate
                    late_ns = max(0, round(now_ns - sent_ns - wire_ns))
                    self._answers += 1
                    self._late += late_ns > 1e9 * _LATE_S
                    self._late_s.append(1e-9 * late_ns)
                    return numbers, Transaction(sent_ns, began_ns - asked_ns, now_ns - began_ns, losses, late_ns)
                self._losses += 1
                # Answers have no numbers: one that comes too late must not pass for that to the next question. The port
                # waits, as the lock is held: a clock's sleep may call the rig's watchdog, which needs the lock.
                self._receive(line, line.clock.now_ns(), end=b"")
        raise HardwareLost(f"no answer to {text!r} on {self._port}, {_LOSSES} times", hint="check power and cable")

    def _send(self, text: str) -> tuple[Port, int]:
        """Forget what has come, send a line, and return the port and when that was [ns]."""
        line = self._line
        if line is None:
            raise HardwareLost(f"the ODrive on {self._port} is not open", hint="call open first")
        try:
            line.flush()
            sent_ns = line.clock.now_ns()
            line.write(framed(text))
        except OSError as error:
            raise HardwareLost(f"{self._port} failed: {error}") from error
        return line, sent_ns

    def _receive(self, line: Port, sent_ns: int, end: bytes = b"\n") -> bytes:
        """Return what comes up to the end of a line; all that comes within the wait for an answer if it is late."""
        end_ns, heard = sent_ns + round(1e9 * _ANSWER_S), b""
        try:
            while not (end and heard.endswith(end)) and (came := line.read(end_ns)):
                heard += came
        except OSError as error:
            raise HardwareLost(f"{self._port} failed: {error}") from error
        return heard

    def _read(self, name: str) -> float:
        return self._ask(f"r {name}", 1)[0][0]

    def _set(self, name: str, value: float) -> None:
        """Write a property, and read it back: the board answers only if it does not know it."""
        self._tell(f"w {name} {float(value):.6f}" if isinstance(value, float) else f"w {name} {int(value)}")
        if abs((found := self._read(name)) - value) > 1e-5 + 1e-4 * abs(value):
            raise HardwareLost(f"the ODrive does not keep its settings: {name} is {found}, not {value}")

    def _await(self, state: int) -> None:
        end_ns = self.clock.now_ns() + round(1e9 * _CHANGE_S)
        while self._read(STATE) != state:
            if self.clock.now_ns() > end_ns:
                self._require_no_error()
                raise HardwareLost(f"axis 0 does not reach state {state}", hint="is it calibrated?")

    def _require_no_error(self) -> None:
        if error := int(self._read("axis0.error")):
            raise SafetyStop(f"axis 0 has stopped itself: error {error:#x}", hint="odrivetool: dump_errors(odrv0)")


def _numbers(text: str | None) -> list[float]:
    try:
        return [float(word) for word in (text or "").split()]
    except ValueError:  # such as "invalid property"
        return []
