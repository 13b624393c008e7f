"""The safety gate: its limits, and the check of every command before it is sent to the motors.

`GateLimits` are the flags of the stages that move a robot; numpy is imported late, to keep --help fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from sim2real.errors import SafetyStop, UsageError
from sim2real.later import Later

if TYPE_CHECKING:
    import numpy as np

    from sim2real.hardware.device import Stale
else:
    np = Later("numpy")

_Limit: TypeAlias = "float | Sequence[float] | Sequence[Sequence[float]]"
_POSITIVE: Final = (
    "slew_per_s",
    "command_timeout_s",
    "max_speed_rad_s",
    "freeze_rad_s",
    "freeze_s",
    "first_step_rad",
    "following_rad",
    "max_sample_age_s",
    "stop_s",
)


@dataclass(frozen=True)
class GateLimits:
    """The limits of the safety gate, through which every command passes."""

    limit: float = 2.0
    """Largest magnitude of a command [the actuator's unit: V for the pendulum, rad for the arm]."""
    slew_per_s: float = 400.0
    """Largest rate of change of a command [the actuator's unit per second]."""
    command_timeout_s: float = 0.1
    """A command older than this is replaced: by zero volts, or in position mode by the last goal [s]."""
    max_speed_rad_s: float = 60.0
    """Joint speed above which the robot is stopped, measured or from successive positions [rad/s]."""
    freeze_rad_s: float = 2.0
    """A joint that moved this fast and then reads the same for 0.05 s stops the robot: its encoder froze [rad/s]."""
    envelope_rad: tuple[float, float] | None = None
    """Lowest and highest joint angle, beyond which the robot is stopped; default: not checked [rad]."""
    first_step_rad: float = 0.5
    """Largest distance of the first goal from the measured pose; a policy that starts farther away is refused [rad]."""
    following_rad: float | None = None
    """Largest distance of a joint from where its goals put it: beyond it the robot is stopped, as the joint let go, is
    blocked or slips; default: by the identified model, or by the servo's own figures; inf: not checked [rad]."""
    max_sample_age_s: float = 0.25
    """Age of the newest measurement above which the robot is stopped instead of commanded [s]."""
    stop_s: float = 0.5
    """Longest time in which Ctrl-C brings the robot to rest before the torque goes off [s]."""
    servo_watchdog_s: float = 0.1
    """Longest silence on the bus; after it the guardian takes the torque off, and the servos' watchdogs trip [s]."""

    def __post_init__(self) -> None:
        for name in ("limit", *_POSITIVE):
            value = getattr(self, name, None)
            if value is not None and not value > 0.0:
                raise UsageError(f"gate.{name} must be above 0, got {value}")
        if not 0.02 <= self.servo_watchdog_s <= 2.54:
            raise UsageError(f"gate.servo_watchdog_s must lie in [0.02, 2.54] s, got {self.servo_watchdog_s}")
        if self.envelope_rad is not None and not self.envelope_rad[0] < self.envelope_rad[1]:
            raise UsageError(f"gate.envelope_rad must be the lowest and the highest angle, got {self.envelope_rad}")

    def gate(self, limit: float | tuple[_Limit, _Limit], **settings: Any) -> GateConfig:
        """Return the gate of a robot with these limits.

        Args:
            limit: Largest magnitude of a command, or (low, high) [the command's unit].
        """
        limits = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("limit", "servo_watchdog_s")}
        return GateConfig(limit, **limits, **settings)


