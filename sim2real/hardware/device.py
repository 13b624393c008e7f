"""The contract of a device: motors that can be measured and commanded, over any connection.

`sim2real.hardware.safety.rig.Rig` puts the safety gate in front of any device; `sim2real.emulation.conformance` tests
one.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from types import MappingProxyType
from typing import Final, Literal, Self, TypeAlias

import numpy as np

from sim2real.hardware.clock import SYSTEM_CLOCK, Clock


@dataclass(frozen=True)
class Transaction:
    """The times of one instruction with its answer and its retries.

    Args:
        t_sent_ns: Time at which the instruction was sent, in its last attempt, CLOCK_MONOTONIC [ns].
        lock_wait_ns: Time of waiting for another thread to release the bus [ns].
        transfer_ns: Time from getting the bus to having the answer, retries included [ns].
        late_ns: Delay of the answer beyond the time of its bytes on the wire [ns].
    """

    t_sent_ns: int
    lock_wait_ns: int
    transfer_ns: int
    retries: int
    late_ns: int = 0


@dataclass(frozen=True)
class ReadingPart:
    """A further part of a reading, such as the gyro's rates.

    Args:
        shape: Shape of its values; () is one number.
        low: Lowest value that is possible; a lower one stops the robot.
        high: Highest value that is possible.
        norm: Lowest and highest possible norm of the values, such as of a quaternion; None: any.
    """

    unit: str
    shape: tuple[int, ...] = ()
    low: float = -math.inf
    high: float = math.inf
    norm: tuple[float, float] | None = None


@dataclass(frozen=True)
class Reading:
    """A measurement of n motors, in the order of the device's `motors`.

    Args:
        position_rad: Shape (n,) [rad], from the zero of the device's settings.
        velocity_rad_s: Shape (n,) [rad/s].
        load: Shape (n,), in the device's `load_unit`; NaN if it does not measure a load.
        transaction: The times of the instruction and its answer. If the device sends its state without a request,
            `t_sent_ns` is the time of the sample.
        parts: Name -> values of the other parts, as the device's `parts` declares them.
        tick: The device's number of the sample, if it sends its state without a request: two readings with one tick are
            one sample. None: each reading is a sample of its own.
    """

    position_rad: np.ndarray
    velocity_rad_s: np.ndarray
    load: np.ndarray
    transaction: Transaction
    parts: Mapping[str, np.ndarray] = field(default_factory=dict)
    tick: int | None = None


@dataclass(frozen=True)
class Counters:
    """Counts of the transactions of a device since it was opened.

    Args:
        transactions: Instructions that were answered, or needed no answer.
        late_replies: Answers after the timeout, or so late that the time of their sample is uncertain.
        late_s: Delay of each answer beyond the time of its bytes on the wire, shape (N,) [s].
    """

    transactions: int = 0
    lost_replies: int = 0
    retries: int = 0
    late_replies: int = 0
    late_s: np.ndarray = field(default_factory=lambda: np.zeros(0))


Stale: TypeAlias = Literal["zero", "hold"] | float
"""What replaces a stale command: zero, the last command again (``hold``), or this number."""


@dataclass(frozen=True)
class CommandColumn:
    """One number for each motor, in a command that has several, such as the gain of a position controller."""

    name: str
    unit: str
    stale: Stale


@dataclass(frozen=True)
class CommandKind:
    """The quantity of a command.

    Args:
        name: Its name in messages, in the plural.
        unit: Its unit; "" if it has columns.
        stale: The safe replacement of a stale command; of each column if it has columns.
        columns: The k numbers for each motor, in order; none: one number, and commands have the shape (n,).
    """

    name: str
    unit: str
    stale: Stale | tuple[Stale, ...]
    columns: tuple[CommandColumn, ...] = ()

    @classmethod
    def of_columns(cls, name: str, *columns: CommandColumn) -> CommandKind:
        """Return the kind of a command of the shape (n, k)."""
        return cls(name, "", tuple(column.stale for column in columns), columns)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each column; one unit without columns."""
        return tuple(column.unit for column in self.columns) or (self.unit,)


