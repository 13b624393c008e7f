"""Emulated Feetech servos: the setpoint's profile, registers and firmware, and their bus."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from sim2real.emulation.bus import BusEmulation, Firmware, InstructedBus, Request
from sim2real.emulation.firmware import ServoFirmware
from sim2real.emulation.plant import ConfigurablePlant, Plant
from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.device import OperatingMode


@dataclass
class _Setpoint:
    """Goal, state and limits of a servo's setpoint; the goal is None if the servo is not in position mode."""

    goal_rad: float | None = None
    position_rad: float = 0.0
    speed_rad_s: float = 0.0
    top_rad_s: float = math.inf
    acceleration_rad_s2: float = math.inf

    def advance(self, goal_rad: float, step_s: float) -> float:
        """Move towards the goal for a step of time, so that it comes to rest there; return its position [rad]."""
        left = goal_rad - self.position_rad
        change = self.acceleration_rad_s2 * step_s
        # The highest speed from which it can still stop at the goal.
        stopping = math.inf
        if math.isfinite(change):
            stopping = math.sqrt(2.0 * self.acceleration_rad_s2 * abs(left) + change**2 / 4) - change / 2
        # The speed within all limits, and the step with it; a step across the goal ends there.
        wanted = math.copysign(min(self.top_rad_s, stopping, abs(left) / step_s), left)
        speed = min(max(wanted, self.speed_rad_s - change), self.speed_rad_s + change)
        there = abs(left - speed * step_s) < 1e-12 or (abs(speed) <= change and abs(left) <= abs(speed) * step_s)
        self.speed_rad_s = 0.0 if there else speed
        self.position_rad = goal_rad if there else self.position_rad + speed * step_s
        return self.position_rad


class ProfiledPlant:
    """A plant whose position servos get the setpoint of a profile at every step instead of their goal.

    Args:
        plant: The plant; its own profile stays unlimited.
    """

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.servo_ids = plant.servo_ids
        self._t_s = 0.0
        self._setpoints = {i: _Setpoint() for i in plant.servo_ids}

    def advance(self, t_s: float) -> None:
        """Move the setpoints and integrate the plant up to a time [s]."""
        for servo_id, setpoint in self._setpoints.items():
            goal_rad = setpoint.goal_rad
            if goal_rad is not None and goal_rad != setpoint.position_rad:
                self._plant.command(servo_id, OperatingMode.POSITION, setpoint.advance(goal_rad, t_s - self._t_s))
        self._t_s = t_s
        self._plant.advance(t_s)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Command a servo; see `Plant.command`."""
        setpoint = self._setpoints[servo_id]
        if mode != OperatingMode.POSITION:
            setpoint.goal_rad = None
            self._plant.command(servo_id, mode, goal)
            return
        if setpoint.goal_rad is None:
            setpoint.position_rad, setpoint.speed_rad_s = self._plant.measure(servo_id)[0], 0.0
            self._plant.command(servo_id, mode, setpoint.position_rad)
        setpoint.goal_rad = goal

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's position controller, and the top speed of its setpoint."""
        self._setpoints[servo_id].top_rad_s = profile_velocity_rad_s
        if isinstance(self._plant, ConfigurablePlant):
            self._plant.configure(servo_id, p_gain, d_gain, math.inf)

    def accelerate(self, servo_id: int, acceleration_rad_s2: float) -> None:
        """Set the acceleration of a servo's setpoint [rad/s^2]."""
        self._setpoints[servo_id].acceleration_rad_s2 = acceleration_rad_s2

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return position [rad], velocity [rad/s] and load; see `Plant.measure`."""
        return self._plant.measure(servo_id)

    def state(self) -> dict[str, float]:
        """Return the plant's true state."""
        return self._plant.state()

    def truth(self) -> dict[str, Any]:
        """Return the plant's true parameters."""
        return self._plant.truth()


STALL_CURRENT_A: Final = 2.7  # data sheet of the STS3215-C018, 12 V
_MOVING_COUNTS_PER_S: Final = 50


