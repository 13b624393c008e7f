"""Latencies and faults that every emulated robot has, on a bus or over DDS, and when faults have begun."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from sim2real.errors import UsageError


@dataclass(frozen=True)
class Emulation:
    """Settings of an emulated robot; times of faults count from its start, or from a signal.

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
        on_signal: Whether these times count from SIGUSR1 to the process.
        seed: Seed of jitter, noise and chances.
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
    on_signal: bool = False
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


class FaultTimes:
    """When the faults of an emulated robot have begun.

    Attributes:
        faulty_ns: Time from which the times of faults count [ns]; None: the signal has not come.
    """

    def __init__(self, config: Emulation, start_ns: int) -> None:
        self.faulty_ns = None if config.on_signal else start_ns

    def has(self, after_s: float | None, t_ns: int) -> bool:
        """Return whether a fault that begins ``after_s`` [s] has begun at a time [ns]; None: it never does."""
        return after_s is not None and self.faulty_ns is not None and t_ns - self.faulty_ns >= 1e9 * after_s


class Physics(Protocol):
    """What the truth file needs of a plant or a body."""

    def state(self) -> dict[str, float]:
        """Return the true state."""
        ...

    def truth(self) -> Mapping[str, Any]:
        """Return the true parameters."""
        ...


def truth_header(physics: Physics, config: Emulation, start_ns: int) -> dict[str, Any]:
    """Return the header of a truth file; ``start_ns`` is time 0 of the physics."""
    facts = {"servo_ids": list(getattr(physics, "servo_ids", ())), "state_names": list(physics.state())}
    return {"start_ns": start_ns, "config": asdict(config), **facts, "truth": physics.truth()}