@dataclass(frozen=True)
class GateConfig(GateLimits):
    """The limits of one robot's commands and measurements: `GateLimits`, with values per joint.

    Args:
        limit: Largest magnitude of a command, or (low, high), each one value or one per actuator [the command's unit];
            for commands with columns one value per column, or of the shape (n, k).
        slew_per_s: Largest rate of change of a command [the command's unit per second]; one value, or one per column;
            None: no limit.
        max_speed_rad_s: One value or one per joint [rad/s]; None: not checked.
        stale: Replacement of a stale command: ``zero``, or ``hold``, the last command that was sent (for positions), or
            a number. A tuple with one for each column is for commands of the shape (n, k).
    """

    limit: float | tuple[_Limit, _Limit] = 1.0
    slew_per_s: float | Sequence[float] | None = None
    max_speed_rad_s: float | Sequence[float] | None = None
    envelope_rad: tuple[float | Sequence[float], float | Sequence[float]] | None = None
    node: str = "actuator"
    stale: Stale | tuple[Stale, ...] = "zero"
    joints: tuple[str, ...] = ()
    freeze_s: float = 0.05

    def __post_init__(self) -> None:
        # A gate that refuses every command, or the command at rest, would stop the robot at once.
        low, high = self.range
        if low.ndim > 1 + self.has_columns or (low.ndim and high.ndim and low.shape != high.shape):
            raise self._wrong(f"limit {self.limit} has another number of lows than of highs")
        if not np.all(low <= high):
            raise self._wrong(f"limit {self.limit} lets nothing through")
        for limits in (low, high) if self.has_columns else ():
            if limits.ndim and limits.shape[-1] != len(self.replacements):
                raise self._wrong(f"limits for {limits.shape[-1]} of {len(self.replacements)} columns")
        stale = np.array([{"zero": 0.0, "hold": np.nan}.get(str(entry), entry) for entry in self.replacements], float)
        if np.any((low > stale) | (high < stale)):
            what = f"{stale.tolist()}, the stale command" if self.has_columns else f"{stale[0]:g}, the command at rest"
            raise self._wrong(f"limit {self.limit} does not contain {what}")
        if self.envelope_rad is not None and not np.all(np.less(*map(np.asarray, self.envelope_rad))):
            raise self._wrong(f"envelope_rad = {self.envelope_rad} holds no position")
        # All other limits are positive, each one value or one per joint.
        for name in _POSITIVE:
            value = getattr(self, name)
            if value is not None and not np.all(np.asarray(value) > 0.0):
                raise self._wrong(f"{name} = {value} must be larger than 0")

    def _wrong(self, fault: str) -> UsageError:
        return UsageError(f"gate of {self.node!r}: {fault}")

    def joint(self, index: int) -> str:
        """Return a joint's name for errors."""
        return f"joint {self.joints[index]!r}" if index < len(self.joints) else f"joint {index}"

    @property
    def has_columns(self) -> bool:
        """Whether commands have the shape (n, k)."""
        return isinstance(self.stale, tuple)

    @property
    def replacements(self) -> tuple[Stale, ...]:
        """The replacement of a stale command, for each column; one entry without columns."""
        return self.stale if isinstance(self.stale, tuple) else (self.stale,)

    @property
    def holds(self) -> bool:
        """Whether a stale command holds its last value, in one column or more."""
        return "hold" in self.replacements

    @property
    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest command, each of shape () or (n,); (k,) or (n, k) for commands with columns."""
        low, high = self.limit if isinstance(self.limit, tuple) else (-self.limit, self.limit)
        return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)

    def at_rest(self, last: np.ndarray) -> np.ndarray:
        """Return the replacement of a stale command after the last one, ``(n,)`` or ``(n, k)``."""
        replaced = np.array(last, np.float64)
        for column, stale in enumerate(self.replacements):
            if stale != "hold":
                replaced[..., column if self.has_columns else slice(None)] = 0.0 if stale == "zero" else stale
        return replaced

    def pushes(self, sent: np.ndarray) -> np.ndarray:
        """Return which joints a command pushes, ``(n,)``: it is a position, or differs from the command at rest."""
        return (sent != self.at_rest(sent)).reshape(len(sent), -1).any(axis=1) | (self.stale == "hold")


@dataclass
class GateCounts:
    """Counts of the gate's calls, and of the calls in which each limit changed a command.

    Attributes:
        passed: Calls that returned a command.
    """

    passed: int = 0
    clamped: int = 0
    slewed: int = 0
    stale: int = 0


class SafetyGate:
    """Clamps commands of one or several actuators, limits their rate of change, and replaces stale ones.

    Once it has raised SafetyStop, every later call raises it again, until `reset`.
    """

    def __init__(self, config: GateConfig) -> None:
        self.config = config
        self._low, self._high = config.range
        self.reset()

    def reset(self, start: np.ndarray | None = None) -> None:
        """Start again, with counts at zero and no stop.

        Args:
            start: Shape (n,) or (n, k): the command that the robot follows now, from which the slew limit starts; it
                may be outside the limits. None: zero, not allowed if stale commands are replaced by the last one.
        """
        self.counts = GateCounts()
        self._last = None if start is None else np.array(start, dtype=np.float64, ndmin=1)
        self._last_s: float | None = None
        self._stop: SafetyStop | None = None
        if self._last is not None:
            self._require_finite("start", self._last)
            self._require_shape(self._last)

    @property
    def fallback(self) -> np.ndarray:
        """The replacement of a stale command, shape (n,) or (n, k); UsageError without a `start` or a command."""
        if self._last is None:
            raise UsageError(f"gate of {self.config.node!r} has nothing to hold", hint="call reset(start) first")
        return self.config.at_rest(self._last)

    def apply(
        self, command: np.ndarray, age_s: float, now_s: float, speed_rad_s: np.ndarray | float | None = None
    ) -> np.ndarray:
        """Return the command that may be sent.

        A stale command is replaced by `fallback`, to which the slew limit does not apply.

        Args:
            command: Shape (n,) or (n, k): the policy's command.
            age_s: Time since the policy computed it [s]; NaN counts as stale.
            now_s: A monotonic time, for the slew limit [s].
            speed_rad_s: Shape (n,) or scalar: measured speeds [rad/s]; None: not checked.

        Returns:
            The shape of the command, float64.

        Raises:
            SafetyStop: A value is not finite, or a speed is above its limit.
            UsageError: The number of commands differs from that of the limits, or there is no last command to hold.
        """
        # Refuse commands and speeds that must stop the robot.
        if self._stop is not None:
            raise self._stop
        wanted = np.array(command, dtype=np.float64, ndmin=1)
        self._require_finite("command", wanted)
        self._require_slow(speed_rad_s)
        if self._last is None and not self.config.holds:
            self._last = np.zeros_like(wanted)
        fallback = self.fallback
        self._require_shape(wanted)
        # Replace a stale command, also one with an age of NaN, or limit a fresh one.
        if not age_s <= self.config.command_timeout_s:
            self.counts.stale += 1
            allowed = fallback
        else:
            clamped = np.clip(wanted, self._low, self._high)
            self.counts.clamped += bool(np.any(clamped != wanted))
            allowed = self._slew(clamped, now_s)
            self.counts.slewed += bool(np.any(allowed != clamped))
        self._last, self._last_s = allowed, now_s
        self.counts.passed += 1
        return allowed.copy()

    def _slew(self, wanted: np.ndarray, now_s: float) -> np.ndarray:
        if self.config.slew_per_s is None or self._last is None:
            return wanted
        elapsed_s = 0.0 if self._last_s is None else max(0.0, now_s - self._last_s)
        if self.config.holds:
            # The robot held its position in a pause, so a long pause must not allow a large jump.
            elapsed_s = min(elapsed_s, self.config.command_timeout_s)
        limit = np.asarray(self.config.slew_per_s, np.float64)
        # Infinite times 0 s is NaN; it means no limit.
        largest = limit * elapsed_s if elapsed_s > 0.0 else np.where(np.isinf(limit), np.inf, 0.0)
        return np.clip(wanted, self._last - largest, self._last + largest)

    def _require_shape(self, values: np.ndarray) -> None:
        columns, node = self.config.has_columns, self.config.node
        if values.ndim != 1 + columns or (columns and values.shape[1] != len(self.config.replacements)):
            wanted = f"(n, {len(self.config.replacements)})" if columns else "(n,)"
            raise UsageError(f"gate of {node!r}: commands of shape {values.shape}, not {wanted}")
        for other in (self._low, self._high, self._last):
            if other is not None and other.ndim > columns and other.shape != values.shape:
                raise UsageError(
                    f"gate of {node!r}: commands of shape {values.shape}, limits or start of {other.shape}"
                )

    def _require_finite(self, what: str, values: np.ndarray) -> None:
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            index = tuple(bad[0].tolist())
            self._halt(f"{what}[{', '.join(map(str, index))}] = {values[index]} is not finite")

    def _require_slow(self, speed_rad_s: np.ndarray | float | None) -> None:
        limit = self.config.max_speed_rad_s
        if limit is None or speed_rad_s is None:
            return
        speeds = np.array(speed_rad_s, dtype=np.float64, ndmin=1)
        self._require_finite("speed_rad_s", speeds)
        limits = np.broadcast_to(np.asarray(limit, np.float64), speeds.shape)
        index = int(np.argmax(np.abs(speeds) / limits))
        if math.fabs(speeds[index]) > limits[index]:
            what = f"speed_rad_s[{index}] = {speeds[index]:.4g} of {self.config.joint(index)}"
            self._halt(f"{what} is beyond the limit of {limits[index]:.4g} rad/s")

    def _halt(self, reason: str) -> None:
        self._stop = SafetyStop(f"node {self.config.node!r} stopped: {reason}")
        raise self._stop
