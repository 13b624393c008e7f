"""What servos are driven with: volts or joint angles; how either becomes goals on the bus, and what rest is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Protocol

import numpy as np

from sim2real.errors import HardwareLost, UsageError
from sim2real.hardware import registers as reg
from sim2real.hardware.bus import ServoBus, StateReading
from sim2real.hardware.gate import GateConfig
from sim2real.hardware.registers import OperatingMode, Register


class Drive(Protocol):
    """A way to drive servos. Commands are (n,) float64, in the order of the bus's ids.

    Attributes:
        mode: The operating mode that the servos must be in.
    """

    mode: ClassVar[OperatingMode]

    def check(self, gate: GateConfig, ids: Sequence[int]) -> None:
        """Raise UsageError if this gate, or so many servos, make no sense with it; before the port is opened."""
        ...

    def prepare(self, bus: ServoBus, gate: GateConfig) -> None:
        """Write the servos' settings, with torque off.

        Raises:
            HardwareLost: A servo does not keep them.
            UsageError: The gate lets more through than a servo takes.
        """
        ...

    def rest(self, bus: ServoBus) -> np.ndarray:
        """Return the command that the servos obey right after torque on."""
        ...

    def send(self, bus: ServoBus, command: np.ndarray) -> None:
        """Write a command to the servos."""
        ...

    def effort(self, command: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
        """Return with how much of their torque the servos push, by their command and angles, (n,) in [-1, 1]."""
        ...

    def reading(self, reading: StateReading) -> StateReading:
        """Return a measurement of all servos in this drive's angles."""
        ...


