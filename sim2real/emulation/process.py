"""An emulated robot in a process of its own, in real time: the host's side starts and stops it, the other side runs it.

    python -m sim2real.emulation.process '{"emulation": "sim2real.emulation.dynamixel:EmulatorConfig",
        "settings": {"sensing_latency_s": 0.004}, "plant": "my_robot/plant.py:Plant", "truth": "truth.bin"}'

prints one line of JSON with the port when it is ready, and runs until SIGTERM.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import logging
import os
import select
import signal
import subprocess
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, Protocol, Self, cast

from sim2real.emulation.bus import BusEmulation, PlannedBus
from sim2real.emulation.plant import load_plant
from sim2real.emulation.robot import Emulation, PlannedRobot, truth_header
from sim2real.emulation.truth import Truth, TruthLog, read_truth
from sim2real.errors import HardwareLost, Sim2RealError, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.registry import load_named

if TYPE_CHECKING:
    from types import FrameType

_LOGGER = logging.getLogger(__name__)
_START_TIMEOUT_S: Final = 20.0
_STOP_TIMEOUT_S: Final = 3.0
_PR_SET_TIMERSLACK: Final = 29
_TIMER_SLACK_NS: Final = 1_000
_REAL_TIME_PRIORITY: Final = 2  # above the threads of the controlling process, which have 1: a servo does not wait
_NOT_SET: Final = termios.B50  # until a host sets a rate; no servo has this one
_SPEEDS: Final = {r: getattr(termios, f"B{r}", -1) for r in (38_400, 57_600, 115_200, 500_000, 1_000_000, 2_000_000)}


class EmbeddedRobot:
    """Emulated servos on `port`, from construction until `stop` or any end of this process.

    The stages get only the port. The emulator logs true states and latencies to the truth file; `truth` and `reveal`
    read it.

    Attributes:
        clock: The clock that the host shares with the robot.

    Args:
        plant: `package.module:Name` or `path/to/file.py:Name`; see `load_plant`.
        plant_args: Keyword arguments for the plant: JSON-able.
        truth_path: The truth file; None: a temporary file, deleted by `stop`.

    Raises:
        HardwareLost: The emulator did not start; its own message is included.
    """

    clock: Clock = SYSTEM_CLOCK

    def __init__(
        self,
        plant: str,
        config: Emulation,
        plant_args: Mapping[str, Any] | None = None,
        truth_path: Path | str | None = None,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sim2real-robot-")
        folder = Path(self._folder.name)
        self.truth_path = Path(truth_path) if truth_path is not None else folder / "truth.bin"
        self.truth_path.parent.mkdir(parents=True, exist_ok=True)
        self._messages_path = folder / "messages.txt"
        task = {
            "emulation": f"{type(config).__module__}:{type(config).__qualname__}",
            "settings": asdict(config),
            "plant": plant,
            "plant_args": dict(plant_args or {}),
            "truth": str(self.truth_path),
            "until_stdin_closes": True,
        }
        # -P: files in the user's working directory must not be imported as modules.
        command = [sys.executable, "-P", "-m", "sim2real.emulation.process", json.dumps(task)]
        with self._messages_path.open("wb") as messages:
            # In a new session, so that Ctrl-C in a terminal reaches only the host, which then stops the robot.
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=messages, start_new_session=True
            )
        # The emulator prints the port when it is ready.
        ready = self._wait_until_ready()
        self.port: str = ready["port"]
        self.pid: int = ready["pid"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        """Whether the emulator's process is alive."""
        return self._process.poll() is None

    def stop(self) -> None:
        """End the process, after which the truth file is complete. May be called twice."""
        if not self.running and self._process.returncode != 0 and self._messages_path.exists():
            # To the host, a plant that raised an exception looks like a lost bus; the reason is in its messages.
            _LOGGER.error("the emulated robot had died (%d): %s", self._process.returncode, self._messages())
        elif self.running:
            self._process.terminate()
            try:
                self._process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        self._folder.cleanup()

    def truth(self) -> Truth:
        """Read the truth file; while the robot runs, the last 0.25 s may be missing."""
        return read_truth(self.truth_path)

    def reveal(self) -> dict[str, Any]:
        """Return the plant's true parameters."""
        return self.truth().parameters

    def _wait_until_ready(self) -> dict[str, Any]:
        stdout = cast(IO[bytes], self._process.stdout)
        line = stdout.readline() if select.select([stdout], [], [], _START_TIMEOUT_S)[0] else b""
        if line:
            return json.loads(line)
        message = f"the emulated robot did not start: {self._messages()}"
        self.stop()
        raise HardwareLost(message)

    def _messages(self) -> str:
        """Return the process's messages on stderr."""
        return self._messages_path.read_text(errors="replace").strip() or "without a message"


