"""A Go2's legs as a device, over its low-level interface."""

import atexit
import logging
import os
import sys
import threading
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.device import (
    CommandColumn,
    CommandKind,
    Counters,
    Device,
    Following,
    Reading,
    ReadingPart,
    Transaction,
)
from sim2real.hardware.safety import guardian as guardians
from sim2real.hardware.safety.guardian import Guardian, Motors
from sim2real.hardware.unitree.dds import LEASE_S, Address, DdsLink, StateStream, connect
from sim2real.hardware.unitree.legs import NAMES, TORQUE_NM, LegDrive, command, motors_on, sit_down
from sim2real.hardware.unitree.messages import COMMAND_TOPIC, MOTORS, LowCmd, LowState

PARTS: Final[Mapping[str, ReadingPart]] = MappingProxyType(
    {
        "quaternion": ReadingPart("1", (4,), norm=(0.9, 1.1)),
        "gyro": ReadingPart("rad/s", (3,), -40.0, 40.0),
        "accelerometer": ReadingPart("m/s^2", (3,), -200.0, 200.0),
        "foot_force": ReadingPart("count", (4,), -(2.0**15), 2.0**15),
        "temperature": ReadingPart("degC", (MOTORS,), 0.0, 120.0),
        "battery_voltage": ReadingPart("V", (), 0.0, 60.0),
        "battery_charge": ReadingPart("%", (), 0.0, 100.0),
    }
)
"""Parts of a reading. The quaternion is (w, x, y, z). Sensors of this kind measure up to 35 rad/s and 157 m/s^2. Forces
on feet are counts of the sensors, in the order FR, FL, RR, RL: Unitree documents no unit.
"""
_WEAK_NM, _WEAK_S = 5.0, 0.1
"""By how much a motor's torque may be weaker than commanded [N m], on average over a time [s]."""
_LOGGER = logging.getLogger(__name__)
_FIRST_STATE_S: Final = 5.0
_OPEN_S: Final = 3.0
_DISCOVERY_S: Final = 1.0
"""Time in which DDS discovers the writers of a robot's domain [s]."""
_CONFIRM_S: Final = 1.0
"""Longest time in which motors confirm that they are on, or off [s]."""
_SETTLE_S: Final = 1.5
"""Longest time in which the guardian takes the torque off once the legs have damped [s]."""


