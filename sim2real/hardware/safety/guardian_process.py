"""The guardian process: makes the motors safe when the process that controls them has died or is silent.

Run as a program, it takes the torque of servos on a bus off:

    python -I -S guardian_process.py LINK_FD SILENCE_S PORT_FD ANSWER_S OFF QUERY:ANSWER[,ANSWER] ...

It has the port open before torque goes on, and writes to it only when the control process no longer does. It imports
few modules, so that it starts within 20 ms. The packets, which depend on the protocol, are hexadecimal arguments from
`sim2real.hardware.safety.guardian`.
"""

import os
import select
import signal
import sys
import time

READY, BEAT, REST, LEAVE, TRIP = b"r", b"+", b"-", b"q", b"!"
HEARD, TRIPPED, SAFE, FAILED = b".", b"t", b"s", b"f"
GIVE_UP_S = 10.0
_QUIET_S, _LONGEST_ANSWER_S = 0.002, 0.02
_PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>
_PRIORITY = 3  # above the threads that it watches, which have 1: should one never rest, this must not wait for it


class Guard:
    """Decides when to make the motors safe; a subclass does it."""

    cut = "cut the motors' power"
    """The advice to a person if the motors do not confirm."""
    at_rest = True
    """Whether the death of the control process counts while the torque is off, too."""

    def take_torque_off(self) -> str:
        """Make the motors safe and take their torque off; return the reason if that failed, else ""."""
        raise NotImplementedError

    def watch(self, link: int, silence_s: float) -> None:
        """Wait until the control process ends it; act when it dies, or is silent for too long with torque on.

        Args:
            silence_s: Longest time without a sign of life while torque is on [s]; 0: unlimited.
        """
        # Report readiness; the control process then arms it with each beat.
        armed, tripped, heard_s = False, False, time.monotonic()
        _write(link, READY)
        while True:
            watched = armed and not tripped and silence_s > 0.0
            wait_s = max(0.0, heard_s + silence_s - time.monotonic()) if watched else None
            if select.select([link], [], [], wait_s)[0]:  # messages first: this process may be late itself
                messages = _receive_messages(link)
                if messages.endswith(LEAVE):
                    return
                if TRIP in messages and not tripped:
                    tripped = True
                    self._trip(link, "the control process stopped the robot")
                    continue
                if not messages:
                    if armed or self.at_rest:
                        self.make_safe("the control process is gone")
                    return
                armed, heard_s = messages.endswith(BEAT), time.monotonic()
                if armed:
                    _write(link, HEARD)
            elif watched and time.monotonic() - heard_s >= silence_s:
                # Stay until the control process leaves: it may resume, and switch torque on before it notices.
                tripped = True
                self._trip(link, f"the control process was silent for {silence_s:.2f} s")

    def _trip(self, link: int, reason: str) -> None:
        _write(link, TRIPPED)
        _write(link, SAFE if self.make_safe(reason) else FAILED)

    def make_safe(self, reason: str) -> bool:
        """Take the torque off, report it on stderr, and return whether all motors have confirmed."""
        begin_s = time.monotonic()
        failure = self.take_torque_off()
        took_ms = 1e3 * (time.monotonic() - begin_s)
        if failure:
            result = f"torque off could NOT be confirmed, {failure}; {self.cut}"
        else:
            result = f"torque is off, confirmed after {took_ms:.0f} ms"
        _write(2, f"sim2real guardian: {reason}: {result}\n".encode())
        return not failure


class BusGuard(Guard):
    """Takes the torque of servos on a bus off; arguments as in `sim2real.hardware.safety.guardian.BusGuardian`."""

    cut = "cut the servos' power"

    def __init__(self, port_fd: int, answer_s: float, off: bytes, servos: list[tuple[bytes, list[bytes]]]) -> None:
        self._fd, self._answer_s, self._off, self._servos = port_fd, answer_s, off, servos

    def take_torque_off(self) -> str:
        """Switch all servos off, repeatedly until each has confirmed; return the reason if that failed, else "".

        Repeated, because the first packet is lost if the control process died while it was writing one, and because
        the control process, if it resumes, may read an answer in place of this one.
        """
        end = time.monotonic() + GIVE_UP_S
        unconfirmed = self._servos
        try:
            self._drain()
            while unconfirmed and time.monotonic() < end:
                self._send(self._off)
                unconfirmed = [servo for servo in unconfirmed if not self._confirms(*servo)]
        except OSError as error:
            return f"the port failed: {error}"
        count = len(unconfirmed)
        return f"{count} of {len(self._servos)} servos did not answer for {GIVE_UP_S:g} s" if count else ""

    def _drain(self) -> None:
        """Wait until no more bytes arrive: on a half-duplex line, sending now would collide with an answer."""
        end = time.monotonic() + _LONGEST_ANSWER_S
        while time.monotonic() < end and self._receive(_QUIET_S):
            pass

    def _send(self, packet: bytes) -> None:
        try:
            os.write(self._fd, packet)
        except BlockingIOError:  # the buffer is full: the packet is lost, and sent again in the next round
            time.sleep(_QUIET_S)

    def _confirms(self, query: bytes, answers: list[bytes]) -> bool:
        self._send(query)
        end, heard = time.monotonic() + self._answer_s, b""
        while (left_s := end - time.monotonic()) > 0.0:
            heard += self._receive(left_s)
            if any(answer in heard for answer in answers):
                return True
        return False

    def _receive(self, wait_s: float) -> bytes:
        if not select.select([self._fd], [], [], wait_s)[0]:
            return b""
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:  # the control process has resumed and read it
            return b""
        if not data:
            raise OSError("it has been unplugged")
        return data


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
    BusGuard(int(port_fd), float(answer_s), bytes.fromhex(off), servos).watch(int(link), float(silence_s))


if __name__ == "__main__":
    main(sys.argv[1:])
