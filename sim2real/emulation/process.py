"""An emulated robot in a process of its own, in real time: the host's side starts and stops it, the other side runs it.

    python -m sim2real.emulation.process --emulation sim2real.emulation.dynamixel:EmulatorConfig \
        --plant my_robot/plant.py:Plant --truth truth.bin --sensing-latency-s 0.004

prints one line of JSON with the port when it is ready, and runs until SIGTERM.
"""

from __future__ import annotations

import argparse
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
from collections.abc import Mapping, Sequence
from dataclasses import Field, asdict, fields, is_dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, ClassVar, Final, Protocol, Self, cast

from sim2real.emulation.bus import BusEmulation, PlannedBus
from sim2real.emulation.faults import truth_header
from sim2real.emulation.plant import load_plant
from sim2real.emulation.truth import Truth, TruthLog, read_truth
from sim2real.errors import HardwareLost, Sim2RealError, UsageError
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.registry import load_named

if TYPE_CHECKING:
    from types import FrameType

_LOGGER = logging.getLogger(__name__)
_START_TIMEOUT_S: Final = 20.0
_STOP_TIMEOUT_S: Final = 3.0
_IDLE_NS: Final = 2_000_000  # longest time without stepping the plant: catching up with more would delay answers
_PR_SET_TIMERSLACK: Final = 29
_TIMER_SLACK_NS: Final = 1_000
_REAL_TIME_PRIORITY: Final = 2  # above the threads of the controlling process, which have 1: a servo does not wait
_NOT_SET: Final = termios.B50  # until a host sets a rate; no servo has this one
_SPEEDS: Final = {r: getattr(termios, f"B{r}", -1) for r in (38_400, 57_600, 115_200, 500_000, 1_000_000, 2_000_000)}
_TYPES: Final = {"int": int, "float": float, "bool": {"True": True, "False": False}.__getitem__}


class Emulated(Protocol):
    """Settings of an emulated robot: a dataclass whose fields become flags of its process.

    Attributes:
        serve: ``module:function`` that emulates the robot: called with the options of the command line, these settings
            and a `StopFlag`, it returns when the flag is set.
        actuation_latency_s: Time from a command to its effect [s].
        actuation_jitter_s: Half-width of the variation of that time [s].
    """

    __dataclass_fields__: ClassVar[dict[str, Field]]
    serve: ClassVar[str]
    if TYPE_CHECKING:

        @property
        def seed(self) -> int: ...
        @property
        def actuation_latency_s(self) -> float: ...
        @property
        def actuation_jitter_s(self) -> float: ...


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
        config: Emulated,
        plant_args: Mapping[str, Any] | None = None,
        truth_path: Path | str | None = None,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sim2real-robot-")
        folder = Path(self._folder.name)
        self.truth_path = Path(truth_path) if truth_path is not None else folder / "truth.bin"
        self.truth_path.parent.mkdir(parents=True, exist_ok=True)
        self._messages_path = folder / "messages.txt"
        # The settings become flags. -P: files in the user's working directory must not be imported as modules.
        command = [sys.executable, "-P", "-m", "sim2real.emulation.process", "--until-stdin-closes", "--plant", plant]
        command += ["--emulation", f"{type(config).__module__}:{type(config).__qualname__}"]
        command += ["--truth", str(self.truth_path), "--plant-args", json.dumps(dict(plant_args or {}))]
        for name, value in asdict(config).items():
            if value is not None:
                command.append(f"--{name.replace('_', '-')}={value!r}")
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
        """Return the running robot."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop it."""
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


class _Pty:
    """A raw pseudo-terminal: the host opens `port`, the emulator has the other end.

    The host's end is kept open here too, so that hosts may open and close it.
    """

    def __init__(self) -> None:
        self.fd, self._host_fd = os.openpty()
        tty.setraw(self._host_fd)
        settings = termios.tcgetattr(self._host_fd)
        settings[4:6] = [_NOT_SET, _NOT_SET]
        termios.tcsetattr(self._host_fd, termios.TCSANOW, settings)
        os.set_blocking(self.fd, False)
        self.port = os.ttyname(self._host_fd)

    def unplug(self) -> None:
        """Take the port away: the host's reads and writes fail from now on."""
        if self.fd >= 0:
            os.close(self._host_fd)
            os.close(self.fd)
            self.fd = -1

    def send(self, answer: bytes) -> bool:
        """Send bytes to the host; return False if the buffer is full or the port is gone."""
        if self.fd < 0:
            return False
        try:
            return os.write(self.fd, answer) == len(answer)
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


