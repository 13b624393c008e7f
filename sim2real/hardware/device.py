"""The contract of a device: motors that can be measured and commanded, whatever they are connected by.

`sim2real.hardware.safety.rig.Rig` puts the safety gate in front of any device; `sim2real.hardware.testing` tests one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, Literal, Self

import numpy as np


@dataclass(frozen=True)
class Transaction:
    """The times of one instruction with its answer and its retries.

    Args:
        t_sent_ns: When the instruction that was answered was sent, CLOCK_MONOTONIC [ns].
        lock_wait_ns: How long it waited for another thread's use of the bus [ns].
        transfer_ns: Time from getting the bus to having the answer, retries included [ns].
        retries: Number of times that the instruction was sent again.
        late_ns: How much longer the answer took than its bytes need on the wire [ns].
    """

    t_sent_ns: int
    lock_wait_ns: int
    transfer_ns: int
    retries: int
    late_ns: int = 0


@dataclass(frozen=True)
class Reading:
    """A measurement of n motors, in the order of the device's `motors`.

    Args:
        position_rad: Shape (n,) [rad]; where zero is, the device's settings say.
        velocity_rad_s: Shape (n,) [rad/s].
        load: Shape (n,), in the unit that the device's `measures` names; NaN if it does not name `load`.
        transaction: When it was asked for, and how late the answer came.
    """

    position_rad: np.ndarray
    velocity_rad_s: np.ndarray
    load: np.ndarray
    transaction: Transaction


@dataclass(frozen=True)
class Counters:
    """What went over a device's bus since it was opened.

    Args:
        transactions: Instructions that were answered, or needed no answer.
        lost_replies: Answers that were missing.
        retries: Instructions that were sent again.
        late_replies: Answers that came too late, or so late that the time of their sample is uncertain.
        late_s: How much longer each answer took than its bytes need on the wire, shape (N,) [s].
        withheld: Instructions that were not sent, as they could have moved a motor (dry runs).
    """

    transactions: int = 0
    lost_replies: int = 0
    retries: int = 0
    late_replies: int = 0
    late_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    withheld: int = 0


@dataclass(frozen=True)
class CommandKind:
    """What the numbers of a command are.

    Args:
        name: What they are called in messages, in the plural.
        stale: What is safe to send when no new command comes: zeros, or the last command once more.
    """

    name: str
    unit: str
    stale: Literal["zero", "hold"]


VOLTAGE: Final = CommandKind("volts", "V", "zero")
DUTY: Final = CommandKind("duties", "1", "zero")
POSITION: Final = CommandKind("positions", "rad", "hold")


class Alone(Enum):
    """What a motor does by itself when it hears nothing from its host any more."""

    TORQUE_OFF = "takes its torque off"
    STOPS = "stops"
    GOES_ON = "goes on as commanded last"


@dataclass(frozen=True)
class WithoutHost:
    """What motors do by themselves when their host dies; `str` says it in a sentence.

    Args:
        after_s: Time after the last instruction at which they notice [s]; inf: never.
        source: How that is known.
        why: A few words on why they never notice, or "".
    """

    model: str
    motors: tuple[str, ...]
    does: Alone
    after_s: float
    source: str
    why: str = ""

    @property
    def words(self) -> str:
        """What they do, in words without their names."""
        if self.does is Alone.TORQUE_OFF:
            return f"takes its torque off after {self.after_s:g} s"
        if self.does is Alone.STOPS:
            return f"stops after {self.after_s:g} s, torque stays on"
        if math.isfinite(self.after_s):
            return f"notices after {self.after_s:g} s, but {self.does.value}"
        return self.does.value + (f" ({self.why})" if self.why else "")

    def __str__(self) -> str:
        return f"{self.model} ({', '.join(self.motors)}) {self.words}"


class Device(ABC):
    """Motors that are measured together and commanded together, with one kind of command from `open` to `close`.

    The constructor checks its settings and touches nothing; `open` connects, and leaves the torque off. Arrays of
    commands have shape (n,), float64, in the order of `motors`. Every method may be called from any thread while the
    device is open, `make_safe` from a signal handler too.

    Whatever raises HardwareLost does so when the device does not answer within its limits; SafetyStop means that a
    motor has stopped itself, or that something has taken the torque off.
    """

    def __enter__(self) -> Self:
        """Open the device, with torque off."""
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the device."""
        self.close()

    # -- what it says about itself, before it is opened too

    @property
    @abstractmethod
    def motors(self) -> tuple[str, ...]:
        """Names of the motors, for messages, e.g. ``servo 1``."""

    @property
    @abstractmethod
    def commanded(self) -> CommandKind:
        """What the numbers of a command are."""

    @property
    @abstractmethod
    def silence_s(self) -> float:
        """Longest time without an instruction while torque is on, after which it is taken off [s]; 0: unlimited."""

    @property
    def measures(self) -> Mapping[str, str]:
        """Quantity -> unit of what a reading holds; ``position`` [rad] and ``velocity`` [rad/s] always."""
        return {"position": "rad", "velocity": "rad/s", "load": "1"}

    # -- from open to close

    @abstractmethod
    def open(self) -> None:
        """Connect, check that every motor answers, take the torque off, and write the settings.

        Nothing stays open if it raises.

        Raises:
            HardwareLost: The port cannot be opened, a motor does not answer, or does not keep its settings.
        """

    @abstractmethod
    def without_host(self) -> tuple[WithoutHost, ...]:
        """Return what the motors do by themselves when this process dies, each motor in one entry."""

    @abstractmethod
    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest command that the motors follow, each of shape (n,).

        A gate that lets more through is refused, as a motor may ignore such a command without a word. Infinite: there
        is no such limit, or `command` itself refuses what is beyond it.
        """

    @abstractmethod
    def withhold_torque(self) -> None:
        """Move nothing from now until the device is closed, for a dry run: all goes on as it would, with torque off.

        What could move a motor is not sent, and counted; something that takes as long is sent in its place.

        Raises:
            UsageError: Torque is on.
        """

    @property
    @abstractmethod
    def torque_withheld(self) -> bool:
        """Whether nothing can move a motor; see `withhold_torque`."""

    @abstractmethod
    def enable(self) -> None:
        """Write the settings that motors lose without power, and switch the torque on; the motors stay at rest.

        From before torque goes on, something outside this process watches that it lives: if it dies, or is silent for
        longer than `silence_s`, the torque is taken off.

        Raises:
            SafetyStop: `make_safe` was called before, or the torque has been taken off from outside.
            HardwareLost: A motor does not answer, or nothing would watch.
        """

    @abstractmethod
    def rest(self) -> np.ndarray:
        """Return the command that the motors follow right after `enable`, ``(n,)``."""

    @abstractmethod
    def measure(self) -> Reading:
        """Read all motors.

        Raises:
            SafetyStop: A motor has stopped itself.
            HardwareLost: The device is silent.
        """

    @abstractmethod
    def command(self, values: np.ndarray) -> Transaction:
        """Send a command; in a dry run, send something that moves nothing and takes as long.

        Args:
            values: Shape (n,) [the unit of `commanded`].

        Raises:
            SafetyStop: A value is not finite or too large, or a motor has stopped itself.
            HardwareLost: The device is silent.
        """

    @abstractmethod
    def effort(self, command: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
        """Return the share of full torque that motors apply, in [-1, 1], from command and positions, all ``(n,)``."""

    @abstractmethod
    def check(self) -> None:
        """Look for motors that have stopped or lost their settings and do not say so in their answers.

        Called twice a second, before a measurement, which it delays; nothing to do if all answers tell.

        Raises:
            SafetyStop: There is one.
        """

    def require_watching(self) -> None:  # noqa: B027
        """Raise SafetyStop if another process that watches this one has taken over; nothing to do where none does."""

    @property
    @abstractmethod
    def counters(self) -> Counters:
        """What went over the bus so far; all zero before `open`."""

    # -- the ways out

    @abstractmethod
    def disable(self) -> None:
        """Switch the torque off, confirmed by every motor; `enable` may follow.

        Raises:
            HardwareLost: A motor does not answer.
        """

    @abstractmethod
    def make_safe(self) -> None:
        """Take the torque off at once, without a lock and without waiting for answers. Never raises.

        For signal handlers and watchdog threads: the code that was interrupted may hold any lock. The torque cannot
        be switched on again before the device is opened anew.
        """

    @abstractmethod
    def close(self) -> None:
        """Take the torque off and disconnect. Never raises; may be called twice, and before `open`."""
