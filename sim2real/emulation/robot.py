"""What every emulated robot has, on a bus or over DDS: latencies, faults, planned time, and the header of its truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from sim2real.emulation.truth import TruthLog
from sim2real.errors import UsageError


@dataclass(frozen=True)
class Emulation:
    """Settings of an emulated robot; times of faults count from its start.

    Args:
        sensing_latency_s: Age of a measurement when it is asked for, or when a state is sent [s].
        actuation_latency_s: Time from a command to its effect on the motors [s].
        actuation_jitter_s: Half-width of the uniform variation of that time [s]; at most the latency. Commands take
            effect in the order in which they were sent.
        reply_loss: Probability that an answer, or a state, is lost.
        corrupt: Probability that it has a wrong checksum.
        late: Probability that it is held up, as by a USB adapter; later ones wait for it.
        late_s: Time for which it is held up [s].
        silent_after_s: Time from which nothing is received or sent, as with an unplugged cable [s]; None: never.
        lets_go_after_s: Time from which the motor `lets_go` has no torque, though it reports torque on, as after
            a gear broke [s]; None: never.
        lets_go: That motor: a servo's id, or its place in the messages.
        seed: Seed of jitter, noise and chances.
    """

    serve: ClassVar[str]
    """``module:function`` that emulates the robot in a process: called with its `Task`, these
    settings and a `StopFlag`, it returns when the flag is set."""

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
            is_size = name.endswith(("_s", "_kd")) or "noise" in name
            if is_size and value is not None and value < 0:
                raise UsageError(f"emulator: {name} = {value} is below 0")

    def require(self, ranges: dict[str, tuple[float, float]]) -> None:
        """Raise UsageError for a setting outside of its range."""
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise UsageError(f"emulator: {name} = {getattr(self, name)} is outside [{low}, {high}]")


class Physics(Protocol):
    """What the truth file needs of a plant or a body."""

    def state(self) -> dict[str, float]:
        """Return the true state, with the same names at every call."""
        ...

    def truth(self) -> Mapping[str, Any]:
        """Return the true parameters, which an identification should find."""
        ...


def truth_header(physics: Physics, config: Emulation, start_ns: int) -> dict[str, Any]:
    """Return the header of a truth file; ``start_ns`` is time 0 of the physics."""
    facts = {"servo_ids": list(getattr(physics, "servo_ids", ())), "state_names": list(physics.state())}
    return {"start_ns": start_ns, "config": asdict(config), **facts, "truth": physics.truth()}


C = TypeVar("C", bound=Emulation)


class PlannedRobot(ABC, Generic[C]):
    """An emulated robot without process, port and threads. All times are CLOCK_MONOTONIC nanoseconds.

    The times of all events are computed from the times at which the host's commands arrive, and do not depend on how
    late the emulator's process runs.

    Attributes:
        config: The settings; they may change while it runs.
        faulty_ns: Time from which the times of faults count [ns].
    """

    def __init__(self, config: C, truth: TruthLog, start_ns: int) -> None:
        self.config, self.truth, self.start_ns = config, truth, start_ns
        self.faulty_ns = start_ns

    @abstractmethod
    def next_due_ns(self) -> int | None:
        """Return the time of the next event; None if there is none."""

    @abstractmethod
    def run_until(self, t_ns: int) -> None:
        """Process all events up to a time, in order."""

    def begin_faults(self, t_ns: int) -> None:
        """Count the times of faults from a time."""
        self.faulty_ns = t_ns

    def has(self, after_s: float | None, t_ns: int) -> bool:
        """Return whether a fault that begins ``after_s`` [s] has begun at a time; None: it never does."""
        return after_s is not None and t_ns - self.faulty_ns >= 1e9 * after_s

    def is_silent(self, t_ns: int) -> bool:
        """Return whether nothing is received or sent at a time."""
        return self.has(self.config.silent_after_s, t_ns)