class StsServo(ServoFirmware):
    """Registers and firmware of one STS3215; see `ServoFirmware`.

    A value out of range is dropped without an error, as its status packets carry none; so is a write to a read-only
    register. EEPROM registers accept writes at any time; a value that was written while Lock is 1 is lost at the next
    restart. Goals beyond the position limits are cut to them.

    Two assumptions, not measured by us, are the worse case for a driver: writing a goal switches the torque on
    (`goal_wakes`), and after an alarm the motor is off while the torque register still holds 1. Not emulated: the
    remaining torque after an overload (Protective Torque), the step mode, other ids and baud rates.

    Args:
        goal_wakes: Whether writing a goal switches the torque on.
        alarms: The alarms that `overload` sets; bits of the error byte.
    """

    family = reg.FAMILY
    fixed = (reg.ID, reg.BAUD_RATE)
    homing = reg.HOMING_OFFSET
    offset_sign = -1

    def __init__(
        self,
        servo_id: int,
        model_number: int = 777,
        return_delay_us: int = 500,
        encoder_counts: int = reg.COUNTS_PER_REVOLUTION,
        goal_wakes: bool = True,
        alarms: int = 1 << 5,
    ) -> None:
        super().__init__(servo_id, model_number, return_delay_us, encoder_counts)
        self._goal_wakes = goal_wakes
        self._faults = alarms
        self._saved = bytes(self._memory)

    @property
    def confirms(self) -> bool:
        """Whether it answers when it is written."""
        return bool(self.get(reg.RESPONSE_LEVEL))

    @property
    def alert(self) -> int:
        """The error byte of its status packets: the alarms."""
        return self.get(reg.STATUS)

    def command(self) -> tuple[int, float]:
        """Return mode and goal of the motor, which is off after some alarms."""
        return (OperatingMode.OFF, 0.0) if self.alert & self.get(reg.UNLOADING) else super().command()

    def driven(self) -> tuple[int, float]:
        """Return PWM and a fraction in [-1, 1], POSITION [rad], or VELOCITY [rad/s]."""
        mode = self.get(reg.OPERATING_MODE)
        if mode == reg.Mode.PWM:
            return OperatingMode.PWM, self.get(reg.GOAL_TIME) / reg.LOAD_FULL_SCALE
        if mode == reg.Mode.VELOCITY:
            return OperatingMode.VELOCITY, self.get(reg.GOAL_SPEED) * reg.speed_unit_rad_s(self.get(reg.PHASE))
        low, high = self.get(reg.MIN_POSITION), self.get(reg.MAX_POSITION)
        count = self.get(reg.GOAL_POSITION)
        count = min(max(count, low), high) if (low, high) != (0, 0) else count  # 0 and 0: several turns
        return OperatingMode.POSITION, (count - self.offset) * reg.RAD_PER_COUNT

    def controller(self) -> tuple[int, int, float]:
        """Return P gain and D gain of the position controller [counts], and the setpoint's top speed [rad/s]."""
        phase, count = self.get(reg.PHASE), abs(self.get(reg.GOAL_SPEED))
        unlimited = count == 0 and bool(phase & reg.PHASE_ZERO_IS_FASTEST)
        return *super().controller()[:2], math.inf if unlimited else count * reg.speed_unit_rad_s(phase)

    def acceleration_rad_s2(self) -> float:
        """Return the acceleration of the setpoint [rad/s^2]."""
        return self.get(reg.ACCELERATION) * reg.ACCELERATION.unit or math.inf

    def refresh(self, position_rad: float, velocity_rad_s: float, load: float, tick_ms: int = 0) -> None:
        """Set the registers of present values; it has no register of time."""
        super().refresh(position_rad, velocity_rad_s, load)
        phase = self.get(reg.PHASE)
        if not phase & reg.PHASE_FULL_ANGLE:
            self.put(reg.PRESENT_POSITION, self.get(reg.PRESENT_POSITION) % reg.COUNTS_PER_REVOLUTION)
        self.put(reg.PRESENT_SPEED, round(velocity_rad_s / reg.speed_unit_rad_s(phase)))
        self.put(reg.PRESENT_CURRENT, reg.PRESENT_CURRENT.count(max(-1.0, min(1.0, load)) * STALL_CURRENT_A))
        self.put(reg.MOVING, abs(velocity_rad_s / reg.RAD_PER_COUNT) > _MOVING_COUNTS_PER_S)

    def written(self, register: Register, value: int) -> None:
        """Keep what is written without the lock over a restart; a goal may switch the torque on."""
        if register.eeprom and not self.get(reg.LOCK):
            place = slice(register.address, register.end)
            self._saved = self._saved[: place.start] + register.encode(value) + self._saved[place.stop :]
        if register == reg.GOAL_POSITION and self._goal_wakes:
            self.put(reg.TORQUE_ENABLE, 1)

    def register_write(self, address: int, data: bytes) -> None:
        """Store a REG_WRITE until the next ACTION."""
        super().register_write(address, data)
        self.put(reg.ASYNC_WRITE, 1)

    def action(self) -> tuple[int, bool]:
        """Carry out the stored write, if there is one."""
        self.put(reg.ASYNC_WRITE, 0)
        return super().action()

    def reboot(self) -> None:
        """Restart as after a loss of power, torque off: EEPROM registers as saved, all others at their defaults."""
        self._memory[:] = self._saved
        super().reboot()
        self.put(reg.TORQUE_LIMIT, self.get(reg.MAX_TORQUE))

    def overload(self) -> None:
        """Report the alarms from now on; the motor is off as long as one of them is among the unloading conditions."""
        self.put(reg.STATUS, self._faults)


