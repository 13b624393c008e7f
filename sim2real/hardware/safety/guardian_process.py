"""The guardian process: makes the motors safe when the process that controls them has died or is silent.

Run as a program, it takes the torque of servos on a bus off:

    python -I -S guardian_process.py LINK_FD SILENCE_S PORT_FD ANSWER_S OFF QUERY:ANSWER[,ANSWER] ...

It has the port open before torque goes on, and writes to it only when the control process no longer does. It imports
few modules, so that it starts within 20 ms. The packets, which depend on the protocol, are hexadecimal arguments from
`sim2real.hardware.safety.guardian`.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time

TYPE_CHECKING = False  # importing typing or collections.abc takes a third of the start
if TYPE_CHECKING:
    from collections.abc import Callable

READY, BEAT, REST, LEAVE, TRIP = b"r", b"+", b"-", b"q", b"!"
TRIPPED, SAFE, FAILED = b"t", b"s", b"f"
GIVE_UP_S = 10.0
_QUIET_S, _LONGEST_ANSWER_S = 0.002, 0.02
_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>
_PRIORITY = 3  # above the threads that it watches, which have 1: should one never rest, this must not wait for it


class Guard:
    """Decides when to make the motors safe; a subclass does it.

    `watch` runs it in a process; `begin`, `hear` and `look` are its steps.
    """

    cut = "cut the motors' power"
    """The advice to a person if the motors do not confirm."""
    at_rest = True
    """Whether the death of the control process counts while the torque is off, too."""

    def take_torque_off(self) -> str:
        """Make the motors safe and take their torque off; return the reason if that failed, else ""."""
        raise NotImplementedError

    def now_s(self) -> float:
        """Return the time [s]."""
        return time.monotonic()

    def watch(self, link: int, silence_s: float) -> None:
        """Wait until the control process ends it; act when it dies, or is silent for too long with torque on.

        Args:
            silence_s: Longest time without a sign of life while torque is on [s]; 0: unlimited.
        """
        self.begin(silence_s, lambda message: _write(link, message), lambda text: _write(2, f"{text}\n".encode()))
        while True:
            due_s = self.due_s()
            wait_s = None if due_s is None else max(0.0, due_s - self.now_s())
            # Messages first: this process may be late itself.
            if not select.select([link], [], [], wait_s)[0]:
                self.look()
            elif not self.hear(_receive_messages(link)):
                return

    def begin(self, silence_s: float, say: Callable[[bytes], None], tell: Callable[[str], None]) -> None:
        """Report readiness; the control process then arms it with each sign of life.

        Args:
            say: Sends a message to the control process.
            tell: Tells a person.
        """
        self._silence_s, self._say, self._tell = silence_s, say, tell
        self._armed, self._tripped, self._heard_s = False, False, self.now_s()
        say(READY)

    def due_s(self) -> float | None:
        """Return the time at which the control process has been silent for too long [s]; None: never."""
        watched = self._armed and not self._tripped and self._silence_s > 0.0
        return self._heard_s + self._silence_s if watched else None

    def look(self) -> None:
        """Make the motors safe if the control process has been silent for too long."""
        due_s = self.due_s()
        if due_s is not None and self.now_s() >= due_s:
            # Stay until the control process leaves: it may resume, and switch torque on before it notices.
            self._trip(f"the control process was silent for {self._silence_s:.2f} s")

    def hear(self, messages: bytes) -> bool:
        """Process messages of the control process; none: it has died. Return whether to go on."""
        if messages.endswith(LEAVE):
            return False
        if TRIP in messages and not self._tripped:
            self._trip("the control process stopped the robot")
            return True
        if not messages:
            if self._armed or self.at_rest:
                self.make_safe("the control process is gone")
            return False
        self._armed, self._heard_s = messages.endswith(BEAT), self.now_s()
        return True

    def _trip(self, reason: str) -> None:
        self._tripped = True
        self._say(TRIPPED)
        self._say(SAFE if self.make_safe(reason) else FAILED)

    def make_safe(self, reason: str) -> bool:
        """Take the torque off, report it on stderr, and return whether all motors have confirmed."""
        begin_s = self.now_s()
        try:
            failure = self.take_torque_off()
        except Exception as error:
            failure = f"{type(error).__name__}: {error}"
        took_ms = 1e3 * (self.now_s() - begin_s)
        if failure:
            result = f"torque off could NOT be confirmed, {failure}; {self.cut}"
        else:
            result = f"torque is off, confirmed after {took_ms:.0f} ms"
        self._tell(f"sim2real guardian: {reason}: {result}")
        return not failure


class FdPort:
    """The open port of servos, shared with the control process."""

    def __init__(self, fd: int) -> None:
        self._fd = fd

    def now_s(self) -> float:
        """Return the time [s]."""
        return time.monotonic()

    def write(self, packet: bytes) -> None:
        """Send a packet; it is lost if the buffer is full."""
        try:
            os.write(self._fd, packet)
        except BlockingIOError:
            time.sleep(_QUIET_S)

    def receive(self, wait_s: float) -> bytes:
        """Return the bytes that have arrived; none if there are none for a time [s]."""
        if not select.select([self._fd], [], [], wait_s)[0]:
            return b""
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:  # the control process has resumed and read it
            return b""
        if not data:
            raise OSError("it has been unplugged")
        return data


class BusGuard(Guard):
    """Takes the torque of servos on a bus off; arguments as in `sim2real.hardware.safety.guardian.BusGuardian`.

    Args:
        port: An `FdPort`.
    """

    cut = "cut the servos' power"

    def __init__(self, port: FdPort, answer_s: float, off: bytes, servos: list[tuple[bytes, list[bytes]]]) -> None:
        self._port, self._answer_s, self._off, self._servos = port, answer_s, off, servos
        self.now_s = port.now_s

    def take_torque_off(self) -> str:
        """Switch all servos off, repeatedly until each has confirmed; return the reason if that failed, else "".

        Repeated, because the first packet is lost if the control process died while it was writing one, and because
        the control process, if it resumes, may read an answer in place of this one.
        """
        end = self.now_s() + GIVE_UP_S
        unconfirmed = self._servos
        try:
            self._drain()
            while unconfirmed and self.now_s() < end:
                self._port.write(self._off)
                unconfirmed = [servo for servo in unconfirmed if not self._confirms(*servo)]
        except OSError as error:
            return f"the port failed: {error}"
        count = len(unconfirmed)
        return f"{count} of {len(self._servos)} servos did not answer for {GIVE_UP_S:g} s" if count else ""

    def _drain(self) -> None:
        """Wait until no more bytes arrive: on a half-duplex line, sending now would collide with an answer."""
        end = self.now_s() + _LONGEST_ANSWER_S
        while self.now_s() < end and self._port.receive(_QUIET_S):
            pass

    def _confirms(self, query: bytes, answers: list[bytes]) -> bool:
        self._port.write(query)
        end, heard = self.now_s() + self._answer_s, b""
        while (left_s := end - self.now_s()) > 0.0:
            heard += self._port.receive(left_s)
            if any(answer in heard for answer in answers):
                return True
        return False


def _receive_messages(link: int) -> bytes:
    """Return the control process' messages; empty if it has died."""
    try:
        return os.read(link, 4096)
    except OSError:
        return b""


