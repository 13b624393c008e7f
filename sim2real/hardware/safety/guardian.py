"""The guardian: a process that makes the motors safe when the process that controls them dies or is silent.

    python -P -m sim2real.hardware.safety.guardian LINK_FD SILENCE_S MODULE:FUNCTION [ARGUMENT ...]

``FUNCTION(*arguments)`` returns the `Motors`. The process starts before torque goes on, opens everything it needs, and
touches the motors only when the control process no longer does. `Guard` runs in this process, `Guardian` in the control
process.
"""

import importlib
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock

READY, BEAT, REST, LEAVE, TRIP = b"r", b"+", b"-", b"q", b"!"
TRIPPED, SAFE, FAILED = b"t", b"s", b"f"
GIVE_UP_S = 10.0
"""Time for which motors that do not confirm "torque off" are asked again [s]."""
PRIORITY: Final = 3  # above the watched threads, which have 1: if one never sleeps, this process must not wait for it
_PR_SET_PDEATHSIG: Final = 1  # of <sys/prctl.h>
_START_TIMEOUT_S: Final = 10.0
_SETTLE_TIMEOUT_S: Final = 1.0
_KILL_S: Final = 0.01
_BEATS: Final = 10  # signs of life per longest silence
_INTERVAL_S: Final = 0.01  # between signs of life, if silence is not limited
_DEAD: Final = "the guardian has died: the torque would stay on if this process died too"


@dataclass(frozen=True)
class Motors:
    """Motors that a guardian watches.

    Attributes:
        take_torque_off: Makes the motors safe and takes their torque off; returns why they did not confirm, else "".
        cut: Advice to a person if they do not confirm.
        at_rest: Whether the guardian also acts if the control process dies while the torque is off.
        close: Called when the guardian ends.
    """

    take_torque_off: Callable[[], str]
    clock: Clock = SYSTEM_CLOCK
    cut: str = "cut the motors' power"
    at_rest: bool = True
    close: Callable[[], None] = lambda: None


class Guard:
    """Decides when the motors are made safe; `watch` is the loop of its process, `hear` and `look` are its steps.

    Args:
        silence_s: Longest time without a sign of life while torque is on [s]; 0: unlimited.
        say: Sends a message to the control process.
        tell: Tells a person.
    """

    def __init__(
        self, motors: Motors, silence_s: float, say: Callable[[bytes], None], tell: Callable[[str], None]
    ) -> None:
        self._motors, self._silence_s, self._say, self._tell = motors, silence_s, say, tell
        self._armed, self._tripped, self._heard_s = False, False, self._now_s()
        say(READY)

    def watch(self, link: int) -> None:
        """Run until the control process ends the guardian, or dies."""
        going = True
        while going:
            due_s = self.due_s()
            wait_s = None if due_s is None else max(0.0, due_s - self._now_s())
            # Read messages first: this process may be late itself.
            if not select.select([link], [], [], wait_s)[0]:
                self.look()
                continue
            messages = b""  # the control process has died
            with suppress(OSError):
                messages = os.read(link, 4096)
            going = self.hear(messages)

    def due_s(self) -> float | None:
        """Return the time at which the control process has been silent for too long [s]; None: never."""
        watched = self._armed and not self._tripped and self._silence_s > 0.0
        return self._heard_s + self._silence_s if watched else None

    def look(self) -> None:
        """Make the motors safe if the control process has been silent for too long."""
        due_s = self.due_s()
        if due_s is not None and self._now_s() >= due_s:
            # Stay until the control process ends: it may resume, and switch torque on before it reads the message.
            self._trip(f"the control process was silent for {self._silence_s:.2f} s")

    def hear(self, messages: bytes) -> bool:
        """Process messages of the control process; empty if it has died. Return whether to go on."""
        if not messages and (self._armed or self._motors.at_rest):
            self._make_safe("the control process is gone")
        if not messages or messages.endswith(LEAVE):
            return False
        if TRIP in messages and not self._tripped:
            self._trip("the control process stopped the robot")
        else:
            self._armed, self._heard_s = messages.endswith(BEAT), self._now_s()
        return True

    def _trip(self, reason: str) -> None:
        self._tripped = True
        self._say(TRIPPED)
        self._say(SAFE if self._make_safe(reason) else FAILED)

    def _make_safe(self, reason: str) -> bool:
        """Make the motors safe, and report it; return whether all have confirmed."""
        begin_s = self._now_s()
        try:
            failure = self._motors.take_torque_off()
        except Exception as error:
            failure = f"{type(error).__name__}: {error}"
        result = f"torque is off, confirmed after {1e3 * (self._now_s() - begin_s):.0f} ms"
        if failure:
            result = f"torque off could NOT be confirmed, {failure}; {self._motors.cut}"
        self._tell(f"sim2real guardian: {reason}: {result}")
        return not failure

    def _now_s(self) -> float:
        return 1e-9 * self._motors.clock.now_ns()