class Connection(Protocol):
    """The robot's end of its connection to the host.

    Attributes:
        port: The host's address of it.
        inputs: File descriptors that become ready when the host has sent something.
        idle_ns: Longest time between two exchanges [ns].
    """

    port: str
    inputs: tuple[int, ...]
    idle_ns: int

    def exchange(self, robot: Any, now_ns: int, ready: list[int]) -> None:
        """Pass what the host has sent on to the robot; ``ready``: the inputs that are."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


class _Pty:
    """A raw pseudo-terminal: the host opens `port`, the emulator has the other end; a `Connection`.

    The host's end is kept open here too, so that hosts may open and close it.
    """

    idle_ns = 2_000_000  # without stepping the plant: catching up with more would delay answers

    def __init__(self) -> None:
        self.fd, self._host_fd = os.openpty()
        tty.setraw(self._host_fd)
        settings = termios.tcgetattr(self._host_fd)
        settings[4:6] = [_NOT_SET, _NOT_SET]
        termios.tcsetattr(self._host_fd, termios.TCSANOW, settings)
        os.set_blocking(self.fd, False)
        self.port, self.inputs = os.ttyname(self._host_fd), (self.fd,)

    def exchange(self, robot: PlannedBus[Any], now_ns: int, ready: list[int]) -> None:
        """Pass bytes on; take the port away when it is unplugged: the host's reads and writes fail from then on."""
        if self.inputs and robot.unplugged(now_ns):
            self.close()
        elif self.fd in ready:
            robot.feed(self.receive(robot.baud_rate), now_ns)

    def send(self, answer: bytes) -> bool:
        """Send bytes to the host; return False if the buffer is full or the port is gone."""
        try:
            return bool(self.inputs) and os.write(self.fd, answer) == len(answer)
        except BlockingIOError:
            return False

    def receive(self, baud_rate: int) -> bytes:
        """Return the bytes that the host has sent; none if it has set another baud rate."""
        try:
            data, speed = os.read(self.fd, 4096), termios.tcgetattr(self._host_fd)[4]
        except BlockingIOError:
            return b""
        # The operating system has one constant for all other rates.
        fits = speed in (_NOT_SET, _SPEEDS.get(baud_rate)) or (
            baud_rate not in _SPEEDS and speed not in _SPEEDS.values()
        )
        return data if fits else b""

    def close(self) -> None:
        if self.inputs:
            os.close(self._host_fd)
            os.close(self.fd)
            self.inputs = ()