class UnitreeLegs(Device):
    """The twelve motors of a Go2, each with a position controller, a velocity controller and a torque.

    The robot publishes its state at 500 Hz without a request; `measure` waits for the next state. A command is
    published once. If commands stop, the guardian, a separate process with its own writer, lets the legs damp, and
    takes the torque off when the robot lies.

    Args:
        port: Network interface and DDS domain, such as ``eth0:0``; see `Address`.
        ids: Places of the motors in the messages, in the order of the joints; each of 0 to 11 once.
        max_silence_s: Time without a state after which the robot is lost [s].

    Attributes:
        armed: Whether commands are published.
        halted: Whether torque stays off because `make_safe` or `close` was called.

    Raises:
        UsageError: A motor is missing, or the port has no domain.
    """

    load_unit = "N m"  # a motor estimates its torque
    parts = PARTS

    def __init__(
        self,
        port: str,
        ids: Sequence[int] = range(MOTORS),
        drive: LegDrive | None = None,
        *,
        silence_s: float = 0.1,
        max_silence_s: float = 0.1,
    ) -> None:
        if sorted(ids) != list(range(MOTORS)):
            raise UsageError(f"motors {list(ids)}: a Go2 has the motors 0 to {MOTORS - 1}, each once")
        self.address, self.drive = Address.parse(port), drive or LegDrive()
        self.silence_s, self._max_silence_s = silence_s, max_silence_s
        self.motors, self._places = tuple(NAMES[i] for i in ids), np.array(ids)
        self.commanded = CommandKind.of_columns(
            "controllers",
            CommandColumn("q", "rad", "hold"),
            CommandColumn("dq", "rad/s", "zero"),
            CommandColumn("kp", "N m/rad", "zero"),
            CommandColumn("kd", "N m s/rad", self.drive.damping),
            CommandColumn("tau", "N m", "zero"),
        )
        self._damp = self.drive.damp()  # built now, because make_safe must not take any time
        self._stream: StateStream | None = None  # the open connection
        self._guardian: Guardian | None = None
        self.armed = self.halted = False
        self._on = self._leaving = False
        self._published = 0
        self._commanding = threading.Lock()

    @property
    def stream(self) -> StateStream:
        """The states of the open connection; raise HardwareLost if it is not open."""
        if self._stream is None:
            raise HardwareLost(f"the robot on {self.address} is not open", hint="call open first")
        return self._stream

    @property
    def counters(self) -> Counters:
        return Counters() if self._stream is None else self._stream.counters(self._published)

    def open(self) -> None:
        """Connect, wait for states, and lay the robot down if its motors are on.

        Raises:
            HardwareLost: The interface does not exist, the robot is silent, or another program publishes commands.
        """
        if self._stream is not None:
            raise UsageError("the robot is open already", hint="close it first")
        self.armed = self.halted = self._on = self._leaving = False
        self._published = 0
        mark = f"sim2real {uuid.uuid4().hex[:8]} of process {os.getpid()}"
        robot = connect(self.address, mark)
        self.clock = robot.clock
        try:
            # The robot must send states, and no other program may command the motors.
            stream = StateStream(robot, self._max_silence_s)
            state = stream.begin(_OPEN_S)
            # If motors are on, a program commands them, perhaps one that DDS has not discovered yet: damping would lay
            # the         # robot down. A killed program counts as a writer until its lease ends.
            self._wait(_DISCOVERY_S if motors_on(state) else 0.0, lambda: bool(robot.other_writers()))
            self._wait(LEASE_S + 1.0, lambda: not robot.other_writers())
            _require_alone(robot, HardwareLost)
            # A program that was killed without a guardian may have left the motors on.
            if motors_on(state) and (failure := sit_down(robot, self.drive, _CONFIRM_S)):
                raise HardwareLost(failure, hint="switch the robot off")
        except BaseException:
            robot.close()
            raise
        self._stream = stream
        atexit.register(self.close)

    def without_host(self) -> tuple[str, ...]:
        """Return the worst reaction of a motor of the GO family (unitree_actuator_sdk, issue 29); not measured."""
        return (f"Go2 ({', '.join(self.motors)}) goes on as commanded last (no other reaction is documented)",)

    def facts(self) -> dict[str, dict[str, str]]:
        # The robot sends 0 for versions that it does not report.
        record = self.stream.next()[0].record
        bms = record["bms_state"]
        numbers = {"LowState": record["version"].tolist(), "battery": [bms["version_high"], bms["version_low"]]}
        versions = {name: ".".join(map(str, pair)) for name, pair in numbers.items() if any(pair)}
        warm = record["motor_state"]["temperature"][self._places].tolist()
        return {
            **({"firmware": versions} if versions else {}),
            "voltage": {"battery": f"{float(record['power_v']):.1f} V"},
            "temperature": {motor: f"{celsius} °C" for motor, celsius in zip(self.motors, warm, strict=True)},
        }

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.drive.reach
        return low[self._places], high[self._places]

    def enable(self) -> np.ndarray:
        """Start the guardian, and let all motors damp; see `Device.enable`."""
        rest = np.zeros((MOTORS, 5))
        low, high = self.reach()
        # A robot that lies may rest on the stops of its joints, a little beyond their range.
        rest[:, 0] = np.clip(self.measure().position_rad, low[:, 0], high[:, 0])
        rest[:, 3] = self.drive.damping
        self._switch_on(self._message(rest))
        return rest

    def following(self) -> Following:
        """Return by how much a motor's torque may be weaker than its law."""
        return Following(_WEAK_NM, _WEAK_S, source="the motors' own torques", most_nm=TORQUE_NM[self._places])

    def measure(self) -> Reading:
        """Wait for the next state: positions [rad], speeds [rad/s], estimated torques [N m], and `PARTS`."""
        # If the guardian has taken over, it is the reason for silence and for torque that is off.
        self._beat()
        armed = self.armed
        try:
            state, transaction = self.stream.next()
        except HardwareLost:
            self.require_watching()
            raise
        if armed and (off := set(NAMES) - set(motors_on(state))) and self.armed:
            self.require_watching()
            raise SafetyStop(f"{', '.join(sorted(off))} took the torque off", hint="look at the temperatures")
        return self._reading(state, transaction)

    def command(self, values: np.ndarray) -> Transaction:
        """Publish q, dq, kp, kd and tau of all motors, ``(12, 5)``.

        Raises:
            SafetyStop: A value is not finite or beyond the reach, the torque is off, or the guardian has taken over.
        """
        called_ns = self.clock.now_ns()
        self._require_possible(values)
        message = self._message(values)
        with self._commanding:
            begin_ns = self.clock.now_ns()
            if self.halted or not self.armed:
                raise SafetyStop("no command is sent: the torque is off", hint="enable it, or open the robot again")
            self._beat()
            self.stream.robot.write(message)
            if self.halted:  # `make_safe` takes no lock: this command may have been published after it
                self.make_safe()
            self._published += 1
            return Transaction(begin_ns, begin_ns - called_ns, self.clock.now_ns() - begin_ns, 0)

    def check(self) -> None:
        """Raise SafetyStop if another program publishes commands too."""
        if self.armed:
            _require_alone(self.stream.robot, SafetyStop)

    def require_watching(self) -> None:
        if self.armed and self._guardian is not None:
            self._guardian.require_watching()

    def disable(self) -> None:
        """Let the legs damp until they are still, at most `LegDrive.lie_s`; then torque off, confirmed."""
        robot, guardian = self.stream.robot, self._guardian
        with self._commanding:  # let a command that is being published finish
            self.armed = False
        if self._on and guardian is not None:
            if failure := self._lie_down(robot, guardian):
                raise HardwareLost(failure, hint="switch the robot off")
            guardian.disarm()

    def make_safe(self) -> None:
        """Let all motors damp now; the guardian takes their torque off when the robot lies. Never raises."""
        self.halted, self.armed = True, False
        stream, guardian = self._stream, self._guardian
        if stream is None or guardian is None or not self._on or self._leaving:
            return
        with suppress(Exception):
            stream.robot.write(self._damp)
        guardian.trip()

    def close(self) -> None:
        """Lay the robot down and disconnect. Never raises; if the motors do not confirm, the guardian goes on."""
        stream, guardian = self._stream, self._guardian
        if stream is None:
            return
        robot = stream.robot
        self.halted, self.armed = True, False
        # Let a command that is being published finish; a signal handler may have interrupted it, so do not wait long.
        if self._commanding.acquire(timeout=_CONFIRM_S):
            self._commanding.release()
        self._leaving = True
        if guardian is not None:
            failure = self._lie_down(robot, guardian) if self._on else ""
            if failure:
                _LOGGER.error("the torque may be on: %s", failure)
            guardian.end(confirmed=not failure)
        robot.close()
        self._stream = self._guardian = None
        self._on = False
        atexit.unregister(self.close)

    def _switch_on(self, message: LowCmd) -> None:
        """Start the guardian, and publish a command until a state shows every motor on."""
        robot = self.stream.robot
        if self.halted:
            raise SafetyStop("torque stays off: the legs have been made safe", hint="open the robot again")
        # The guardian watches before the first command.
        if self._guardian is None:
            self._guardian = robot.guardian(self.drive, self.silence_s, self.drive.lie_s + _SETTLE_S)
        _require_alone(robot, SafetyStop)
        self._guardian.arm()
        # Commands may be lost, so send one after each state until all motors are on.
        with self._commanding:
            self._on, end_s = True, self._now_s() + _CONFIRM_S
            try:
                while not self.halted:
                    robot.write(message)
                    off = set(NAMES) - set(motors_on(self.stream.next()[0]))
                    if not off:
                        self.armed = True
                        break
                    if self._now_s() > end_s:
                        raise HardwareLost(
                            f"{', '.join(sorted(off))} did not switch on for {_CONFIRM_S:g} s",
                            hint="look at the robot's temperatures and battery",
                        )
                    self._guardian.beat()
            finally:
                if self.halted:
                    self.make_safe()

    def _lie_down(self, robot: DdsLink, guardian: Guardian) -> str:
        """Lay the robot down; return the failure or "". If the guardian has taken over, let it finish first."""

        def live() -> None:
            with suppress(SafetyStop):  # the guardian takes over, or has died: go on all the same
                guardian.beat()

        guardian.settle()
        drive = replace(self.drive, lie_s=0.0) if guardian.took_over else self.drive
        try:
            failure = sit_down(robot, drive, _CONFIRM_S, live)
        except Exception as error:  # whatever went wrong, the guardian goes on
            failure = f"{type(error).__name__}: {error}"
        self._on = bool(failure)
        return failure

    def _beat(self) -> None:
        """Give the guardian a sign of life; raise SafetyStop if it has taken over, or has died."""
        if self.armed and self._guardian is not None:
            self._guardian.beat()

    def _wait(self, longest_s: float, until: Callable[[], bool]) -> None:
        end_s = self._now_s() + longest_s
        while not until() and self._now_s() < end_s:
            self.clock.sleep(0.05)

    def _now_s(self) -> float:
        return 1e-9 * self.clock.now_ns()

    def _message(self, values: np.ndarray) -> LowCmd:
        columns = np.empty((MOTORS, 5))
        columns[self._places] = values
        return command(columns)

    def _reading(self, state: LowState, transaction: Transaction) -> Reading:
        record = state.record
        motor, imu = record["motor_state"][self._places], record["imu_state"]
        position, velocity, load = (motor[name].astype(np.float64) for name in ("q", "dq", "tau_est"))
        if not np.isfinite(position + velocity).all():
            raise SafetyStop("an angle or a speed in the robot's state is not a number", hint="start the robot again")
        parts = {
            "quaternion": imu["quaternion"],
            "gyro": imu["gyroscope"],
            "accelerometer": imu["accelerometer"],
            "foot_force": record["foot_force"],
            "temperature": motor["temperature"],
            "battery_voltage": record["power_v"],
            "battery_charge": record["bms_state"]["soc"],
        }
        parts = {name: np.asarray(values, np.float64) for name, values in parts.items()}
        return Reading(position, velocity, load, transaction, parts, int(record["tick"]))

    def _require_possible(self, values: np.ndarray) -> None:
        low, high = self.reach()
        bad = np.argwhere(~((values >= low) & (values <= high)))  # NaN is in no range
        if bad.size:
            row, column = bad[0].tolist()
            raise SafetyStop(
                f"{self.motors[row]}: {self.commanded.columns[column].name} = {values[row, column]:.6g} is outside "
                f"[{low[row, column]:.6g}, {high[row, column]:.6g}]"
            )


