"""The servo bus: reads and commands DYNAMIXEL X servos in SI units, and takes their torque off at the end."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.bus.servos import GuardedServos
from sim2real.hardware.device import Reading, Transaction
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.link import BusConfig, BusLink, watchdog_message
from sim2real.hardware.dynamixel.models import model
from sim2real.hardware.plant import OperatingMode

__all__ = ["BusConfig", "ServoBus"]

_STATE: Final = (reg.PRESENT_LOAD, reg.PRESENT_VELOCITY, reg.PRESENT_POSITION)


class ServoBus(GuardedServos[BusLink]):
    """DYNAMIXEL X servos on one port; see `GuardedServos`. All methods may be called from any thread.

    If an answer is missing, the instruction is sent again; a bus that stays silent raises HardwareLost.

        with ServoBus(BusConfig("/dev/ttyUSB0")) as bus:
            bus.handshake({1: None})
            bus.setup(OperatingMode.PWM)
            bus.torque(True)
            bus.write_goal_pwm({1: 0.1})
            print(bus.read_state().position_rad)

    Args:
        ids: The servos' ids; `handshake` sets them too.
    """

    config: BusConfig
    link_type = BusLink

    def handshake(self, expected: Mapping[int, int | None]) -> dict[int, int]:
        """Find the servos; `torque`, `close` and `make_safe` act on these from now on.

        Args:
            expected: Servo id -> model number; None accepts any model.

        Returns:
            Servo id -> model number found.

        Raises:
            HardwareLost: A servo does not answer, or is another model.
        """
        models = {i: reg.MODEL_NUMBER.decode(self.find(i)[:2]) for i in expected}
        for servo_id, wanted in expected.items():
            if wanted is not None and models[servo_id] != wanted:
                names = [model(number).name for number in (models[servo_id], wanted)]
                raise HardwareLost(
                    f"servo {servo_id} is model {models[servo_id]} ({names[0]}), expected {wanted} ({names[1]})"
                )
        self.models = {servo_id: model(number) for servo_id, number in models.items()}
        self.watch(tuple(expected))
        return models

    def setup(self, mode: OperatingMode) -> None:
        """Take the torque off, set the operating mode, and let the servos answer without delay.

        EEPROM registers are written only if their value differs, as writing wears them out.
        """
        for servo_id in self.ids:
            self.write(servo_id, reg.TORQUE_ENABLE, 0)
            self.write(servo_id, reg.BUS_WATCHDOG, 0)
            self.write(servo_id, reg.STATUS_RETURN_LEVEL, 2)
            for register, value in ((reg.RETURN_DELAY_TIME, 0), (reg.OPERATING_MODE, int(mode))):
                if self.read(servo_id, register) != value:
                    self.write(servo_id, register, value)

    def torque(self, on: bool) -> None:
        """Switch the torque of all servos on or off.

        Before torque goes on, goals are set to rest: no PWM, no speed, or the present position. The servos' bus
        watchdogs are cleared before torque goes on and armed afterwards. The guardian watches from before torque goes
        on until it is off.

        Raises:
            SafetyStop: `make_safe` or `close` was called before, or the guardian has taken over.
            HardwareLost: A servo does not answer, or the guardian does not start.
        """
        if on:
            self._torque_on()
            return
        with self.unguarded():
            for servo_id in self.ids:
                self.write(servo_id, reg.TORQUE_ENABLE, 0)
                self.write(servo_id, reg.BUS_WATCHDOG, 0)

    def read_state(self, ids: Sequence[int] | None = None) -> Reading:
        """Read position, velocity and load of servos in one transaction.

        Args:
            ids: The servos; None: all.
        """
        ids = self.ids if ids is None else tuple(ids)
        counts, transaction = self._read_each(ids, _STATE, "read of the state")
        return Reading(
            position_rad=counts[:, 2] * reg.RAD_PER_COUNT,
            velocity_rad_s=counts[:, 1] * reg.RAD_S_PER_COUNT,
            load=counts[:, 0] / reg.LOAD_FULL_SCALE,
            transaction=transaction,
        )

    def write_goal_pwm(self, goals: Mapping[int, float]) -> Transaction:
        """Command PWM, as fractions of the supply voltage.

        A single servo confirms its goal. Several get their goals in one instruction, which they do not answer.

        Args:
            goals: Servo id -> fraction in [-1, 1].

        Raises:
            SafetyStop: A goal is not finite or out of range, or the servo's watchdog has tripped.
        """
        return self._write_goals(reg.GOAL_PWM, goals, reg.pwm_from_fraction, 1.0)

    def write_goal_velocity(self, goals: Mapping[int, float]) -> Transaction:
        """Command speeds [rad/s] by servo id; otherwise like `write_goal_pwm`."""
        return self._write_goals(
            reg.GOAL_VELOCITY, goals, reg.count_from_rad_s, reg.rad_s_from_count(reg.GOAL_VELOCITY.maximum)
        )

    def write_goal_position(self, goals: Mapping[int, float]) -> Transaction:
        """Command positions [rad from each encoder's zero] by servo id; otherwise like `write_goal_pwm`."""
        return self._write_goals(
            reg.GOAL_POSITION, goals, reg.count_from_rad, reg.rad_from_count(reg.GOAL_POSITION.maximum)
        )

    def read(self, servo_id: int, register: Register) -> int:
        """Return a register's value in counts."""
        return self.link.read(servo_id, register)

    def write(self, servo_id: int, register: Register, value: int) -> Transaction:
        """Write a register and wait for the servo to confirm it."""
        return self.link.write(servo_id, register, value)

    def check(self) -> None:
        """Raise SafetyStop if a servo's watchdog has tripped, it has restarted, or it has a hardware error.

        To be called every now and then: servos that are commanded at once do not confirm their goals, and one that has
        restarted takes goals, with its torque off. Hardware errors need no look: every answer tells of them. For three
        servos at 1 Mbaud it is 53 bytes, 0.53 ms; with the emulator it took 0.74 ms, a state 1.06 ms.
        """
        armed = self.armed
        counts, _ = self._read_each(self.ids, (reg.BUS_WATCHDOG,), "read of bus_watchdog")
        for servo_id, count in zip(self.ids, counts[:, 0].tolist(), strict=True):
            if count == reg.WATCHDOG_TRIPPED:
                raise SafetyStop(*watchdog_message(servo_id))
            # Checked before and after the read: switching the torque in another thread changes the register.
            if armed and self.armed and count != self.config.watchdog_count:
                raise SafetyStop(
                    f"servo {servo_id} has lost its settings: its bus watchdog holds {count}, "
                    f"not {self.config.watchdog_count}",
                    hint="did its supply fail for a moment? its torque is off now",
                )

    def release(self, servo_id: int) -> bool:
        """Take a servo's torque off, and its watchdog if it has confirmed that; otherwise that stays armed."""
        confirmed = super().release(servo_id)
        if confirmed:
            self.link.force(servo_id, reg.BUS_WATCHDOG, 0)
        return confirmed

    def _torque_on(self) -> None:
        self.armed = False
        self.guard()
        try:
            for servo_id in self.ids:
                self.write(servo_id, reg.BUS_WATCHDOG, 0)
                self._rest_goal(servo_id)
                self.write(servo_id, reg.TORQUE_ENABLE, 1)
                self.write(servo_id, reg.BUS_WATCHDOG, self.config.watchdog_count)
            self.armed = True
        finally:
            self.stop_if_halted()

    def _rest_goal(self, servo_id: int) -> None:
        mode = self.read(servo_id, reg.OPERATING_MODE)
        if mode == OperatingMode.PWM:
            self.write(servo_id, reg.GOAL_PWM, 0)
        elif mode == OperatingMode.VELOCITY:
            self.write(servo_id, reg.GOAL_VELOCITY, 0)
        else:
            self.write(servo_id, reg.GOAL_POSITION, self.read(servo_id, reg.PRESENT_POSITION))

    def _write_goals(
        self, register: Register, goals: Mapping[int, float], to_count: Callable[[float], int], limit: float
    ) -> Transaction:
        for servo_id, goal in goals.items():
            if not math.isfinite(goal) or abs(goal) > limit:
                raise SafetyStop(f"{register.name} of servo {servo_id}: {goal} is outside [-{limit:.6g}, {limit:.6g}]")
        counts = {servo_id: to_count(goal) for servo_id, goal in goals.items()}
        if len(counts) == 1:
            ((servo_id, count),) = counts.items()
            return self.write(servo_id, register, count)
        return self.link.write_each(register, counts)

    def _read_each(
        self, ids: tuple[int, ...], registers: tuple[Register, ...], what: str
    ) -> tuple[np.ndarray, Transaction]:
        if not ids:
            raise UsageError("there are no servos to read", hint="call handshake first")
        return self.link.read_counts(ids, registers, what)