def main(link_fd: str, silence_s: str, place: str, *arguments: str) -> None:
    """Run until the control process ends."""
    module, _, name = place.partition(":")
    motors: Motors = getattr(importlib.import_module(module), name)(*arguments)
    # Ignore the signals of a terminal and a service manager: this process ends with the control process.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # On a busy machine this process must not wait. Threads that a connection has started keep their priority.
    with suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    # If this process is stopped, e.g. by a debugger, Linux continues it when the control process dies.
    with suppress(ImportError, OSError, AttributeError):
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)
    link, stderr = int(link_fd), 2

    def write(fd: int, message: bytes) -> None:
        with suppress(OSError):  # the control process or the terminal may be gone
            os.write(fd, message)

    Guard(motors, float(silence_s), partial(write, link), lambda text: write(stderr, f"{text}\n".encode())).watch(link)
    motors.close()


class Channel(Protocol):
    """The control process's end of the connection to a guardian.

    `send` does not wait; it raises OSError if the guardian has died, or does not read. `receive` waits for messages
    until a time [ns]; it returns None if none come, and b"" if the guardian has died. `close` closes the connection,
    waits for the guardian's end, and kills it after a time [s]; 0: no wait.
    """

    clock: Clock

    def send(self, message: bytes) -> None: ...
    def receive(self, until_ns: int) -> bytes | None: ...
    def close(self, wait_s: float) -> None: ...


