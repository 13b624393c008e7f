"""Following error: a joint that does not do what its commands say has let go, is blocked, slips, or reads wrongly."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from sim2real.errors import SafetyStop

RESPONSE_S: Final = 0.2
"""Time in which every servo answers a small step [s]."""
SLOW_RAD_S: Final = 0.5
"""Speed that every servo reaches on a longer way, also under load [rad/s]."""
MOST_SHARE: Final = 0.9
"""Share of its torque beyond which a servo that still does not reach its goal is stopped."""
_BEYOND_S: Final = 0.04
"""Time for which a joint must be beyond its limit before the robot is stopped [s]."""
_SAMPLES: Final = 3
"""Number of samples in a row that must be beyond the limit."""
_PARTS: Final = 10
"""Parts of the time between two measurements for which the command is looked up."""
_SLOW_RAD_S: Final = 0.5
_ENOUGH: Final = 1.0
"""Sum of the squares of a joint's changes of speed from which on they tell, against noise of 0.05 rad/s [rad^2/s^2]."""

Push: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
Speed: TypeAlias = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Following:
    """How the joints of a robot follow their commands, as far as that is certain.

    Goals: ``response_s`` after a goal was sent, the joint is there, or travels there at ``speed_rad_s`` or faster. So
    it lies between the goals of the last ``response_s``, or on the way to them, moved by ``weight``; it is away from
    there by at most ``limit``.

    Torques, if ``most_nm`` is given: the load that a motor reports is weaker than the torque of its law
    ``tau + kp (q - position) + kd (dq - velocity)`` by at most ``limit``, on average over ``response_s``.

    Pushes, if ``push`` is given: of the acceleration by its command a joint lacks at most the share ``limit``, in the
    motion of the last ``response_s``.

    Attributes:
        limit: Largest deviation, one value or one per joint [rad, N m, or 1].
        speed_rad_s: One value or one per joint.
        source: Where the figures come from, for messages.
        weight: Returns for positions ``(n,)`` by how much weight and dry friction move each joint off its goal, the
            lowest and the highest value [rad]; None: ``limit`` includes that.
        most_nm: Torque that each motor reaches, one value or one per joint; None: goals are compared.
        push: Returns for positions, velocities and commands ``(n,)`` the acceleration of each joint without its
            command, that by its command, and the largest one by dry friction [rad/s^2].
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
    push: Push | None = None
    speeds: Speed | None = None
    delay_s: float = 0.0

    @property
    def unit(self) -> str:
        """Unit of `limit`."""
        return "1" if self.push is not None else "rad" if self.most_nm is None else "N m"


class FollowingCheck:
    """Compares measurements with commands; see `Following`. Both may come from different threads.

    Args:
        start: Command that the joints follow at the start, ``(n,)`` [rad], or ``(n, 5)`` as in `Following`.
        t_s: Time of the start [s].
        name: Returns a joint's name for errors.
    """

    def __init__(self, following: Following, start: np.ndarray, t_s: float, name: Callable[[int], str]) -> None:
        self._following, self._name, n = following, name, len(start)
        self._limit = np.broadcast_to(np.asarray(following.limit, np.float64), n)
        both = np.broadcast_to(np.asarray(following.speed_rad_s, np.float64), n)
        self._speeds = following.speeds or (lambda _: (both, both))
        self._lock = threading.Lock()
        self._commands: list[tuple[float, np.ndarray]] = [(t_s, np.array(start, np.float64))]
        self._low = self._high = self._commands[0][1]
        self._place = self._low, self._high
        self._position = np.array(self._low if following.most_nm is None else self._low[:, 0])
        self._t_s = t_s
        self._weak, self._law = np.zeros(n), np.zeros(n)
        self._moved: list[tuple[float, np.ndarray, np.ndarray]] = []
        self._velocity: np.ndarray | None = None
        # Since when each joint is beyond its limit, and for how many samples.
        self._since_s, self._count = np.zeros(n), np.zeros(n, np.int64)

    def sent(self, command: np.ndarray, t_s: float) -> None:
        """Note a command that is sent at a time [s]."""
        with self._lock:
            self._commands.append((t_s, np.array(command, np.float64)))

    def check(self, position_rad: np.ndarray, velocity_rad_s: np.ndarray, load: np.ndarray, t_s: float) -> None:
        """Check a measurement that was taken at a time [s]; arrays ``(n,)``.

        Raises:
            SafetyStop: A joint does not follow its commands.
        """
        with self._lock:
            # Keep the commands of the response's time, and the one before.
            commands = self._commands
            while len(commands) > 1 and commands[1][0] <= t_s - self._following.response_s:
                commands.pop(0)
            times, recent = np.array([sent_s for sent_s, _ in commands]), np.array([command for _, command in commands])
        elapsed_s, self._t_s = max(0.0, t_s - self._t_s), t_s
        if self._following.push is not None:
            off = self._missing_push(times, recent, position_rad, velocity_rad_s, elapsed_s)
        elif self._following.most_nm is None:
            off = self._distance(recent, position_rad, elapsed_s)
        else:
            off = self._weakness(recent[-1], position_rad, velocity_rad_s, load, elapsed_s)
        # A joint must be beyond its limit for a while: single readings may be wrong.
        beyond = off > self._limit
        self._since_s = np.where(beyond & (self._count == 0), t_s, self._since_s)
        self._count = np.where(beyond, self._count + 1, 0)
        lasting = beyond & (self._count >= _SAMPLES) & (t_s - self._since_s >= _BEYOND_S)
        if lasting.any():
            raise self._stop(int(np.argmax(np.where(lasting, off - self._limit, -np.inf))), position_rad, load, off)

    def _distance(self, goals: np.ndarray, position_rad: np.ndarray, elapsed_s: float) -> np.ndarray:
        """Return the distance of each joint from where its goals put it [rad]."""
        # A joint that is on its way to its goals goes on from where it was measured last.
        downwards, upwards = self._speeds(self._position)
        self._low = np.minimum(goals.min(axis=0), np.maximum(self._low, self._position) + upwards * elapsed_s)
        self._high = np.maximum(goals.max(axis=0), np.minimum(self._high, self._position) - downwards * elapsed_s)
        self._position = position_rad
        low, high = self._low, self._high
        if self._following.weight is not None:
            down, up = self._following.weight(position_rad)
            low, high = low + np.minimum(down, 0.0), high + np.maximum(up, 0.0)
        self._place = low, high
        return np.maximum(np.maximum(low - position_rad, position_rad - high), 0.0)

    def _weakness(
        self, law: np.ndarray, position_rad: np.ndarray, velocity_rad_s: np.ndarray, load: np.ndarray, elapsed_s: float
    ) -> np.ndarray:
        """Return by how much the load of each motor is weaker than its law, on average [N m]."""
        q, dq, kp, kd, tau = law.T
        most = np.asarray(self._following.most_nm, np.float64)
        torque = np.clip(tau + kp * (q - position_rad) + kd * (dq - velocity_rad_s), -most, most)
        share = min(1.0, elapsed_s / self._following.response_s)
        self._law = self._law + share * (torque - self._law)
        self._weak = self._weak + share * (np.abs(torque) - np.sign(torque) * load - self._weak)
        return np.maximum(self._weak, 0.0)

    def _missing_push(
        self,
        times_s: np.ndarray,
        commands: np.ndarray,
        position_rad: np.ndarray,
        velocity_rad_s: np.ndarray,
        elapsed_s: float,
    ) -> np.ndarray:
        """Return which share of the acceleration by its commands each joint lacks."""
        push, before, self._velocity = self._following.push, self._velocity, velocity_rad_s
        if push is None or before is None or not elapsed_s > 0.0:
            return np.zeros(len(position_rad))
        # The change of speed since the last measurement, and the commands that acted meanwhile, on average.
        ends_s = self._t_s - self._following.delay_s - elapsed_s * np.linspace(1.0, 0.0, _PARTS, endpoint=False)
        acted = commands[np.maximum(np.searchsorted(times_s, ends_s, "right") - 1, 0)].mean(axis=0)
        speed = 0.5 * (velocity_rad_s + before)
        free, pushed, friction = push(position_rad - 0.5 * elapsed_s * speed, speed, acted)
        # A joint that is slow may be held by its friction, unless it is pushed much harder.
        moves = (np.abs(speed) > _SLOW_RAD_S) | (np.abs(free + pushed) > 3.0 * friction)
        by_command = np.where(moves, elapsed_s * pushed, 0.0)
        answer = velocity_rad_s - before - elapsed_s * free
        self._moved.append((self._t_s, by_command**2, by_command * answer))
        while self._moved[0][0] < self._t_s - self._following.response_s:
            self._moved.pop(0)
        squares = np.sum([squared for _, squared, _ in self._moved], axis=0)
        products = np.sum([product for _, _, product in self._moved], axis=0)
        return np.where(squares > _ENOUGH, 1.0 - products / np.maximum(squares, _ENOUGH), 0.0)

    def _stop(self, joint: int, position_rad: np.ndarray, load: np.ndarray, off: np.ndarray) -> SafetyStop:
        name, limit, source = self._name(joint), self._limit[joint], self._following.source
        if self._following.push is not None:
            fault = f"{name} moves without {off[joint]:.0%} of its commands' push, {limit:.0%} are allowed ({source})"
        elif self._following.most_nm is None:
            low, high = self._place[0][joint], self._place[1][joint]
            place = f"{low:.3g} rad" if high - low < 5e-3 else f"{low:.3g} to {high:.3g} rad"
            fault = (
                f"{name} is at {position_rad[joint]:.3g} rad, its commands put it at {place}: it is "
                f"{off[joint]:.2g} rad away, {limit:.2g} rad are allowed ({source})"
            )
        else:
            fault = (
                f"{name} pushes with {load[joint]:.2g} N m, its command is {self._law[joint]:.2g} N m: "
                f"{off[joint]:.2g} N m are missing, {limit:.2g} N m are allowed ({source})"
            )
        cause = "has its motor let go, is it blocked, does its belt slip, or is its encoder stuck?"
        return SafetyStop(fault, hint=f"{cause} following_rad sets the limit")