class StopFlag:
    """A flag that SIGTERM and SIGINT set."""

    def __init__(self) -> None:
        self.is_set = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._set)

    def _set(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.is_set = True


@dataclass(frozen=True)
class Task:
    """What a process emulates.

    Attributes:
        emulation: ``MODULE_OR_FILE:NAME`` of the class of the settings.
        settings: Its fields.
        plant: ``MODULE_OR_FILE:NAME`` of the callable that returns the physics.
        plant_args: Its keyword arguments.
        truth: The file of true states and latencies.
        until_stdin_closes: Whether it also stops when stdin ends, as when the parent dies.
    """

    emulation: str
    plant: str
    truth: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    plant_args: Mapping[str, Any] = field(default_factory=dict)
    until_stdin_closes: bool = False


def serve(
    task: Task,
    config: Emulation,
    stop: StopFlag,
    connect: Callable[[], Any],
    make: Callable[[Any, TruthLog, int, Any], PlannedRobot[Any]],
) -> None:
    """Emulate a robot until the flag is set.

    Args:
        connect: Opens the `Connection`; its threads take no part in the real-time priority.
        make: Makes the robot from its physics, its truth, the time of its start [ns], and the connection.
    """
    physics, path = load_plant(task.plant, task.plant_args), Path(task.truth)
    connection: Connection = connect()
    _keep_time()
    start_ns = time.monotonic_ns()
    truth = TruthLog(path, truth_header(physics, config, start_ns))
    # Report the port to the parent, and serve until the end.
    try:
        robot = make(physics, truth, start_ns, connection)
        ready = {"port": connection.port, "pid": os.getpid(), "truth": str(path.resolve())}
        print(json.dumps(ready), flush=True)
        _run(robot, connection, truth, stop, [sys.stdin.fileno()] if task.until_stdin_closes else [])
    finally:
        truth.close()
        connection.close()


def serve_bus(task: Task, config: BusEmulation, stop: StopFlag) -> None:
    """Emulate servos behind a pseudo-terminal until the flag is set."""
    make = config.bus_type
    serve(task, config, stop, _Pty, lambda plant, truth, ns, pty: make(plant, config, truth, pty.send, ns))


def _run(
    robot: PlannedRobot[Any], connection: Connection, truth: TruthLog, stop: StopFlag, parent_fds: list[int]
) -> None:
    """Run the robot until ``stop`` is set, or the other end of the parent's pipe is closed."""
    while not stop.is_set:
        # Sleep until the host has sent something, or the next event is due.
        now_ns = time.monotonic_ns()
        due_ns, wake_ns = robot.next_due_ns(), now_ns + connection.idle_ns
        wake_ns = wake_ns if due_ns is None else min(wake_ns, due_ns)
        inputs = [*connection.inputs, *parent_fds]
        ready = select.select(inputs, [], [], max(0, wake_ns - now_ns) * 1e-9)[0]
        now_ns = time.monotonic_ns()
        # Pass on what was sent, then compute all events up to now.
        connection.exchange(robot, now_ns, ready)
        if any(fd in ready and not os.read(fd, 1024) for fd in parent_fds):
            return
        robot.run_until(now_ns)
        truth.flush_if_due(now_ns)


def _keep_time() -> None:
    """Reduce the lateness of this process as far as the operating system allows."""
    # Sleeps end within about 1 us of the requested time, instead of 50 us.
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, _TIMER_SLACK_NS, 0, 0, 0)
    # Real-time priority, if allowed: on a busy CPU, answers were up to 0.1 ms late with it and up to 4 ms without.
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_REAL_TIME_PRIORITY))
    # The loop makes no reference cycles; a garbage collection would only delay answers.
    gc.collect()
    gc.disable()


def main(arguments: Sequence[str]) -> int:
    """Emulate the robot of a task, which is JSON; return the exit code."""
    try:
        try:
            task = Task(**json.loads(arguments[0]))
        except (IndexError, TypeError, ValueError) as error:
            raise UsageError(f"the task is no JSON object with the fields of Task: {error}") from error
        kind = load_named(task.emulation, "emulation")
        if not (isinstance(kind, type) and issubclass(kind, Emulation)):
            raise UsageError(f"emulation {task.emulation!r} is not a class of settings of an emulated robot")
        config = kind(**task.settings)
        load_named(config.serve, "emulation")(task, config, StopFlag())
    except Sim2RealError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
