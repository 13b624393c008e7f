"""Shared code of emulated robots, on a bus or over DDS: latencies, faults, virtual time, and the log of true states.

A robot is emulated in this process and in virtual time: no thread, no waiting, every time exact. The robot is the clock
of the program that drives it. Time passes while the host waits for an answer or sleeps, event by event; it stands still
while the host computes. The guardian is the code of the guardian's process, called in this one: it acts when it is due,
and then the host goes on.
"""

from __future__ import annotations

import math
import tempfile
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Final, Generic, Self, TypeVar

from sim2real.emulation.truth import Truth, TruthLog, read_truth
from sim2real.errors import UsageError
from sim2real.hardware.clock import Clock
from sim2real.hardware.safety.guardian import Guard, Motors

NUMBERS: Final = count()


@dataclass(frozen=True)
class Emulation:
    """Settings of an emulated robot; times of faults count from its start.

    Args:
        sensing_latency_s: Age of a measurement when it is asked for, or when a state is sent [s].
        actuation_latency_s: Time from a command to its effect on the motors [s].
        actuation_jitter_s: Half-width of the uniform variation of ``actuation_latency_s`` [s]; at most the latency.
            Commands take effect in the order in which they were sent.
        reply_loss: Probability that an answer, or a state, is lost.
        corrupt: Probability that an answer, or a state, has a wrong checksum.
        late: Probability that an answer, or a state, is late, as through a USB adapter; later ones wait for it.
        late_s: Delay of a late answer or state [s].
        silent_after_s: Time from which nothing is received or sent, as with an unplugged cable [s]; None: never.
        lets_go_after_s: Time from which the motor `lets_go` has no torque, although it reports torque on, as with a
            broken gear [s]; None: never.
        lets_go: The motor that fails: a servo's id, or its place in the messages.
        seed: Seed of jitter, noise and faults.
    """

    sensing_latency_s: float = 0.0
    actuation_latency_s: float = 0.0
    actuation_jitter_s: float = 0.0
    reply_loss: float = 0.0
    corrupt: float = 0.0
    late: float = 0.0
    late_s: float = 0.009
    silent_after_s: float | None = None
    lets_go_after_s: float | None = None
    lets_go: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        self.require({name: (0.0, 1.0) for name in ("reply_loss", "corrupt", "late", "late_s")})
        self.require({"actuation_jitter_s": (0.0, self.actuation_latency_s)})
        for name, value in asdict(self).items():
            is_size = name.endswith("_s") or "noise" in name
            if is_size and value is not None and value < 0:
                raise UsageError(f"emulator: {name} = {value} is below 0")

    def planned(self, physics: Any, truth: TruthLog, send: Callable[[Any], Any]) -> PlannedRobot[Any]:
        """Return a robot with these settings and a plant or body, without port and clock.

        Args:
            send: Delivers the bytes of an answer, or a state, to the host; returns False if the host cannot take it.
        """
        raise NotImplementedError

    def robot(self, physics: Any, truth_path: Path | None) -> VirtualTime:
        """Return a running robot in virtual time.

        Args:
            truth_path: The file of true states and latencies; None: a temporary file.
        """
        raise NotImplementedError

    def require(self, ranges: dict[str, tuple[float, float]]) -> None:
        """Raise UsageError for a setting outside of its range."""
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"emulator: {name} = {getattr(self, name)} is outside [{low}, {high}]")


def truth_header(physics: Any, config: Emulation) -> dict[str, Any]:
    """Return the header of a truth file: settings, and names and parameters of a plant or a body."""
    facts = {"servo_ids": list(getattr(physics, "servo_ids", ())), "state_names": list(physics.state())}
    return {"config": asdict(config), **facts, "truth": physics.truth()}


C = TypeVar("C", bound=Emulation)


class PlannedRobot(ABC, Generic[C]):
    """An emulated robot without port and clock: all events follow from the times at which commands arrive [ns].

    Attributes:
        config: The settings; they may change while it runs.
        faulty_ns: Time from which the times of faults count [ns].
    """

    def __init__(self, config: C, truth: TruthLog) -> None:
        self.config, self.truth, self.faulty_ns = config, truth, 0

    @abstractmethod
    def next_due_ns(self) -> int | None:
        """Return the time of the next event; None if there is none."""

    @abstractmethod
    def run_until(self, t_ns: int) -> None:
        """Process all events up to a time, in order."""

    def begin_faults(self, t_ns: int) -> None:
        """Let the times of faults count from a time [ns]."""
        self.faulty_ns = t_ns

    def has(self, after_s: float | None, t_ns: int) -> bool:
        """Return whether a fault that begins after a time [s] has begun; None: never."""
        return after_s is not None and t_ns - self.faulty_ns >= 1e9 * after_s

    def is_silent(self, t_ns: int) -> bool:
        """Return whether nothing is received or sent at a time."""
        return self.has(self.config.silent_after_s, t_ns)


class VirtualTime:
    """An emulated robot as a clock, with its guardian, and with ways in which its host can die.

    Attributes:
        port: Address of the robot.
        clock: This object.
        planned: The robot without clock.
        reports: Messages of the guardian to a person.
        guardian_lives: Whether the guardian's process lives.
        host_lives: Whether the host's process lives.
    """

    port: str

    def __init__(self, physics: Any, config: Emulation, truth_path: Path | None, send: Callable[[Any], Any]) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="sim2real-robot-")
        self.truth_path = Path(self._folder.name) / "truth.bin" if truth_path is None else truth_path
        self.clock: Clock = self
        self.reports: list[str] = []
        self.guardian_lives = self.host_lives = True
        self._now_ns = 0
        # Repeated calls: function, period [ns], time of the next call [ns].
        self._watchers: dict[threading.Event, list[Any]] = {}
        self._calling = False
        self._guard: Guard | None = None
        self._log = TruthLog(self.truth_path, truth_header(physics, config))
        self.planned = config.planned(physics, self._log, send)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def strike(self, **faults: Any) -> None:
        """Let faults begin, or end, now; ``faults`` are fields of the settings."""
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
        """Pass messages of the host to the guardian, which acts on them at once; empty: the host has died."""
        if self._guard is not None and self.guardian_lives:
            self._guard_acts(lambda guard: guard.hear(messages))

    def stop(self) -> None:
        """End the robot and complete its truth. May be called twice."""
        self._log.close()

    def truth(self) -> Truth:
        """Return the truth; this ends the robot."""
        self.stop()
        return read_truth(self.truth_path)

    def now_ns(self) -> int:
        return self._now_ns

    def sleep(self, duration_s: float) -> None:
        """Let time pass [s], with the calls that are to be repeated."""
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
        """Call a function after each period, while time passes, until ``done`` is set."""
        del name
        self._watchers[done] = [call, round(1e9 * period_s), self._now_ns]

    def watch(self, guard: Guard | None) -> None:
        """Let a guardian watch the host from now on; None: no guardian."""
        self._guard = guard

    def _pass(self, until_ns: int, arrived: Callable[[], object] = lambda: False) -> None:
        """Let time pass, event by event, until a time [ns] or until ``arrived`` is true."""
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
        """Call a method of the guardian; until it returns, the guardian does nothing else, though time passes."""
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
        """Return messages; None without messages, as the guardian answers at once or never."""
        del until_ns
        if not self._robot.guardian_lives:
            return b""
        messages, self._messages = self._messages, b""
        return messages or None

    def close(self, wait_s: float) -> None:
        if not wait_s:  # the host leaves without a message, as if it had died
            self._robot.guardian_hears(b"")
        self._robot.watch(None)