VOLTAGE: Final = CommandKind("volts", "V", "zero")
POSITION: Final = CommandKind("positions", "rad", "hold")


class OperatingMode(IntEnum):
    """Mode of a motor; the numbers are those of DYNAMIXEL's register, with OFF for torque off."""

    OFF = 0
    VELOCITY = 1
    POSITION = 3
    PWM = 16


RESPONSE_S: Final = 0.2
"""Time in which every servo answers a small step [s]."""


@dataclass(frozen=True)
class Following:
    """Bounds on how far the joints of a sound robot deviate from their commands.

    Goals: ``response_s`` after a goal was sent, the joint has reached it, or moves towards it at ``speed_rad_s`` or
    faster. So the joint lies between the goals of the last ``response_s``, or on the way to them, shifted by
    ``weight``; it deviates from there by at most ``limit``.

    Torques, if ``most_nm`` is given: the load that a motor reports is weaker than the commanded torque ``tau + kp (q -
    position) + kd (dq - velocity)`` by at most ``limit``, on average over ``response_s``.

    Pushes, if ``push`` is given: over ``response_s``, a joint's acceleration falls short of the one due to its command
    by at most the share ``limit``.

    Attributes:
        limit: Largest deviation, one value or one per joint [rad, N m, or 1].
        speed_rad_s: One value or one per joint.
        source: Where the figures come from, for messages.
        weight: Returns for positions ``(n,)`` by how much weight and dry friction move each joint off its goal: the
            lowest and the highest value [rad]; None: ``limit`` includes them.
        most_nm: Largest torque of each motor, one value or one per joint; None: goals are compared.
        push: Returns for positions, velocities and commands ``(n,)`` three accelerations of each joint [rad/s^2]:
            without its command, due to its command, and the largest one due to dry friction.
        speeds: Returns for positions ``(n,)`` the speed of each joint towards smaller and towards larger angles, in
            place of ``speed_rad_s`` [rad/s].
        delay_s: Time from a command to the measurement that shows it, for pushes [s].
    """

    limit: float | Sequence[float] | np.ndarray
    response_s: float
    speed_rad_s: float | Sequence[float] | np.ndarray = 0.5
    source: str = "the servos' own figures"
    weight: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    most_nm: float | Sequence[float] | np.ndarray | None = None
    push: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]] | None = None
    speeds: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    delay_s: float = 0.0

    @property
    def unit(self) -> str:
        """Unit of `limit`."""
        return "1" if self.push is not None else "rad" if self.most_nm is None else "N m"


