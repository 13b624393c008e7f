"""The servo bus: reads and commands DYNAMIXEL X servos in SI units, and takes their torque off at the end."""

from __future__ import annotations

import atexit
import logging
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Final, Self

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.device import Counters, Reading, Transaction, WithoutHost
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.link import BusConfig, BusLink, watchdog_message
from sim2real.hardware.dynamixel.models import model
from sim2real.hardware.dynamixel.off import torque_off_packet, torque_queries
from sim2real.hardware.dynamixel.registers import Register
from sim2real.hardware.guardian import Guardian
from sim2real.hardware.plant import OperatingMode

__all__ = ["BusConfig", "ServoBus"]

_LOGGER = logging.getLogger(__name__)
_STATE_ADDRESS: Final = reg.PRESENT_LOAD.address
_STATE_BYTES: Final = reg.PRESENT_POSITION.end - _STATE_ADDRESS
_STATE_DTYPE: Final = np.dtype([("load", "<i2"), ("velocity", "<i4"), ("position", "<i4")])
_SAFE_REPEATS: Final = 5
_SAFE_PAUSE_S: Final = 0.002


class ServoBus:
    """DYNAMIXEL X servos on one port. All methods may be called from any thread.

    If an answer is missing, the instruction is sent again; a bus that stays silent raises HardwareLost. The torque is
    taken off by `close`, when the context is left, and when the interpreter exits; on a signal only if its handler
    calls `make_safe`. If this process is killed or hangs, the guardian takes the torque off: a separate process that is
    started before torque goes on.

        with ServoBus(BusConfig("/dev/ttyUSB0")) as bus:
            bus.handshake({1: None})
            bus.setup(OperatingMode.PWM)
            bus.torque(True)
            bus.write_goal_pwm({1: 0.1})
            print(bus.read_state().position_rad)

    Args:
        config: Port and limits.

    Raises:
        HardwareLost: The port cannot be opened.
    """

    def __init__(self, config: BusConfig) -> None:
        self.config = config
        self._link = BusLink(config)
        self._ids: tuple[int, ...] = ()
        self._models: tuple[int, ...] = ()
        self._armed = False
        self._torque_off_packet = b""
        self._halted = False
        atexit.register(self.close)

    def __enter__(self) -> Self:
        """Return the open bus."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Take the torque off and close the port."""
        self.close()

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the servos found by `handshake`."""
        return self._ids

    @property
    def counters(self) -> Counters:
        """What went over the bus so far."""
        link = self._link
        late_s = np.array(link.late_us, np.float64) * 1e-6
        counts = link.transactions, link.lost_replies, link.retries, link.late_replies
        return Counters(*counts, late_s, link.withheld)

    @property
    def torque_withheld(self) -> bool:
        """Whether nothing can move a motor; see `withhold_torque`."""
        return self._link.torque_withheld

    @property
    def guardian_pid(self) -> int | None:
        """Process id of the guardian; None before it is started."""
        return None if self._link.guardian is None else self._link.guardian.pid

    def without_host(self) -> tuple[WithoutHost, ...]:
        """Return for each model of servo found what it does by itself when this process dies."""
        kinds: dict[int, list[str]] = {}
        for servo_id, number in zip(self._ids, self._models, strict=True):
            kinds.setdefault(number, []).append(f"servo {servo_id}")
        return tuple(model(n).without_host(self.config.watchdog_s, tuple(motors)) for n, motors in kinds.items())

    def handshake(self, expected: Mapping[int, int | None]) -> dict[int, int]:
        """Find the servos; `torque`, `close` and `make_safe` act on these from now on.

        Args:
            expected: Servo id -> model number; None accepts any model.

        Returns:
            Servo id -> model number found.

        Raises:
            HardwareLost: A servo does not answer, or is another model.
        """
        models = {servo_id: self._ping(servo_id) for servo_id in expected}
        for servo_id, wanted in expected.items():
            if wanted is not None and models[servo_id] != wanted:
                names = [model(number).name for number in (models[servo_id], wanted)]
                raise HardwareLost(
                    f"servo {servo_id} is model {models[servo_id]} ({names[0]}), expected {wanted} ({names[1]})"
                )
        self._ids, self._models = tuple(expected), tuple(models.values())
        self._torque_off_packet = torque_off_packet(self._ids)  # built here, as make_safe must not need any time
        return models

    def scan(self) -> dict[int, int]:
        """Return id -> model number of all servos that answer a broadcast ping; takes 0.8 s at 1 Mbaud."""
        with self._link.hold():
            found, _ = self._link.packets.broadcastPing(self._link.port)
        return {servo_id: model for servo_id, (model, _) in sorted(found.items())}

    def setup(self, mode: OperatingMode) -> None:
        """Take the torque off, set the operating mode, and let the servos answer without delay.

        EEPROM registers are written only if their value differs, as writing wears them out.

        Args:
            mode: The operating mode.
        """
        for servo_id in self._ids:
            self.write(servo_id, reg.TORQUE_ENABLE, 0)
            self.write(servo_id, reg.BUS_WATCHDOG, 0)
            self.write(servo_id, reg.STATUS_RETURN_LEVEL, 2)
            for register, value in ((reg.RETURN_DELAY_TIME, 0), (reg.OPERATING_MODE, int(mode))):
                if self.read(servo_id, register) != value:
                    self.write(servo_id, register, value)

    def withhold_torque(self) -> None:
        """Let nothing pass from now on that could move a motor, for a dry run: neither "torque on" nor any goal.

        There is no way back but to open the bus again. Everything else goes on as it would: watchdog and guardian are
        armed, goals are checked, and a goal that was withheld is what its register seems to hold. In the place of an
        instruction that is withheld its register is read, which takes the bus about as long.

        Raises:
            UsageError: Torque is on.
        """
        if self._armed:
            raise UsageError("torque cannot be withheld: it is on", hint="call withhold_torque before torque(True)")
        self._link.torque_withheld = True

    def torque(self, on: bool) -> None:
        """Switch the torque of all servos on or off.

        Before torque goes on, goals are set to rest: no PWM, no speed, or the present position. The servos' bus
        watchdogs are cleared before torque goes on and armed afterwards. The guardian watches from before torque goes
        on until it is off.

        Args:
            on: Whether to switch it on.

        Raises:
            SafetyStop: `make_safe` or `close` was called before, or the guardian has taken over.
            HardwareLost: A servo does not answer, or the guardian does not start.
        """
        if on and self._halted:
            raise SafetyStop("torque stays off: the bus has been made safe", hint="open the bus again")
        self._armed = False
        guardian = self._link.guardian
        if on:
            self._guard()
        elif guardian is not None and not guardian.settle():
            guardian.disarm()  # it has taken over or died: take the torque off all the same
        for servo_id in self._ids:
            if on:
                self.write(servo_id, reg.BUS_WATCHDOG, 0)
                self._rest_goal(servo_id)
            self.write(servo_id, reg.TORQUE_ENABLE, int(on))
            self.write(servo_id, reg.BUS_WATCHDOG, self.config.watchdog_count if on else 0)
        self._armed = on
        if not on and guardian is not None:
            guardian.disarm()

    def read_state(self, ids: Sequence[int] | None = None) -> Reading:
        """Read position, velocity and load of servos in one transaction.

        Args:
            ids: The servos; None: all.
        """
        ids = self._ids if ids is None else tuple(ids)
        data, transaction = self._read_each(ids, _STATE_ADDRESS, _STATE_BYTES, "read of the state")
        counts = np.frombuffer(data, _STATE_DTYPE)
        return Reading(
            position_rad=counts["position"] * reg.RAD_PER_COUNT,
            velocity_rad_s=counts["velocity"] * reg.RAD_S_PER_COUNT,
            load=counts["load"] / reg.LOAD_FULL_SCALE,
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
        return self._link.read(servo_id, register)

    def write(self, servo_id: int, register: Register, value: int) -> Transaction:
        """Write a register and wait for the servo to confirm it.

        Args:
            servo_id: The servo.
            register: The register.
            value: In counts.
        """
        return self._link.write(servo_id, register, value)

    def check(self) -> None:
        """Raise SafetyStop if a servo's watchdog has tripped, it has restarted, or it has a hardware error.

        To be called every now and then when several servos are commanded at once: they do not confirm their goals, and
        nothing else would show a tripped watchdog or a restart.
        """
        armed = self._armed
        data, _ = self._read_each(self._ids, reg.BUS_WATCHDOG.address, reg.BUS_WATCHDOG.size, "read of bus_watchdog")
        for servo_id, byte in zip(self._ids, data, strict=True):
            count = reg.BUS_WATCHDOG.decode(bytes((byte,)))
            if count == reg.WATCHDOG_TRIPPED:
                raise SafetyStop(*watchdog_message(servo_id))
            # Checked before and after the read: switching the torque in another thread changes the register.
            if armed and self._armed and count != self.config.watchdog_count:
                raise SafetyStop(
                    f"servo {servo_id} has lost its settings: its bus watchdog holds {count}, "
                    f"not {self.config.watchdog_count}",
                    hint="did its supply fail for a moment? its torque is off now",
                )

    def make_safe(self) -> None:
        """Take the torque off without a lock and without waiting for answers: for signal handlers and watchdog threads.

        It takes no lock because the code that a signal interrupts may hold it. The instruction may collide with an
        answer on the wire and be lost, so it is sent five times within 8 ms. Torque cannot be switched on again
        afterwards.
        """
        self._halted = True
        if not self._torque_off_packet or self._link.closed:
            return
        with suppress(OSError):
            for repeat in range(_SAFE_REPEATS):
                time.sleep(_SAFE_PAUSE_S if repeat else 0.0)
                os.write(self._link.port.fd, self._torque_off_packet)

    def close(self) -> None:
        """Take the torque off, disarm the watchdogs, close the port. Never raises; may be called twice.

        If a servo does not confirm, its watchdog stays armed, and the guardian goes on trying for 10 s.
        """
        if self._link.closed:
            return
        self._halted = True
        guardian = self._link.guardian
        if guardian is not None:
            guardian.settle()
        confirmed = True
        for servo_id in self._ids:
            if self._link.force(servo_id, reg.TORQUE_ENABLE, 0):
                self._link.force(servo_id, reg.BUS_WATCHDOG, 0)
            else:
                confirmed = False
                _LOGGER.error("servo %d did not confirm that its torque is off", servo_id)
        self._link.close()
        if guardian is not None:
            guardian.end(confirmed)
        atexit.unregister(self.close)

    def _guard(self) -> None:
        """Let the guardian watch; start it the first time."""
        if not self.config.guardian:
            return
        link = self._link
        if link.guardian is None:
            packets, config = (torque_off_packet(self._ids), torque_queries(self._ids)), self.config
            link.guardian = Guardian(link.port.fd, *packets, config.watchdog_s, config.reply_timeout_s)
        link.guardian.arm()

    def _ping(self, servo_id: int) -> int:
        """Return the model number of a servo; raise HardwareLost if it does not answer."""
        link = self._link
        try:
            return link.exchange(lambda: link.packets.ping(link.port, servo_id), f"ping of servo {servo_id}")[0]
        except HardwareLost as error:
            raise HardwareLost(
                f"servo {servo_id} does not answer on {self.config.port} at {self.config.baud_rate} baud. "
                f"Available: {sorted(self.scan())}",
                hint="check power, cable, id and baud rate; set a USB adapter's latency timer to 1 ms",
            ) from error

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
        return self._link.write_each(register, counts)

    def _read_each(self, ids: tuple[int, ...], address: int, length: int, what: str) -> tuple[bytes, Transaction]:
        """Return a block of each servo's control table, concatenated."""
        if not ids:
            raise UsageError("there are no servos to read", hint="call handshake first")
        return self._link.read_bytes_of(ids, address, length, what)