class StsBus(InstructedBus[StsServo, "StsEmulation"]):
    """Emulated STS3215 servos on a bus, driving a plant; see `InstructedBus`.

    They do not answer an instruction with a wrong checksum, for which the protocol has no error; nor several servos a
    broadcast ping, as their answers would collide.
    """

    family = reg.FAMILY
    wild_counts = (8192, 32768)

    def __init__(self, plant: Plant, *arguments: Any) -> None:
        self._profiles = ProfiledPlant(plant)
        super().__init__(self._profiles, *arguments)

    def make_servo(self, servo_id: int) -> StsServo:
        """Return a servo with this bus's settings."""
        c = self.config
        servo = StsServo(servo_id, c.model_number, c.return_delay_us, c.encoder_counts, c.goal_wakes, c.alarms)
        servo.put(reg.HOMING_OFFSET, c.homing_offset)
        return servo

    def configure(self, servo: Firmware) -> None:
        """Pass a servo's controller settings to the plant if they have changed."""
        super().configure(servo)
        self._profiles.accelerate(servo.servo_id, self.servos[servo.servo_id].acceleration_rad_s2())

    def _ping(self, request: Request, targets: list[StsServo]) -> None:
        """Answer a ping of one servo."""
        if len(targets) == 1:
            super()._ping(request, targets)

    def _status(self, servo: StsServo, error: int, data: bytes) -> bytes:
        """Return the bytes of an answer, with the faults of the settings."""
        sender = servo.servo_id ^ 0x40 if self.happens(self.config.wrong_id) else servo.servo_id
        answer = self.family.form.build_status(sender, error, data)
        return answer[:4] if self.happens(self.config.cut) else answer


@dataclass(frozen=True)
class StsEmulation(BusEmulation):
    """Settings of emulated STS3215 servos on their bus; see `Emulation` for the others.

    Args:
        alarms: The alarms that they report from `overload_after_s` on; bits of the error byte.
        wrong_id: Probability that an answer has the id of another servo.
        cut: Probability that an answer ends after its fourth byte.
        goal_wakes: Whether writing a goal switches the torque on, the worse case for a driver.
        homing_offset: Offset that every servo subtracts from its encoder's count [counts].
    """

    bus_type = StsBus

    model_number: int = 777
    alarms: int = 32
    wrong_id: float = 0.0
    cut: float = 0.0
    goal_wakes: bool = True
    homing_offset: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require({"wrong_id": (0, 1), "cut": (0, 1), "alarms": (1, 127), "homing_offset": (-2047, 2047)})