class Process:
    """The guardian's process, connected to this one by a socket; a `Channel`.

    Args:
        place: ``MODULE:FUNCTION`` that returns the `Motors`.
        longest_s: The longest silence [s].
        pass_fds: Further file descriptors that the process inherits.

    Raises:
        HardwareLost: It cannot be started.
    """

    def __init__(self, place: str, arguments: Sequence[str], longest_s: float, pass_fds: Sequence[int] = ()) -> None:
        self.clock: Clock = SYSTEM_CLOCK
        self._link, other = socket.socketpair()
        command = [sys.executable, "-P", "-m", __name__, str(other.fileno()), repr(longest_s), place, *arguments]
        try:
            # In a new session, so that Ctrl-C in a terminal reaches only the control process.
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(*pass_fds, other.fileno()),
                start_new_session=True,
            )
        except OSError as error:
            self._link.close()
            raise HardwareLost(
                f"the guardian cannot be started: {error}", hint="torque stays off without it"
            ) from error
        finally:
            other.close()
        self.pid = self._process.pid
        self._link.setblocking(False)

    def send(self, message: bytes) -> None:
        self._link.send(message)

    def receive(self, until_ns: int) -> bytes | None:
        left_s = max(0.0, 1e-9 * (until_ns - self.clock.now_ns()))
        try:
            if left_s and not select.select([self._link], [], [], left_s)[0]:
                return None
            return self._link.recv(256, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None
        except (OSError, ValueError):
            return b""

    def close(self, wait_s: float) -> None:
        self._link.close()
        if not wait_s:
            return
        try:
            self._process.wait(wait_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Guardian:
    """The control process's side: starts a guardian, sends it signs of life, and reads its messages.

    The next sign of life, which takes 10 us, notices a guardian that died. The guardian reports its actions on stderr.

    Args:
        start: Starts the process, given the longest silence [s].
        silence_s: Longest time without a sign of life while torque is on [s]; 0: unlimited, only this process' death
            counts.
        settle_s: Longest time until the motors are in the safe state [s].

    Raises:
        HardwareLost: It does not start.
    """

    def __init__(
        self, start: Callable[[float], Channel], silence_s: float, settle_s: float = _SETTLE_TIMEOUT_S
    ) -> None:
        self._silence_s, self._settle_s = silence_s, settle_s
        self._interval_s = silence_s / _BEATS or _INTERVAL_S
        self._beat_s = -math.inf
        self._armed = self._tripped = False
        self._lock = threading.RLock()  # reentrant, because a signal handler may close the bus in the middle of `beat`
        self._messages = b""
        # Signs of life are one interval apart. Torque may go on only once the guardian watches.
        self._channel = start(silence_s + self._interval_s if silence_s else 0.0)
        if not self._hears(READY, _START_TIMEOUT_S):
            self._channel.close(_KILL_S)
            raise HardwareLost("the guardian does not start", hint="torque stays off without it")
        self._messages = b""

    @property
    def took_over(self) -> bool:
        """Whether it has made the motors safe, or has begun to."""
        return bool(self._messages) or self._tripped

    def arm(self) -> None:
        """Arm the guardian before torque goes on; raise SafetyStop as `beat` does."""
        with self._lock:
            self._armed, self._beat_s = True, -math.inf
        try:
            self.beat()
        except SafetyStop:
            self._armed = False
            raise

    def disarm(self) -> None:
        """End the watch for silence, as torque is off. Never raises; if the guardian died, the next `arm` raises."""
        # Locked, because a sign of life after this message would arm the guardian again.
        with self._lock, suppress(SafetyStop):
            self._armed = False
            self._send(REST)

    def beat(self) -> None:
        """Send a sign of life if one is due; called before every instruction on the bus.

        Raises:
            SafetyStop: The guardian has taken the torque off, or has died; also at all later calls.
        """
        with self._lock:
            now_s = 1e-9 * self._channel.clock.now_ns()
            if not self._armed or (not self._messages and now_s - self._beat_s < self._interval_s):
                return
            self._beat_s = now_s
            # Any message means that the guardian has taken over; without one, send a sign of life.
            self._listen()
            if not self._messages:
                self._send(BEAT)
                return
        raise SafetyStop(
            f"the guardian has taken the torque off: this process was silent for {self._silence_s:g} s",
            hint="is this computer too busy, or was the process stopped? servo_watchdog_s sets the limit",
        )

    def require_watching(self) -> None:
        """Raise SafetyStop as `beat` does, even when no sign of life is due.

        Called when the bus seems lost: a guardian that takes over reads the answers that are missing here.
        """
        self._beat_s = -math.inf
        self.beat()

    def trip(self) -> None:
        """Let the guardian make the motors safe now. Takes no lock, for signal handlers; never raises."""
        self._tripped = True
        with suppress(OSError):  # it has died, or does not read
            self._channel.send(TRIP)

    def settle(self) -> bool:
        """If the guardian is making the motors safe, wait until they are. Never raises.

        Returns:
            Whether the guardian still watches: it has neither taken over nor died.
        """
        try:
            with self._lock:
                self._listen()
        except SafetyStop:
            return False
        if self.took_over and SAFE not in self._messages:
            self._hears(SAFE, self._settle_s)
        return not self.took_over

    def end(self, confirmed: bool) -> None:
        """End the guardian. Never raises.

        Args:
            confirmed: Whether all motors have confirmed that their torque is off; if not, the guardian tries for
                another 10 s.
        """
        if confirmed:
            with suppress(SafetyStop):
                self._send(LEAVE)
        self._channel.close(_SETTLE_TIMEOUT_S if confirmed else 0.0)

    def _send(self, message: bytes) -> None:
        try:
            self._channel.send(message)
        except OSError as error:  # it has died, or does not read
            raise SafetyStop(_DEAD, hint="start again") from error

    def _listen(self, until_ns: int = 0) -> bool:
        """Wait for the guardian's messages until a time [ns]; return whether one came; raise if it has died."""
        heard = False
        while (received := self._channel.receive(0 if heard else until_ns)) is not None:
            if not received:
                raise SafetyStop(_DEAD, hint="start again")
            heard = True
            self._messages += received
        return heard

    def _hears(self, message: bytes, timeout_s: float) -> bool:
        """Wait for a message; return False after a timeout, a report of failure, or the guardian's death."""
        end_ns = self._channel.clock.now_ns() + round(1e9 * timeout_s)
        with suppress(SafetyStop):
            while message not in self._messages and FAILED not in self._messages:
                if not self._listen(end_ns):
                    break
        return message in self._messages


if __name__ == "__main__":
    main(*sys.argv[1:])
