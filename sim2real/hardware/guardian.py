"""The control process' side of the guardian: starts it, shows it signs of life, and hears from it."""

from __future__ import annotations

import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware import guardian_process as process
from sim2real.hardware import registers as reg
from sim2real.hardware.protocol import ALERT_BIT, BROADCAST_ID, Instruction, build, build_status

_START_TIMEOUT_S: Final = 10.0
_SETTLE_TIMEOUT_S: Final = 1.0
_BEATS: Final = 10  # signs of life in the time after which silence is too long
_INTERVAL_S: Final = 0.01  # between signs of life where silence may last
_UNHEARD_BYTES: Final = 20_000  # Linux takes 770 of twice so many for each: 50 signs that it has not read, and it hangs
_DEAD: Final = "the guardian has died: nothing would take the torque off if this process died too"


def torque_off_packet(ids: Sequence[int]) -> bytes:
    """Return the one instruction that takes the torque of all servos off; none of them answers."""
    register = reg.TORQUE_ENABLE
    head = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
    return build(BROADCAST_ID, Instruction.SYNC_WRITE, head + b"".join(bytes((i, 0)) for i in ids))


class Guardian:
    """A process of its own that takes the torque off when this one dies, or says nothing while torque is on.

    It shares the open port and its lock: nobody else gets the port before the torque is off. In normal operation it
    only listens to `beat`, which costs 2 us every tenth of `silence_s`. What it did is said on stderr.

    Args:
        port_fd: The open port.
        ids: The servos.
        silence_s: So long without `beat`, while torque is on, is too long [s]; 0: only death counts.
        answer_s: How long a servo's answer may take [s].

    Raises:
        HardwareLost: It does not start.
    """

    def __init__(self, port_fd: int, ids: Sequence[int], silence_s: float, answer_s: float) -> None:
        self._silence_s = silence_s
        self._interval_s = silence_s / _BEATS or _INTERVAL_S
        self._beat_s = 0.0
        self._armed = False
        self._lock = threading.RLock()  # a signal's handler may close the bus in the middle of `beat`
        self._said = b""
        self._link, other = socket.socketpair()
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _UNHEARD_BYTES)
        torque = reg.TORQUE_ENABLE
        head = torque.address.to_bytes(2, "little") + torque.size.to_bytes(2, "little")
        servos = [
            f"{build(i, Instruction.READ, head).hex()}:"
            + ",".join(build_status(i, error, b"\0").hex() for error in (0, ALERT_BIT))
            for i in ids
        ]
        longest_s = silence_s + self._interval_s if silence_s else 0.0  # a sign of life may be as old as the interval
        numbers = [str(port_fd), str(other.fileno()), repr(longest_s), repr(answer_s)]
        # -I -S: neither what the user has installed nor the working directory decides what runs here.
        command = [sys.executable, "-I", "-S", str(Path(process.__file__)), *numbers, torque_off_packet(ids).hex()]
        try:
            # A session of its own: Ctrl-C in a terminal is for the control process alone.
            self._process = subprocess.Popen(
                [*command, *servos],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(port_fd, other.fileno()),
                start_new_session=True,
            )
        except OSError as error:
            self._link.close()
            raise HardwareLost(
                f"the guardian cannot be started: {error}", hint="torque stays off without it"
            ) from error
        finally:
            other.close()
        if not self._hears(process.READY, _START_TIMEOUT_S):
            self._process.kill()
            self.end(confirmed=True)
            raise HardwareLost("the guardian does not start", hint="torque stays off without it")
        self._said = b""
        self._link.setblocking(False)

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    def arm(self) -> None:
        """Ask it to watch for silence, before torque goes on.

        Raises:
            SafetyStop: As of `beat`.
        """
        with self._lock:
            self._armed, self._beat_s = True, 0.0
        try:
            self.beat()
        except SafetyStop:
            self._armed = False
            raise

    def disarm(self) -> None:
        """Allow silence: torque is off. Never raises: if it has died, the next `arm` tells."""
        with self._lock, suppress(SafetyStop):  # locked: a sign of life after this one would have it watch on
            self._armed = False
            self._say(process.REST)

    def beat(self) -> None:
        """Show a sign of life; call it before every instruction on the bus.

        Raises:
            SafetyStop: The guardian has taken the torque off, or has died; from then on always.
        """
        with self._lock:
            now_s = time.monotonic()
            if not self._armed or (not self._said and now_s - self._beat_s < self._interval_s):
                return
            self._beat_s = now_s
            self._listen()
            if not self._said:
                self._say(process.BEAT)
                return
        raise SafetyStop(
            f"the guardian has taken the torque off: this process was silent for {self._silence_s:g} s",
            hint="was it stopped, or the machine too busy? servo_watchdog_s sets the limit",
        )

    def settle(self) -> bool:
        """Let it finish what it is doing on the bus, if it has taken over. Never raises.

        Returns:
            Whether it still watches: it has neither taken over nor died.
        """
        try:
            with self._lock:
                self._listen()
        except SafetyStop:
            return False
        if self._said and process.SAFE not in self._said:
            self._hears(process.SAFE, _SETTLE_TIMEOUT_S)
        return not self._said

    def end(self, confirmed: bool) -> None:
        """Let it go. Never raises.

        Args:
            confirmed: Whether all servos have confirmed that their torque is off; if not, it goes on trying.
        """
        if confirmed:
            with suppress(SafetyStop):
                self._say(process.LEAVE)
        self._link.close()
        if not confirmed:
            return
        try:
            self._process.wait(_SETTLE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _say(self, message: bytes) -> None:
        try:
            self._link.send(message)
        except OSError as error:  # it is gone, or does not read
            raise SafetyStop(_DEAD, hint="start again") from error

    def _listen(self) -> None:
        """Take in what the guardian has said."""
        try:
            said = self._link.recv(16)
        except BlockingIOError:
            return
        except OSError:
            said = b""
        if not said:
            raise SafetyStop(_DEAD, hint="start again")
        self._said += said

    def _hears(self, message: bytes, timeout_s: float) -> bool:
        """Wait for a message, for word of a failure, or for the guardian's end; return whether the message came."""
        end_s = time.monotonic() + timeout_s
        with suppress(SafetyStop):
            while message not in self._said and process.FAILED not in self._said:
                left_s = end_s - time.monotonic()
                if left_s <= 0.0 or not select.select([self._link], [], [], left_s)[0]:
                    break
                self._listen()
        return message in self._said