def _require_alone(robot: DdsLink, kind: type[HardwareLost] | type[SafetyStop]) -> None:
    if others := robot.other_writers():
        raise kind(
            f"another program publishes {COMMAND_TOPIC}: {', '.join(others)}. The motors would follow both",
            hint="end that program, or switch the robot's motion service off: in the app, or with MotionSwitcher",
        )


def motors_of(robot: DdsLink, drive: LegDrive) -> Motors:
    """Return the legs for a guardian; once their torque was off, another program may command the robot."""

    def take_torque_off() -> str:
        try:
            return sit_down(robot, drive, guardians.GIVE_UP_S)
        except HardwareLost as error:
            return str(error)

    return Motors(take_torque_off, robot.clock, "switch the robot off", at_rest=False, close=robot.close)


def guarded(address: str, mark: str, damping: str, lie_s: str) -> Motors:
    """Connect from the guardian's process; return the legs once their states come."""
    robot = DdsLink(Address.parse(address), mark)
    if robot.next_state(_FIRST_STATE_S) is None:
        sys.exit(f"sim2real guardian: the robot on {address} sends no state")
    return motors_of(robot, LegDrive(damping=float(damping), lie_s=float(lie_s), kd_max=float(damping)))


def legs(port: str, ids: Sequence[int], drive: Any, *, baud_rate: int, silence_s: float) -> UnitreeLegs:
    """Return the legs of a Go2, not opened yet: the device of the name ``unitree``; see ``load_device``."""
    del baud_rate  # a network has no baud rate
    return UnitreeLegs(port, ids, drive, silence_s=silence_s, max_silence_s=max(0.1, silence_s))