class Device(ABC):
    """Motors that are measured together and commanded together, with one kind of command from `open` to `close`.

    The constructor checks its settings and touches nothing; `open` connects, and leaves the torque off. Arrays of
    commands have shape (n,), or (n, k) if `commanded` has k columns, float64, in the order of `motors`. Every method
    may be called from any thread while the device is open, `make_safe` from a signal handler too.

    `disable`, `make_safe` and `close` bring the motors into the device's safe state. That is torque off, unless the
    robot would fall: the motors of legs damp their joints until the robot lies, and then go off.

    Methods raise HardwareLost when the device does not answer within its limits, and SafetyStop when a motor has
    stopped itself or the torque was taken off from outside.

    Attributes:
        motors: Names of the motors, for messages, e.g. ``servo 1``. All attributes but ``clock`` are valid before
            `open`.
        commanded: The quantity of a command.
        silence_s: Longest time without an instruction while torque is on; then the torque is taken off [s]; 0:
            unlimited.
        load_unit: Unit of a reading's load; by default the share of the largest load.
        parts: Name -> further part of a reading.
        clock: The clock of the readings' stamps and of the watchdogs; valid once the device is open.
    """

    motors: tuple[str, ...]
    commanded: CommandKind
    silence_s: float
    load_unit: str = "1"
    parts: Mapping[str, ReadingPart] = MappingProxyType({})
    clock: Clock = SYSTEM_CLOCK

    def __enter__(self) -> Self:
        """Open the device, with torque off."""
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the device."""
        self.close()

    # -- from open to close

    @abstractmethod
    def open(self) -> None:
        """Connect, check that every motor answers, take the torque off, and write the settings.

        Nothing stays open if it raises.

        Raises:
            HardwareLost: The port cannot be opened, a motor does not answer, or does not keep its settings.
        """

    @abstractmethod
    def without_host(self) -> tuple[str, ...]:
        """Return how the motors react when this process dies, as phrases: MODEL (MOTORS) goes on, ..."""

    def facts(self) -> Mapping[str, Mapping[str, str]]:
        """Return ``firmware``, ``voltage`` and ``temperature`` of each motor, as text, read from the open device.

        Logs and model cards contain them. Default: none, for a device that does not report them.
        """
        return {}

    @abstractmethod
    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest command that the motors follow, each of shape (n,) or (n, k).

        A gate with wider limits is refused, because a motor may ignore such a command without an error. Infinite: there
        is no limit, or `command` raises beyond it.
        """

    def following(self) -> Following | None:
        """Return bounds on how the motors follow their commands, from the settings of the open device.

        Default: None, not known: then no check notices a motor that has let go.
        """
        return None

    @abstractmethod
    def enable(self) -> np.ndarray:
        """Write the settings that motors lose without power, and switch the torque on; the motors stay at rest.

        First a guardian outside of this process starts: it takes the torque off when this process dies, or is silent
        for longer than `silence_s`.

        Returns:
            The command that the motors follow from now on, ``(n,)`` or ``(n, k)``.

        Raises:
            SafetyStop: `make_safe` was called before, or the torque has been taken off from outside.
            HardwareLost: A motor does not answer, or the guardian does not start.
        """

    @abstractmethod
    def measure(self) -> Reading:
        """Read all motors.

        A device that sends its state without a request returns the first sample taken after the call, so that the
        sample's time lies within the step that reads it.

        Raises:
            SafetyStop: A motor has stopped itself.
            HardwareLost: The device is silent.
        """

    @abstractmethod
    def command(self, values: np.ndarray) -> Transaction:
        """Send a command.

        Args:
            values: Shape (n,) [the unit of `commanded`], or (n, k).

        Raises:
            SafetyStop: A value is not finite or too large, or a motor has stopped itself.
            HardwareLost: The device is silent.
        """

    @abstractmethod
    def check(self) -> None:
        """Raise SafetyStop if a motor has stopped or lost its settings, where its answers do not report it.

        Called twice a second before a measurement, which it delays; does nothing if all answers report such errors.
        """

    def require_watching(self) -> None:  # noqa: B027
        """Raise SafetyStop if the guardian has taken over; does nothing without a guardian."""

    @property
    @abstractmethod
    def counters(self) -> Counters:
        """Counts of the transactions since `open`; zeros before `open`."""

    # -- the ways out

    @abstractmethod
    def disable(self) -> None:
        """Bring the motors into the safe state, then torque off, confirmed by every motor; `enable` may follow.

        If a motor does not confirm, the error is raised after all others were switched off. Until the next `enable` the
        device sends nothing that could move a motor, even if another thread has begun to.

        Raises:
            HardwareLost: A motor does not answer.
        """

    @abstractmethod
    def make_safe(self) -> None:
        """Begin the safe state at once, without a lock and without waiting for answers. Never raises.

        For signal handlers and watchdog threads: the interrupted code may hold any lock. The torque can be switched on
        again only after `close` and `open`.
        """

    @abstractmethod
    def close(self) -> None:
        """Bring the motors into the safe state and disconnect. Never raises; may be called twice, and before `open`."""
