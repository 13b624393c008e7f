"""Emulated robots in this process and in virtual time: no thread, no waiting, every instant exact.

A `VirtualRobot` is the robot behind an address, the port of whoever opens that address, and the clock of both. Time
goes on while the host waits for an answer or sleeps, event by event; it stands still while the host computes. The
guardian is the guardian process's own code, without the process: it acts when it is due, and the host goes on when it
has acted.
"""

from __future__ import annotations

import math
import tempfile
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, Final, Self

from sim2real.emulation.bus import BusEmulation
from sim2real.emulation.plant import Plant, load_plant
from sim2real.emulation.robot import Emulation, Physics, PlannedRobot, truth_header
from sim2real.emulation.truth import Truth, TruthLog, read_truth
from sim2real.errors import HardwareLost
from sim2real.hardware.bus.port import CUT, EMULATED, Port, Queries, take_torque_off
from sim2real.hardware.clock import Clock
from sim2real.hardware.safety.guardian import Guard, Guardian, Motors

NUMBERS: Final = count()


class VirtualTime(ABC):
    """The clock of an emulated robot, its guardian, and the ends of its host.

    Attributes:
        port: Its address.
        clock: The robot itself.
        planned: The robot in planned time.
        reports: What the guardian told a person.
        guardian_lives: False: the guardian's process has died.
        host_lives: False: the host's process has died.
    """

    port: str

    def __init__(self, physics: Physics, config: Emulation, truth_path: Path | None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sim2real-robot-")
        self.truth_path = Path(self._folder.name) / "truth.bin" if truth_path is None else truth_path
        self.clock: Clock = self
        self.reports: list[str] = []
        self.guardian_lives = self.host_lives = True
        self._now_ns = 0
        self._watchers: dict[threading.Event, list[Any]] = {}  # what is called, its period [ns], when it is due [ns]
        self._calling = False
        self._guard: Guard | None = None
        self._log = TruthLog(self.truth_path, truth_header(physics, config, 0))
        self.planned = self.make(physics, config, self._log)

    @abstractmethod
    def make(self, physics: Any, config: Any, log: TruthLog) -> PlannedRobot[Any]:
        """Return the robot in planned time."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def strike(self, **faults: Any) -> None:
        """Let faults begin, or end, now; named as the fields of the settings."""
        self.planned.config = replace(self.planned.config, **faults)
        self.planned.begin_faults(self._now_ns)

    def stall(self, duration_s: float) -> None:
        """Stop the host's process for a time [s], with all its threads."""
        self._pass(self._now_ns + round(1e9 * duration_s))

    def kill_host(self) -> None:
        """Let the host's process die: its connections to the robot and to the guardian are closed."""
        self.host_lives = False
        self._watchers.clear()
        self.guardian_hears(b"")

    def guardian_hears(self, messages: bytes) -> None:
        """Pass messages of the host to the guardian, which acts on them at once; none: the host has died."""
        if self._guard is not None and self.guardian_lives:
            self._guard_acts(lambda guard: guard.hear(messages))

    def stop(self) -> None:
        """End the robot, after which its truth is complete. May be called twice."""
        self._log.close()

    def truth(self) -> Truth:
        """Return the truth; this ends the robot."""
        self.stop()
        return read_truth(self.truth_path)

    def now_ns(self) -> int:
        return self._now_ns

    def sleep(self, duration_s: float) -> None:
        """Let time pass [s]; what is repeated is called meanwhile."""
        end_ns = self._now_ns + round(1e9 * duration_s)
        while True:
            for done in [done for done in self._watchers if done.is_set()]:
                del self._watchers[done]
            due = None if self._calling else min(self._watchers.values(), key=lambda row: row[2], default=None)
            if due is None or due[2] > end_ns:
                break
            self._pass(due[2])
            due[2] = max(due[2], self._now_ns) + due[1]
            self._calling = True
            try:
                due[0]()
            finally:
                self._calling = False
        self._pass(end_ns)

    def repeat(self, call: Callable[[], None], period_s: float, done: threading.Event, name: str) -> None:
        """Call a function in every `sleep`, from now on after each period, until ``done`` is set."""
        del name
        self._watchers[done] = [call, round(1e9 * period_s), self._now_ns]

    def watch(self, guard: Guard | None) -> None:
        """Let a guardian watch the host from now on, or none."""
        self._guard = guard

    def _pass(self, until_ns: int, arrived: Callable[[], object] = lambda: False) -> None:
        """Let time pass, event by event, to a time [ns] or until something has arrived."""
        while not arrived():
            due = (t for t in (self.planned.next_due_ns(), self._guard_due_ns()) if t is not None)
            self._now_ns = max(self._now_ns, min(min(due, default=until_ns), until_ns))
            self.planned.run_until(self._now_ns)
            guard_ns = self._guard_due_ns()
            if self._guard is not None and guard_ns is not None and guard_ns <= self._now_ns:
                self._guard_acts(lambda guard: guard.look())
            if self._now_ns >= until_ns:
                return

    def _guard_acts(self, act: Callable[[Guard], object]) -> None:
        """Let the guardian do one thing; it hears and sees nothing else until that is done, though time passes."""
        guard, self._guard = self._guard, None
        assert guard is not None
        try:
            act(guard)
        finally:
            self._guard = guard

    def _guard_due_ns(self) -> int | None:
        due_s = None if self._guard is None or not self.guardian_lives else self._guard.due_s()
        return None if due_s is None else math.ceil(1e9 * due_s) + 1


class VirtualChannel:
    """The host's end of the connection to a guardian in virtual time; a `Channel`."""

    pid = 0

    def __init__(self, robot: VirtualTime, motors: Motors, longest_s: float) -> None:
        self.clock: Clock = robot
        self._robot, self._messages = robot, b""
        robot.watch(Guard(motors, longest_s, self._say, robot.reports.append))

    def _say(self, message: bytes) -> None:
        self._messages += message

    def send(self, message: bytes) -> None:
        if not self._robot.guardian_lives:
            raise BrokenPipeError("the guardian has died")
        self._robot.guardian_hears(message)

    def receive(self, until_ns: int) -> bytes | None:
        """Return messages; None if there are none: the guardian answers at once, or never."""
        del until_ns
        if not self._robot.guardian_lives:
            return b""
        messages, self._messages = self._messages, b""
        return messages or None

    def close(self, wait_s: float) -> None:
        if not wait_s:  # the host leaves without a word: as if it had died
            self._robot.guardian_hears(b"")
        self._robot.watch(None)


class VirtualRobot(VirtualTime):
    """Emulated servos at `port`, from construction until `stop`; see `EmbeddedRobot` for the arguments.

    Attributes:
        port: The address, which `open_port` knows.
        bus: The emulated bus.
    """

    def __init__(
        self,
        plant: str | Plant,
        config: BusEmulation,
        plant_args: Mapping[str, Any] | None = None,
        truth_path: Path | None = None,
    ) -> None:
        self.plant = load_plant(plant, dict(plant_args or {})) if isinstance(plant, str) else plant
        super().__init__(self.plant, config, truth_path)
        self._baud_rate: int | None = None  # None: no host has opened the port
        self._inbox: list[bytes] = []
        self.bus: Any = self.planned
        self.port = f"virtual:{next(NUMBERS)}"
        EMULATED[self.port] = self._open

    def make(self, physics: Plant, config: BusEmulation, log: TruthLog) -> PlannedRobot[Any]:
        return config.bus_type(physics, config, log, self._take, 0, self.now_ns)

    def stop(self) -> None:
        EMULATED.pop(self.port, None)
        super().stop()

    # The port

    def _open(self, baud_rate: int) -> Port:
        if self._baud_rate is not None or self.bus.unplugged(self._now_ns):
            raise HardwareLost(f"the port {self.port} cannot be opened: it is in use, or gone")
        self._baud_rate = baud_rate
        return self

    def write(self, data: bytes) -> None:
        self._require_port()
        if self._baud_rate == self.bus.baud_rate:
            self.feed(data)

    def read(self, until_ns: int) -> bytes:
        self._require_port()
        data = self.take_until(until_ns)
        self._require_port()
        return data

    def flush(self) -> None:
        self._require_port()
        self._inbox.clear()

    def close(self) -> None:
        self._baud_rate = None
        self._inbox.clear()

    def guardian(self, off: bytes, servos: Queries, silence_s: float, answer_s: float) -> Guardian:
        line = _GuardLine(self)
        motors = Motors(lambda: take_torque_off(line, off, servos, answer_s), self, CUT)
        return Guardian(lambda longest_s: VirtualChannel(self, motors, longest_s), silence_s)

    def feed(self, data: bytes) -> None:
        """Send bytes to the servos, whoever has the port."""
        self._require_line()
        self.bus.feed(data, self._now_ns)
        self.bus.run_until(self._now_ns)

    def take_until(self, until_ns: int) -> bytes:
        """Return the bytes that have arrived; none if there are none until a time [ns]."""
        self._pass(until_ns, lambda: self._inbox)
        self._require_line()
        data = b"".join(self._inbox)
        self._inbox.clear()
        return data

    def _require_port(self) -> None:
        if self._baud_rate is None or not self.host_lives:
            raise OSError("the port is closed")
        self._require_line()

    def _require_line(self) -> None:
        if self.bus.unplugged(self._now_ns):
            raise OSError("the port is gone")

    def _take(self, answer: bytes) -> bool:
        self._inbox.append(answer)
        return True


class _GuardLine:
    """The port in virtual time, as the guardian's own code uses it; a `Line`."""

    def __init__(self, robot: VirtualRobot) -> None:
        self.clock: Clock = robot
        self._robot = robot

    def write(self, data: bytes) -> None:
        self._robot.feed(data)

    def read(self, until_ns: int) -> bytes:
        return self._robot.take_until(max(until_ns, self._robot.now_ns() + 1))  # time goes on
