"""Following error: stops the robot if a joint does not follow its commands, because it let go, is blocked, or slips."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim2real.errors import SafetyStop
from sim2real.hardware.device import Following

_BEYOND_S: Final = 0.04
"""Time for which a joint must be beyond its limit before the robot is stopped [s]."""
_SAMPLES: Final = 3
"""Number of samples in a row that must be beyond the limit."""
_PARTS: Final = 10
"""Number of times between two measurements at which the command is looked up."""
_SLOW_RAD_S: Final = 0.5
_LONGEST_S: Final = 0.05
"""Longest time between two measurements whose change of speed is compared: over a longer time, forces change too much
[s].
"""
_UNSURE: Final = 0.15
"""Largest uncertainty of the times of measurements and commands, as a share of the time between two measurements."""
_ENOUGH: Final = 3.0
"""Smallest sum of squares of a joint's changes of speed that is compared; noise is 0.05 rad/s [rad^2/s^2]."""


@dataclass
class _Sent:
    """A command, which began to act between two times; the second is unknown while the command is being sent."""

    command: np.ndarray
    begin_s: float
    end_s: float = np.inf


@dataclass
class _Sample:
    """A measurement; arrays ``(n,)``."""

    position_rad: np.ndarray
    velocity_rad_s: np.ndarray
    load: np.ndarray
    t_s: float
    elapsed_s: float
    unsure_s: float


class _Goals:
    """Computes the distance of each joint from where its goals put it [rad]."""

    def __init__(self, following: Following, start: np.ndarray) -> None:
        self._following = following
        both = np.broadcast_to(np.asarray(following.speed_rad_s, np.float64), len(start))
        self._speeds = following.speeds or (lambda _: (both, both))
        self._low = self._high = self._position = start
        self._place = start, start

    def off(self, commands: Sequence[_Sent], now: _Sample) -> np.ndarray:
        goals, position_rad = np.array([sent.command for sent in commands]), now.position_rad
        # A joint on its way to its goals moves on from its last measured position.
        downwards, upwards = self._speeds(self._position)
        self._low = np.minimum(goals.min(axis=0), np.maximum(self._low, self._position) + upwards * now.elapsed_s)
        self._high = np.maximum(goals.max(axis=0), np.minimum(self._high, self._position) - downwards * now.elapsed_s)
        self._position = position_rad
        low, high = self._low, self._high
        if self._following.weight is not None:
            down, up = self._following.weight(position_rad)
            low, high = low + np.minimum(down, 0.0), high + np.maximum(up, 0.0)
        self._place = low, high
        return np.maximum(np.maximum(low - position_rad, position_rad - high), 0.0)

    def fault(self, i: int, now: _Sample, off: float, limit: float) -> str:
        low, high = self._place[0][i], self._place[1][i]
        place = f"{low:.3g} rad" if high - low < 5e-3 else f"{low:.3g} to {high:.3g} rad"
        return (
            f"is at {now.position_rad[i]:.3g} rad, its commands put it at {place}: it is {off:.2g} rad away, "
            f"{limit:.2g} rad are allowed"
        )


class _Torques:
    """Computes by how much the load of each motor is weaker than its commanded torque, on average [N m]."""

    def __init__(self, following: Following, start: np.ndarray) -> None:
        self._following = following
        self._weak, self._law = np.zeros(len(start)), np.zeros(len(start))

    def off(self, commands: Sequence[_Sent], now: _Sample) -> np.ndarray:
        # The robot may obey the last command or the one that is being sent.
        after = [*commands[1:], None]
        laws = [c.command for c, then in zip(commands, after, strict=True) if then is None or then.end_s > now.t_s]
        most = np.asarray(self._following.most_nm, np.float64)
        q, dq, kp, kd, tau = np.moveaxis(np.array(laws), -1, 0)
        torques = np.clip(tau + kp * (q - now.position_rad) + kd * (dq - now.velocity_rad_s), -most, most)
        missing = np.abs(torques) - np.sign(torques) * now.load
        share = min(1.0, now.elapsed_s / self._following.response_s)
        self._law = self._law + share * (torques[-1] - self._law)
        self._weak = self._weak + share * (missing.min(axis=0) - self._weak)
        return np.maximum(self._weak, 0.0)

    def fault(self, i: int, now: _Sample, off: float, limit: float) -> str:
        return (
            f"pushes with {now.load[i]:.2g} N m, its command is {self._law[i]:.2g} N m: {off:.2g} N m are missing, "
            f"{limit:.2g} N m are allowed"
        )