def _write(fd: int, message: bytes) -> None:
    """Write to the control process or the terminal, if it still exists."""
    try:  # noqa: SIM105 - importing contextlib takes a third of the start
        os.write(fd, message)
    except OSError:
        pass


def continue_when_host_dies() -> None:
    """Let the kernel continue this process, should it be stopped, when the control process dies (Linux)."""
    try:
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT)
    except (ImportError, OSError, AttributeError):  # other systems do not continue it
        pass


def begin() -> None:
    """Ignore the terminal's signals, and get the priority over the threads that it watches."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    try:  # noqa: SIM105 - as above
        # Real-time priority, if allowed: on a busy machine this process, which is almost always idle, must not wait.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except (AttributeError, OSError):
        pass
    continue_when_host_dies()


def main(arguments: list[str]) -> None:
    """Run until the control process ends."""
    begin()
    link, silence_s, port_fd, answer_s, off, *rest = arguments
    packets = [text.partition(":") for text in rest]
    servos = [(bytes.fromhex(q), [bytes.fromhex(a) for a in answers.split(",")]) for q, _, answers in packets]
    BusGuard(FdPort(int(port_fd)), float(answer_s), bytes.fromhex(off), servos).watch(int(link), float(silence_s))


if __name__ == "__main__":
    main(sys.argv[1:])
