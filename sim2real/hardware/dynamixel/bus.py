"""The bus of DYNAMIXEL X servos: reads and commands them in SI units, and takes their torque off at the end."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError, UsageError
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.packets import BROADCAST_ID, Answer, Instruction
from sim2real.hardware.bus.port import LinkConfig
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.bus.servos import GuardedServos
from sim2real.hardware.device import OperatingMode, Reading, Transaction
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.models import model
from sim2real.hardware.dynamixel.protocol import ALERT_BIT, PROTOCOL, StatusError

_STATE: Final = (reg.PRESENT_LOAD, reg.PRESENT_VELOCITY, reg.PRESENT_POSITION)
_REASONS: Final[dict[int, str]] = {
    StatusError.RESULT_FAIL: "it failed to carry it out",
    StatusError.INSTRUCTION: "the instruction is unknown to it",
    StatusError.CRC: "the instruction arrived with a wrong checksum",
    StatusError.DATA_RANGE: "the value is out of the register's range",
    StatusError.DATA_LENGTH: "the data are shorter than the register",
    StatusError.DATA_LIMIT: "the value is beyond a limit set in the servo",
    StatusError.ACCESS: "the register cannot be written or read now (EEPROM registers: not while torque is on)",
}
_SCAN_S: Final = 0.8
"""Time for all answers to a broadcast ping: each servo waits 3 ms for each id before its own."""


@dataclass(frozen=True)
class BusConfig(LinkConfig):
    """Port and time limits of a bus of DYNAMIXEL servos; see `LinkConfig`.

    The servos' bus watchdogs are set to `silence_s`, in multiples of 20 ms. The reaction of a servo to a
    tripped watchdog depends on its model: `sim2real.hardware.dynamixel.models`.
    """

    family = "DYNAMIXEL"
    baud_rates = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
    longest_silence_s = reg.WATCHDOG_MAX_COUNT * reg.WATCHDOG_UNIT_S

    @property
    def watchdog_count(self) -> int:
        """Value of the register Bus Watchdog: `silence_s` in units of 20 ms, at least 1 unless it is 0 (off)."""
        return max(1, round(self.silence_s / reg.WATCHDOG_UNIT_S)) if self.silence_s > 0.0 else 0


class BusLink(ServoLink):
    """Owner of the port of DYNAMIXEL servos; see `ServoLink`."""

    form = PROTOCOL
    table = reg.TABLE
    ping_bytes = 3  # model number and firmware version

    def scan(self) -> list[int]:
        """Return the ids of all servos that answer a broadcast ping; takes 0.8 s."""
        return self.answering(PROTOCOL.build(BROADCAST_ID, Instruction.PING), _SCAN_S)

    def require_fine(self, answer: Answer, what: str) -> None:
        """Raise the error that an answer reports: SafetyStop if the servo has stopped itself."""
        servo_id, error = answer.servo_id, answer.error
        # The alert bit and the watchdog mean that the motor has stopped; other errors concern this instruction.
        if error & ALERT_BIT:
            bits = self.read(servo_id, reg.HARDWARE_ERROR_STATUS, despite_error=True)
            raise SafetyStop(
                f"servo {servo_id} has stopped itself: {reg.describe_hardware_errors(bits)}",
                hint="remove the cause, then reboot the servo",
            )
        if self.read(servo_id, reg.BUS_WATCHDOG, despite_error=True) == reg.WATCHDOG_TRIPPED:
            raise SafetyStop(*watchdog_message(servo_id))
        raise Sim2RealError(f"servo {servo_id} refused {what}: {_REASONS.get(error, f'error {error}')}")


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
        """Find the servos, on which `torque`, `close` and `make_safe` act from now on; return id -> model number.

        Args:
            expected: Servo id -> model number; None accepts any model.

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
        watchdogs are cleared before, and armed afterwards. The guardian watches while torque is on.

        Raises:
            SafetyStop: `make_safe` or `close` was called before, or the guardian has taken over.
            HardwareLost: A servo does not answer, or the guardian does not start.
        """
        if on:
            self._torque_on()
            return
        self.disable()

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

        Several servos do not confirm their common goals, and a restarted one takes goals with its torque off.
        Every answer reports hardware errors. The check of three servos takes 0.53 ms at 1 Mbaud.
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
        for servo_id in self.ids:
            # A tripped watchdog refuses goals, so it is cleared first and armed last.
            self.write(servo_id, reg.BUS_WATCHDOG, 0)
            self._rest_goal(servo_id)
            self.write(servo_id, reg.TORQUE_ENABLE, 1)
            self.write(servo_id, reg.BUS_WATCHDOG, self.config.watchdog_count)
        self.switched_on()

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
        # Refuse every goal before any is sent.
        for servo_id, goal in goals.items():
            if not math.isfinite(goal) or abs(goal) > limit:
                raise SafetyStop(f"{register.name} of servo {servo_id}: {goal} is outside [-{limit:.6g}, {limit:.6g}]")
        # One servo confirms its goal; several share one instruction without answers.
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


def watchdog_message(servo_id: int) -> tuple[str, str]:
    """Return the message and the hint for a servo whose bus watchdog has tripped."""
    return (
        f"the bus watchdog of servo {servo_id} has tripped: no instruction came for longer than silence_s",
        "is this computer too busy, or does a loop stall? switching torque on again clears it",
    )