class _Pushes:
    """Computes which share of the acceleration due to its commands each joint lacks."""

    def __init__(self, following: Following, start: np.ndarray) -> None:
        self._following, self._none = following, np.zeros(len(start))
        self._moved: list[tuple[float, np.ndarray, np.ndarray]] = []
        self._velocity: np.ndarray | None = None
        self._unsure_s = 0.0

    def off(self, commands: Sequence[_Sent], now: _Sample) -> np.ndarray:
        before, self._velocity = self._velocity, now.velocity_rad_s
        unsure_s, self._unsure_s = max(now.unsure_s, self._unsure_s), now.unsure_s
        if before is not None and 0.0 < now.elapsed_s <= _LONGEST_S:
            self._compare(commands, now, before, unsure_s)
        while self._moved and self._moved[0][0] < now.t_s - self._following.response_s:
            self._moved.pop(0)
        squares = np.sum([self._none, *(squared for _, squared, _ in self._moved)], axis=0)
        products = np.sum([self._none, *(product for _, _, product in self._moved)], axis=0)
        return np.where(squares > _ENOUGH, 1.0 - products / np.maximum(squares, _ENOUGH), 0.0)

    def _compare(self, commands: Sequence[_Sent], now: _Sample, before: np.ndarray, unsure_s: float) -> None:
        """Compare the change of speed since the last measurement with the commands, if times are certain."""
        following, elapsed_s = self._following, now.elapsed_s
        assert following.push is not None
        # The average of the commands that acted since the last measurement.
        ends_s = now.t_s - following.delay_s - elapsed_s * np.linspace(1.0, 0.0, _PARTS, endpoint=False)
        begins_s = np.array([sent.begin_s for sent in commands])
        places = np.maximum(np.searchsorted(begins_s, ends_s, "right") - 1, 0)
        for i in np.unique(places).tolist():
            sent = commands[i]
            if sent.end_s > ends_s[0]:
                unsure_s = max(unsure_s, min(sent.end_s, now.t_s) - sent.begin_s)
        if unsure_s > _UNSURE * elapsed_s:
            return
        acted = np.array([commands[i].command for i in places]).mean(axis=0)
        speed = 0.5 * (now.velocity_rad_s + before)
        free, pushed, friction = following.push(now.position_rad - 0.5 * elapsed_s * speed, speed, acted)
        # Friction may hold a slow joint, unless its command pushes much harder.
        moves = (np.abs(speed) > _SLOW_RAD_S) | (np.abs(free + pushed) > 3.0 * friction)
        by_command = np.where(moves, elapsed_s * pushed, 0.0)
        answer = now.velocity_rad_s - before - elapsed_s * free
        self._moved.append((now.t_s, by_command**2, by_command * answer))

    def fault(self, i: int, now: _Sample, off: float, limit: float) -> str:
        return f"moves without {off:.0%} of its commands' push, {limit:.0%} are allowed"


class FollowingCheck:
    """Compares measurements with commands; see `Following`. Both may come from different threads.

    A host that did not run for a while causes no false alarm: a command counts only after it was sent, and pushes are
    compared only if the times are certain.

    Args:
        start: Command that the joints follow at the start, ``(n,)``, or ``(n, 5)`` with the columns of `Following`'s
            torque.
        t_s: Time of the start [s].
        name: Returns a joint's name for errors.
    """

    def __init__(self, following: Following, start: np.ndarray, t_s: float, name: Callable[[int], str]) -> None:
        self._following, self._name, n = following, name, len(start)
        self._limit = np.broadcast_to(np.asarray(following.limit, np.float64), n)
        first = np.array(start, np.float64)
        kind = _Pushes if following.push is not None else _Goals if following.most_nm is None else _Torques
        self._kind = kind(following, first)
        self._lock = threading.Lock()
        self._commands = [_Sent(first, t_s, t_s)]
        self._t_s = t_s
        # Since when, and for how many samples, each joint has been beyond its limit.
        self._since_s, self._count = np.zeros(n), np.zeros(n, np.int64)

    def sending(self, command: np.ndarray, t_s: float) -> None:
        """Note a command that begins to be sent at a time [s]."""
        with self._lock:
            self._commands.append(_Sent(np.array(command, np.float64), t_s))

    def sent(self, t_s: float) -> None:
        """Note that the last command has been sent at a time [s]."""
        with self._lock:
            self._commands[-1].end_s = t_s

    def check(
        self, position_rad: np.ndarray, velocity_rad_s: np.ndarray, load: np.ndarray, t_s: float, unsure_s: float = 0.0
    ) -> None:
        """Check a measurement; arrays ``(n,)``.

        Args:
            t_s: Its time [s].
            unsure_s: By how much later than ``t_s`` it may have been taken [s].

        Raises:
            SafetyStop: A joint does not follow its commands.
        """
        with self._lock:
            # Keep the commands of the last `response_s`, and the one before.
            commands = self._commands
            while len(commands) > 1 and commands[1].end_s <= t_s - self._following.response_s:
                commands.pop(0)
            recent = list(commands)
        now = _Sample(position_rad, velocity_rad_s, load, t_s, max(0.0, t_s - self._t_s), unsure_s)
        self._t_s = t_s
        off = self._kind.off(recent, now)
        # A joint must be beyond its limit for a while: single readings may be wrong.
        beyond = off > self._limit
        self._since_s = np.where(beyond & (self._count == 0), t_s, self._since_s)
        self._count = np.where(beyond, self._count + 1, 0)
        lasting = beyond & (self._count >= _SAMPLES) & (t_s - self._since_s >= _BEYOND_S)
        if lasting.any():
            i = int(np.argmax(np.where(lasting, off - self._limit, -np.inf)))
            fault = self._kind.fault(i, now, off[i], self._limit[i])
            cause = "has its motor let go, is it blocked, does its belt slip, or is its encoder stuck?"
            raise SafetyStop(
                f"{self._name(i)} {fault} ({self._following.source})",
                hint=f"{cause} following_rad sets the limit",
            )
