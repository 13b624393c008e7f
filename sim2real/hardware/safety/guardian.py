"""The control process's side of the guardian: starts it, sends it signs of life, and reads its messages."""

import math
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.safety import guardian_process as process

_START_TIMEOUT_S: Final = 10.0
_SETTLE_TIMEOUT_S: Final = 1.0
_KILL_S: Final = 0.01
_BEATS: Final = 10  # number of signs of life in the longest silence
_INTERVAL_S: Final = 0.01  # between signs of life if silence is not limited
_DEAD: Final = "the guardian has died: the torque would stay on if this process died too"


class Channel(Protocol):
    """The control process's end of the connection to a guardian.

    Attributes:
        pid: The guardian's process id.
        clock: The time of the device.
    """

    pid: int
    clock: Clock

    def send(self, message: bytes) -> None:
        """Send a message, without waiting; OSError if the guardian has died, or does not read."""
        ...

    def receive(self, until_ns: int) -> bytes | None:
        """Return messages; None if there are none until a time [ns]; b"" if the guardian has died."""
        ...

    def close(self, wait_s: float) -> None:
        """Close the connection; then wait for the guardian's end, and kill it after a time [s]; 0: do not wait."""
        ...


class Process:
    """A guardian's process, which shares a socket with this one; a `Channel`.

    Args:
        program: Arguments of Python that start the process: flags, then a file or a module. It gets the file descriptor
            of the socket, and the longest silence, and then ``arguments``.
        longest_s: The longest silence [s].
        pass_fds: Further file descriptors that the process inherits.

    Raises:
        HardwareLost: It cannot be started.
    """

    def __init__(
        self, program: Sequence[str], longest_s: float, arguments: Sequence[str] = (), pass_fds: Sequence[int] = ()
    ) -> None:
        self.clock: Clock = SYSTEM_CLOCK
        self._link, other = socket.socketpair()
        command = [sys.executable, *program, str(other.fileno()), repr(longest_s), *arguments]
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
    """A separate process that makes the motors safe when this one dies, or gives no sign of life while torque is on.

    In normal operation it only receives signs of life from `beat`, which cost 10 us each: a guardian that died is
    noticed at the next one. If this process dies while the guardian is stopped, as by a debugger, the kernel lets it
    continue (Linux), and it makes the motors safe. It reports its actions on stderr.

    Args:
        start: Starts the guardian, given the longest silence [s].
        silence_s: Longest time without a sign of life while torque is on [s]; 0: unlimited, only this process' death
            counts.
        settle_s: Longest time until the motors are in the safe state [s].

    Raises:
        HardwareLost: It does not start.
    """

    def __init__(
        self, start: Callable[[float], Channel], silence_s: float, settle_s: float = _SETTLE_TIMEOUT_S
    ) -> None:
        self._settle_s = settle_s
        self._silence_s = silence_s
        self._interval_s = silence_s / _BEATS or _INTERVAL_S
        self._beat_s = -math.inf
        self._armed = self._tripped = False
        self._lock = threading.RLock()  # reentrant, as a signal handler may close the bus in the middle of `beat`
        self._messages = b""
        # Signs of life are one interval apart.
        self._channel = start(silence_s + self._interval_s if silence_s else 0.0)
        # Torque may go on only once it watches.
        if not self._hears(process.READY, _START_TIMEOUT_S):
            self._channel.close(_KILL_S)
            raise HardwareLost("the guardian does not start", hint="torque stays off without it")
        self._messages = b""

    @property
    def pid(self) -> int:
        """The guardian's process id."""
        return self._channel.pid

    @property
    def took_over(self) -> bool:
        """Whether it has made the motors safe, or was about to."""
        return bool(self._messages) or self._tripped

    def arm(self) -> None:
        """Arm the guardian; called before torque goes on.

        Raises:
            SafetyStop: As in `beat`.
        """
        with self._lock:
            self._armed, self._beat_s = True, -math.inf
        try:
            self.beat()
        except SafetyStop:
            self._armed = False
            raise

    def disarm(self) -> None:
        """Let it no longer watch for silence, as torque is off. Never raises; if it has died, the next `arm` raises."""
        with self._lock, suppress(SafetyStop):  # locked, as a sign of life sent after this message would arm it again
            self._armed = False
            self._send(process.REST)

    def beat(self) -> None:
        """Send a sign of life if one is due; called before every instruction on the bus.

        Raises:
            SafetyStop: The guardian has taken the torque off, or has died; also at all later calls.
        """
        with self._lock:
            now_s = self._now_s()
            if not self._armed or (not self._messages and now_s - self._beat_s < self._interval_s):
                return
            self._beat_s = now_s
            # Any message means that it has taken over; without one, show it that this process lives.
            self._listen()
            if not self._messages:
                self._send(process.BEAT)
                return
        raise SafetyStop(
            f"the guardian has taken the torque off: this process was silent for {self._silence_s:g} s",
            hint="is this computer too busy, or was the process stopped? servo_watchdog_s sets the limit",
        )

    def require_watching(self) -> None:
        """Raise SafetyStop as `beat` does, also when no sign of life is due: called when the bus seems lost.

        A guardian that takes over reads the servos' answers, which are then missing here.
        """
        self._beat_s = -math.inf
        self.beat()

    def trip(self) -> None:
        """Let it make the motors safe now. Without a lock, for signal handlers; never raises."""
        self._tripped = True
        with suppress(OSError):  # it has died, or does not read
            self._channel.send(process.TRIP)

    def settle(self) -> bool:
        """Wait until the motors are in the safe state, if it is making them safe. Never raises.

        Returns:
            Whether it still watches: it has neither taken over nor died.
        """
        try:
            with self._lock:
                self._listen()
        except SafetyStop:
            return False
        if self.took_over and process.SAFE not in self._messages:
            self._hears(process.SAFE, self._settle_s)
        return not self.took_over

    def end(self, confirmed: bool) -> None:
        """End the guardian. Never raises.

        Args:
            confirmed: Whether all servos have confirmed that their torque is off; if not, it tries for another 10 s.
        """
        if confirmed:
            with suppress(SafetyStop):
                self._send(process.LEAVE)
        self._channel.close(_SETTLE_TIMEOUT_S if confirmed else 0.0)

    def _now_s(self) -> float:
        return 1e-9 * self._channel.clock.now_ns()

    def _send(self, message: bytes) -> None:
        try:
            self._channel.send(message)
        except OSError as error:  # it has died, or does not read
            raise SafetyStop(_DEAD, hint="start again") from error

    def _listen(self, until_ns: int = 0) -> bool:
        """Read the guardian's messages, waiting until a time [ns]; return whether there were any.

        Raises:
            SafetyStop: It has died.
        """
        heard = False
        while (received := self._channel.receive(0 if heard else until_ns)) is not None:
            if not received:
                raise SafetyStop(_DEAD, hint="start again")
            heard = True
            self._messages += received
        return heard

    def _hears(self, message: bytes, timeout_s: float) -> bool:
        """Wait for a message; return False after the timeout, a report of failure, or the guardian's death."""
        end_ns = self._channel.clock.now_ns() + round(1e9 * timeout_s)
        with suppress(SafetyStop):
            while message not in self._messages and process.FAILED not in self._messages:
                if not self._listen(end_ns):
                    break
        return message in self._messages


class BusGuardian(Guardian):
    """A guardian of servos on a bus: it takes their torque off.

    It shares the open port and its lock, so that no other process gets the port before the torque is off.

    Args:
        off: The packet that takes the torque of all servos off.
        servos: For each servo, the packet that reads its torque register, and the answers that mean "off".
        silence_s: As in ``Guardian`` [s].
        answer_s: Longest wait for a servo's answer [s].
    """

    def __init__(
        self,
        port_fd: int,
        off: bytes,
        servos: Sequence[tuple[bytes, Sequence[bytes]]],
        silence_s: float,
        answer_s: float,
    ) -> None:
        # -I -S: neither the user's site packages nor the working directory may affect what runs there.
        program = ["-I", "-S", str(Path(process.__file__))]
        packets = [f"{query.hex()}:{','.join(a.hex() for a in answers)}" for query, answers in servos]
        arguments = [str(port_fd), repr(answer_s), off.hex(), *packets]
        super().__init__(lambda longest_s: Process(program, longest_s, arguments, (port_fd,)), silence_s)