class StopFlag:
    """A flag that SIGTERM and SIGINT set, and the time of SIGUSR1, from which times of faults count."""

    def __init__(self) -> None:
        self.is_set = False
        self.faulty_ns: int | None = None
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._set)
        signal.signal(signal.SIGUSR1, self._begin_faults)

    def _set(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.is_set = True

    def _begin_faults(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.faulty_ns = time.monotonic_ns()


def _serve(bus: PlannedBus, pty: _Pty, truth: TruthLog, stop: StopFlag, parent_fd: int | None) -> None:
    """Run the bus until `stop` is set; with `parent_fd`, also until the other end of that pipe is closed."""
    inputs = [pty.fd] if parent_fd is None else [pty.fd, parent_fd]
    while not stop.is_set:
        # Sleep until bytes arrive or the next event is due.
        now_ns = time.monotonic_ns()
        wake_ns = now_ns + _IDLE_NS
        due_ns = bus.next_due_ns()
        if due_ns is not None:
            wake_ns = min(wake_ns, due_ns)
        ready = select.select(inputs, [], [], max(0, wake_ns - now_ns) * 1e-9)[0]
        # Faults that a signal or the settings start.
        now_ns = time.monotonic_ns()
        if stop.faulty_ns is not None:
            bus.begin_faults(stop.faulty_ns)
            stop.faulty_ns = None
        if pty.fd >= 0 and bus.unplugged(now_ns):
            inputs.remove(pty.fd)
            pty.unplug()
        # Pass the bytes on, then compute all events up to now.
        if pty.fd in ready:
            bus.feed(pty.receive(bus.baud_rate), now_ns)
        if parent_fd in ready and not os.read(parent_fd, 1024):
            return
        bus.run_until(now_ns)
        truth.flush_if_due(now_ns)


def keep_time() -> None:
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


def _parser(arguments: Sequence[str] | None) -> argparse.ArgumentParser:
    """Return the parser of the command line, with a flag for each setting of the named emulation."""
    parser = argparse.ArgumentParser(prog="python -m sim2real.emulation.process", description=__doc__, add_help=False)
    place = "MODULE_OR_FILE:NAME"
    parser.add_argument(
        "--emulation", required=True, metavar=place, help="the class of the settings, which makes the bus"
    )
    # The class of the settings decides the other flags.
    named = parser.parse_known_args(arguments)[0]
    settings = load_named(named.emulation, "emulation")
    if not (isinstance(settings, type) and is_dataclass(settings) and hasattr(settings, "serve")):
        raise UsageError(f"emulation {named.emulation!r} is not a class of settings of an emulated robot")
    parser.set_defaults(settings=settings)
    parser.add_argument("-h", "--help", action="help")
    parser.add_argument("--plant", required=True, metavar=place, help="the callable that returns the plant")
    parser.add_argument("--plant-args", default="{}", metavar="JSON", help="keyword arguments of --plant")
    parser.add_argument(
        "--truth", type=Path, required=True, metavar="FILE", help="the log of true states and latencies"
    )
    parser.add_argument(
        "--until-stdin-closes", action="store_true", help="also stop when stdin ends, as when the parent dies"
    )
    # One flag for each setting.
    for field in fields(settings):
        flag = f"--{field.name.replace('_', '-')}"
        parser.add_argument(flag, type=_TYPES[str(field.type).split()[0]], default=field.default)
    return parser


def plant_arguments(text: str) -> dict[str, Any]:
    """Return the keyword arguments of --plant-args; UsageError if they are no JSON object."""
    try:
        arguments = json.loads(text)
    except json.JSONDecodeError as error:
        raise UsageError(f"--plant-args is no JSON: {error}") from error
    if not isinstance(arguments, dict):
        raise UsageError(f"--plant-args must be a JSON object, not {text}")
    return arguments


def serve_bus(options: argparse.Namespace, config: BusEmulation, stop: StopFlag) -> None:
    """Emulate servos behind a pseudo-terminal until the flag is set."""
    plant = load_plant(options.plant, plant_arguments(options.plant_args))
    pty = _Pty()
    keep_time()
    start_ns = time.monotonic_ns()
    truth = TruthLog(options.truth, truth_header(plant, config, start_ns))
    # Report the port to the parent, and serve until the end.
    try:
        bus = config.bus(plant, truth, pty.send, start_ns)
        ready = {"port": pty.port, "pid": os.getpid(), "truth": str(options.truth.resolve())}
        print(json.dumps(ready), flush=True)
        _serve(bus, pty, truth, stop, sys.stdin.fileno() if options.until_stdin_closes else None)
    finally:
        truth.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of an emulated robot; return its exit code."""
    try:
        options = _parser(arguments).parse_args(arguments)
        config = options.settings(**{field.name: getattr(options, field.name) for field in fields(options.settings)})
        load_named(config.serve, "emulation")(options, config, StopFlag())
    except Sim2RealError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