@dataclass(frozen=True)
class VoltageDrive:
    """Servos in PWM mode, commanded in volts; at rest there are none. Angles are rad from each encoder's zero.

    Args:
        supply_v: Voltage of a motor at full PWM [V].
    """

    supply_v: float
    mode: ClassVar[OperatingMode] = OperatingMode.PWM

    def __post_init__(self) -> None:
        """Refuse a supply that is none."""
        if not 0.0 < self.supply_v < math.inf:
            raise UsageError(f"supply_v = {self.supply_v} must be larger than 0")

    def check(self, gate: GateConfig, ids: Sequence[int]) -> None:
        """Refuse a gate that would keep a voltage on."""
        del ids
        _require_stale(gate, "zero", "volts")

    def prepare(self, bus: ServoBus, gate: GateConfig) -> None:
        """PWM mode has no settings."""

    def rest(self, bus: ServoBus) -> np.ndarray:
        """Return zero volts."""
        return np.zeros(len(bus.ids))

    def send(self, bus: ServoBus, command: np.ndarray) -> None:
        """Write voltages [V]."""
        bus.write_goal_pwm({i: float(v) / self.supply_v for i, v in zip(bus.ids, command, strict=True)})

    def effort(self, command: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
        """Return the voltage's share of the supply."""
        del position_rad
        return np.clip(command / self.supply_v, -1.0, 1.0)

    def reading(self, reading: StateReading) -> StateReading:
        """Return the measurement as it is."""
        return reading


@dataclass(frozen=True)
class PositionDrive:
    """Servos in position mode, commanded in joint angles [rad]; at rest they hold where they are.

    A joint's angle is 0 where its encoder shows `zero_count`. The servos take goals of one revolution, counts 0 to
    4095, so that a joint whose zero is the centre reaches -pi to almost pi.

    Args:
        p_gain: Position P Gain, in counts, of every servo.
        profile_velocity_rad_s: Speed at which a servo's own setpoint follows its goal [rad/s], rounded to 0.024 rad/s
            and never to 0; inf: at once.
        d_gain: Position D Gain, in counts.
        zero_count: Encoder count of the joint's zero: for all, or one per servo.
    """

    p_gain: int
    profile_velocity_rad_s: float
    d_gain: int = 0
    zero_count: int | tuple[int, ...] = 2048
    mode: ClassVar[OperatingMode] = OperatingMode.POSITION

    def __post_init__(self) -> None:
        """Refuse what the registers cannot hold."""
        for register, value in self._settings().items():
            if not register.minimum <= value <= register.maximum:
                limits = f"[{register.minimum}, {register.maximum}]"
                raise UsageError(f"position drive: {register.name} = {value} is outside {limits}")
        counts = np.asarray(self.zero_count)
        if np.any(counts < 0) or np.any(counts >= reg.COUNTS_PER_REVOLUTION):
            raise UsageError(f"position drive: zero_count = {self.zero_count} is outside the encoder's revolution")

    def check(self, gate: GateConfig, ids: Sequence[int]) -> None:
        """Refuse a gate that would send the joints to zero, or another number of zeros than of servos."""
        _require_stale(gate, "hold", "positions")
        if isinstance(self.zero_count, tuple) and len(self.zero_count) != len(ids):
            raise UsageError(f"position drive: {len(self.zero_count)} zero counts for {len(ids)} servos")

    def prepare(self, bus: ServoBus, gate: GateConfig) -> None:
        """Write gains and profile, which a servo forgets without power, and read them back."""
        self._require_reach(bus, gate)
        for servo_id in bus.ids:
            drive_mode = bus.read(servo_id, reg.DRIVE_MODE)
            if drive_mode & ~reg.DRIVE_REVERSED:
                bus.write(servo_id, reg.DRIVE_MODE, drive_mode & reg.DRIVE_REVERSED)
            for register, value in self._settings().items():
                bus.write(servo_id, register, value)
                found = bus.read(servo_id, register)
                if found != value:
                    raise HardwareLost(
                        f"servo {servo_id} does not keep its settings: {register.name} is {found} after {value} was "
                        "written",
                        hint="is its supply stable?",
                    )

    def rest(self, bus: ServoBus) -> np.ndarray:
        """Return the angles that the servos hold [rad]: their positions when torque went on."""
        # The goals and not the positions by now: a load has pulled the joints off them, and would again and again.
        return self._angle(bus, reg.GOAL_POSITION)

    def send(self, bus: ServoBus, command: np.ndarray) -> None:
        """Write joint angles [rad]."""
        angles = command + self._zero_rad
        bus.write_goal_position({i: float(a) for i, a in zip(bus.ids, angles, strict=True)})

    def effort(self, command: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
        """Return the share of full duty that the P gain makes of the error; with a profile it gets there later."""
        error_count = (command - position_rad) / reg.RAD_PER_COUNT
        return np.clip(error_count * self.p_gain / reg.P_GAIN_UNIT / reg.PWM_FULL_SCALE, -1.0, 1.0)

    def reading(self, reading: StateReading) -> StateReading:
        """Return the measurement with joint angles [rad]."""
        return replace(reading, position_rad=reading.position_rad - self._zero_rad)

    @property
    def _zero_rad(self) -> np.ndarray:
        return np.asarray(self.zero_count) * reg.RAD_PER_COUNT

    def _angle(self, bus: ServoBus, register: Register) -> np.ndarray:
        """Return the joint angles (n,) [rad] that a position register of each servo holds."""
        return np.array([bus.read(servo_id, register) for servo_id in bus.ids]) * reg.RAD_PER_COUNT - self._zero_rad

    def _require_reach(self, bus: ServoBus, gate: GateConfig) -> None:
        """Refuse limits beyond the servos' own: they drop such goals, and of several at once none is confirmed."""
        low, high = self._angle(bus, reg.MIN_POSITION_LIMIT), self._angle(bus, reg.MAX_POSITION_LIMIT)
        slack = reg.RAD_PER_COUNT / 2
        if np.any(gate.range[0] < low - slack) or np.any(gate.range[1] > high + slack):
            raise UsageError(
                f"gate of {gate.node!r}: limit {gate.limit} exceeds what the servos take, "
                f"{np.round(low, 3).tolist()} to {np.round(high, 3).tolist()} rad",
                hint="narrow the limit, or set zero_count and the servos' own position limits",
            )

    def _settings(self) -> dict[Register, int]:
        if not self.profile_velocity_rad_s > 0.0:
            raise UsageError(
                f"position drive: profile_velocity_rad_s = {self.profile_velocity_rad_s} must be larger than 0",
                hint="inf switches the profile off",
            )
        unlimited = math.isinf(self.profile_velocity_rad_s)  # 0 in the register, where rounding must not lead
        velocity = 0 if unlimited else max(1, reg.count_from_rad_s(self.profile_velocity_rad_s))
        return {
            reg.POSITION_P_GAIN: self.p_gain,
            reg.POSITION_I_GAIN: 0,
            reg.POSITION_D_GAIN: self.d_gain,
            reg.PROFILE_ACCELERATION: 0,
            reg.PROFILE_VELOCITY: velocity,
        }


def _require_stale(gate: GateConfig, wanted: Literal["zero", "hold"], what: str) -> None:
    if gate.stale != wanted:
        raise UsageError(
            f"gate of {gate.node!r}: stale = {gate.stale!r} is not safe with {what}", hint=f"stale = {wanted!r} is"
        )
