"""Feetech STS servos as a device: joints in position mode, behind the contract of `sim2real.hardware.device`."""

from __future__ import annotations

import atexit
import logging
import math
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.device import POSITION, Alone, CommandKind, Counters, Device, Reading, Transaction, WithoutHost
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.calibration import CalibratedJoint
from sim2real.hardware.feetech.drive import StsDrive
from sim2real.hardware.feetech.link import StsConfig, StsLink
from sim2real.hardware.feetech.off import torque_off_packet, torque_queries
from sim2real.hardware.guardian import Guardian

_LOGGER = logging.getLogger(__name__)
MODELS: Final[dict[int, str]] = {777: "STS3215", 2825: "STS3250"}
"""Model number -> name, of servos with this memory table (LeRobot's tables.py)."""
_SOURCE: Final = "Feetech, STS Series Servo Memory Table: no register for it; not measured by us"
_STATE: Final = (reg.PRESENT_POSITION, reg.PRESENT_SPEED, reg.PRESENT_LOAD)
_SAFE_REPEATS: Final = 5
_SAFE_PAUSE_S: Final = 0.002
_SCANNED: Final = 20
"""Ids that are looked for if a servo does not answer; all 254 would take 2 s."""
_BEYOND_RAD: Final = 0.1
"""How far outside its range a joint may be when torque goes on [rad]; it is pulled back to the end of the range."""


class StsServos(Device):
    """STS servos on one port, each moving one joint, commanded in joint angles [rad].

    No register is made permanent: settings are written while the servos' lock is on, so they last until the power goes,
    and are written again by `enable`. A servo does not say that it refuses a value, so every setting is read back.

    These servos have no watchdog: if this process dies they hold, or go on to, the last goal. The guardian takes their
    torque off, a process of its own that is started before torque goes on.

    Args:
        bus: Port and limits of the bus.
        joints: The joints, each with the servo that moves it; `read_calibration` makes them of LeRobot's file.
        drive: How the servos follow a position; its joints do not matter here.

    Raises:
        UsageError: There are no joints, or two with one servo.
    """

    def __init__(self, bus: StsConfig, joints: Sequence[CalibratedJoint], drive: StsDrive | None = None) -> None:
        self.config = bus
        self.joints = tuple(joints)
        self._ids = tuple(joint.servo_id for joint in joints)
        if not joints or len(set(self._ids)) < len(self._ids):
            raise UsageError(f"servos {list(self._ids)}: there must be at least one, each with an id of its own")
        self._drive = drive or StsDrive()
        self._zero = np.array([joint.zero_count for joint in joints])
        self._scale = np.array([joint.rad_per_count for joint in joints])
        self._link: StsLink | None = None
        self._off = torque_off_packet(self._ids)  # built here, as make_safe must not need any time
        self._models: dict[int, str] = {}
        self._unit_rad_s = np.ones(len(joints))
        self._phases: dict[int, int] = {}
        self._rest = np.zeros(len(joints))
        self._armed = False
        self._halted = False

    @property
    def motors(self) -> tuple[str, ...]:
        """Names of the motors."""
        return tuple(f"servo {i}" for i in self._ids)

    @property
    def commanded(self) -> CommandKind:
        """Positions."""
        return POSITION

    @property
    def silence_s(self) -> float:
        """Longest time without an instruction while torque is on [s]."""
        return self.config.silence_s

    @property
    def guardian_pid(self) -> int | None:
        """Process id of the guardian; None before it is started."""
        guardian = self._link.guardian if self._link is not None else None
        return None if guardian is None else guardian.pid

    @property
    def torque_withheld(self) -> bool:
        """Whether nothing can move a motor; see `withhold_torque`."""
        return self._link is not None and self._link.torque_withheld

    @property
    def counters(self) -> Counters:
        """What went over the bus so far."""
        link = self._link
        if link is None:
            return Counters()
        late_s = np.array(link.late_us, np.float64) * 1e-6
        return Counters(link.transactions, link.lost_replies, link.retries, link.late_replies, late_s, link.withheld)

    def open(self) -> None:
        """Connect, find the servos, take their torque off and write their settings."""
        if self._link is not None and not self._link.closed:
            raise UsageError("the servos are open already", hint="close them first")
        self._armed = self._halted = False
        self._link = link = StsLink(self.config)
        atexit.register(self.close)
        try:
            for joint in self.joints:
                self._find(link, joint)
                self._force_off(joint.servo_id)
                self._prepare(link, joint)
        except BaseException:
            self.close()
            raise

    def without_host(self) -> tuple[WithoutHost, ...]:
        """Return what the servos do when this process dies: they go on, as they have no watchdog."""
        why = "it has no bus watchdog"
        return tuple(
            WithoutHost(
                name,
                tuple(f"servo {i}" for i, n in self._models.items() if n == name),
                Alone.GOES_ON,
                math.inf,
                _SOURCE,
                why,
            )
            for name in dict.fromkeys(self._models.values())
        )

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest angles that the joints may be sent to [rad], each ``(n,)``."""
        low, high = np.array([joint.range_rad for joint in self.joints]).T
        return low, high

    def withhold_torque(self) -> None:
        """Move nothing from now on, for a dry run; see `Device.withhold_torque`."""
        if self._armed:
            raise UsageError("torque cannot be withheld: it is on", hint="call withhold_torque before enable")
        self._opened().torque_withheld = True

    def enable(self) -> None:
        """Write settings and goals, the present positions, and switch the torque on; see `Device.enable`."""
        if self._halted:
            raise SafetyStop("torque stays off: the servos have been made safe", hint="open them again")
        link = self._opened()
        if self.config.guardian:
            if link.guardian is None:
                packets = self._off, torque_queries(self._ids)
                link.guardian = Guardian(link.fd, *packets, self.config.silence_s, self.config.reply_timeout_s)
            link.guardian.arm()
        goals = []
        try:
            for joint in self.joints:
                self._write_settings(link, joint.servo_id)
                goals.append(self._rest_count(joint, link.read(joint.servo_id, reg.PRESENT_POSITION)))
                # Before torque goes on; some firmware may switch it on by itself at this moment, where it stands.
                link.set(joint.servo_id, reg.GOAL_POSITION, goals[-1])
                link.write(joint.servo_id, reg.TORQUE_ENABLE, 1)
            self._rest = (np.array(goals) - self._zero) * self._scale
            self._armed = True
        finally:
            self._stop_if_halted()

    def rest(self) -> np.ndarray:
        """Return the angles that the servos hold since `enable` [rad], ``(n,)``."""
        return self._rest.copy()

    def measure(self) -> Reading:
        """Read angles [rad], speeds [rad/s] and loads, fractions of the largest, of all joints."""
        begin, end = _STATE[0].address, _STATE[-1].end
        blocks, transaction = self._opened().read_each(self._ids, begin, end - begin, "read of the state")
        counts = np.array([[r.decode(b[r.address - begin : r.end - begin]) for r in _STATE] for b in blocks], float)
        sign = np.sign(self._scale)
        gear = np.abs(self._scale) / reg.RAD_PER_COUNT
        return Reading(
            position_rad=(counts[:, 0] - self._zero) * self._scale,
            velocity_rad_s=counts[:, 1] * self._unit_rad_s * sign * gear,
            load=counts[:, 2] / reg.LOAD_FULL_SCALE * sign,
            transaction=transaction,
        )

    def command(self, values: np.ndarray) -> Transaction:
        """Send angles [rad], ``(n,)``; one servo confirms its goal, several get them in one instruction.

        Raises:
            SafetyStop: An angle is not finite or outside the joint's range, a servo reports an alarm, or torque is off.
        """
        if self._halted:  # a goal could switch the torque on again
            raise SafetyStop("nothing is sent: the servos have been made safe", hint="open them again")
        goals = {}
        for joint, angle in zip(self.joints, values.tolist(), strict=True):
            count = joint.count(angle) if math.isfinite(angle) else -1
            if not joint.low_count <= count <= joint.high_count:
                low, high = joint.range_rad
                raise SafetyStop(f"joint {joint.name!r}: {angle:.6g} rad is outside [{low:.6g}, {high:.6g}]")
            goals[joint.servo_id] = count
        link = self._opened()
        try:
            if len(goals) == 1:
                return link.write(self._ids[0], reg.GOAL_POSITION, goals[self._ids[0]])
            return link.write_each(reg.GOAL_POSITION, goals)
        finally:
            self._stop_if_halted()

    def effort(self, command: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
        """Return the duty that the P gain computes from the position error, ignoring the profile."""
        gear = np.abs(self._scale) / reg.RAD_PER_COUNT
        most = self._drive.torque
        return np.clip((command - position_rad) / gear * self._drive.p_gain * reg.P_GAIN_UNIT_PER_RAD, -most, most)

    def check(self) -> None:
        """Raise SafetyStop if a servo has lost its settings, or its torque is not as it was left."""
        armed = self._armed
        if not armed or self.torque_withheld:
            return
        begin, end = reg.TORQUE_ENABLE.address, reg.TORQUE_LIMIT.end
        blocks, _ = self._opened().read_each(self._ids, begin, end - begin, "read of the settings")
        for servo_id, block in zip(self._ids, blocks, strict=True):
            expected = {reg.TORQUE_ENABLE: 1, **self._drive.registers(self._phases[servo_id])}
            for register, value in expected.items():
                if not begin <= register.address < end:
                    continue
                found = register.decode(block[register.address - begin : register.end - begin])
                if found != value and self._armed:  # once more: another thread may have taken the torque off
                    raise SafetyStop(
                        f"servo {servo_id} has lost its settings: {register.name} is {found}, not {value}",
                        hint="did its supply fail for a moment?",
                    )

    def disable(self) -> None:
        """Switch the torque off, confirmed by every servo."""
        link = self._opened()
        self._armed = False
        guardian = link.guardian
        if guardian is not None and not guardian.settle():
            guardian.disarm()  # it has taken over or died: take the torque off all the same
        for servo_id in self._ids:
            self._force_off(servo_id)
        if guardian is not None:
            guardian.disarm()

    def make_safe(self) -> None:
        """Take the torque off without a lock and without waiting for answers; see `Device.make_safe`.

        The instruction may collide with an answer on the wire and be lost, so it is sent five times within 8 ms.
        """
        self._halted = True
        self._armed = False
        link = self._link
        if link is None or link.closed:
            return
        with suppress(OSError):
            for repeat in range(_SAFE_REPEATS):
                time.sleep(_SAFE_PAUSE_S if repeat else 0.0)
                os.write(link.fd, self._off)

    def close(self) -> None:
        """Take the torque off and close the port; if a servo does not confirm, the guardian goes on trying for 10 s."""
        link = self._link
        if link is None or link.closed:
            return
        self._halted, self._armed = True, False
        guardian = link.guardian
        if guardian is not None:
            guardian.settle()
        left = [servo_id for servo_id in self._models if not link.force(servo_id, reg.TORQUE_ENABLE, 0)]
        if left:
            _LOGGER.error("servos %s did not confirm that their torque is off", left)
        link.close()
        if guardian is not None:
            guardian.end(confirmed=not left)
        atexit.unregister(self.close)

    def _opened(self) -> StsLink:
        if self._link is None:
            raise HardwareLost(f"the servos on {self.config.port} are not open", hint="call open first")
        return self._link

    def _stop_if_halted(self) -> None:
        """Take the torque off once more: a goal may have passed `make_safe` on its way, and switched it on again."""
        if self._halted:
            self.make_safe()

    def _find(self, link: StsLink, joint: CalibratedJoint) -> None:
        """Find a joint's servo; raise HardwareLost if it is not there, another model, or calibrated differently."""
        servo_id = joint.servo_id
        where = f"{self.config.port} at {self.config.baud_rate} baud"
        try:
            link.ping(servo_id)
        except HardwareLost as error:
            raise HardwareLost(
                f"servo {servo_id} (joint {joint.name!r}) does not answer on {where}. "
                f"Available of 0 to {_SCANNED - 1}: {[i for i in range(_SCANNED) if link.answers(i)]}",
                hint="check power, cable, id and baud rate; lerobot-setup-motors sets ids",
            ) from error
        number = link.read(servo_id, reg.MODEL_NUMBER, despite_alarm=True)
        if number not in MODELS:
            known = ", ".join(f"{name} ({n})" for n, name in MODELS.items())
            raise HardwareLost(f"servo {servo_id} is model {number}, which is not known. Available: {known}")
        self._models[servo_id] = MODELS[number]
        offset = link.read(servo_id, reg.HOMING_OFFSET, despite_alarm=True)
        if joint.homing_offset not in (None, offset):
            raise HardwareLost(
                f"servo {servo_id} (joint {joint.name!r}) has homing offset {offset}, its calibration says "
                f"{joint.homing_offset}",
                hint="this is another arm's calibration, or the servo was changed: run lerobot-calibrate",
            )

    def _prepare(self, link: StsLink, joint: CalibratedJoint) -> None:
        """Write a servo's settings, with torque off, and check that it can go wherever its joint may."""
        servo_id = joint.servo_id
        phase = self._phases[servo_id] = link.read(servo_id, reg.PHASE)
        self._unit_rad_s[self._ids.index(servo_id)] = reg.speed_unit_rad_s(phase)
        low, high = link.read(servo_id, reg.MIN_POSITION), link.read(servo_id, reg.MAX_POSITION)
        if (low, high) != (0, 0) and not low <= joint.low_count < joint.high_count <= high:
            raise HardwareLost(
                f"servo {servo_id} (joint {joint.name!r}) goes from {low} to {high} counts only, its joint from "
                f"{joint.low_count} to {joint.high_count}",
                hint="run lerobot-calibrate, or narrow the joint's range",
            )
        for register, value in (
            (reg.RESPONSE_LEVEL, 1),
            (reg.LOCK, 1),
            (reg.RETURN_DELAY_TIME, 0),
            (reg.OPERATING_MODE, int(reg.Mode.POSITION)),
        ):
            link.set(servo_id, register, value)
        self._write_settings(link, servo_id)

    def _write_settings(self, link: StsLink, servo_id: int) -> None:
        for register, value in self._drive.registers(self._phases[servo_id]).items():
            link.set(servo_id, register, value)

    def _rest_count(self, joint: CalibratedJoint, count: int) -> int:
        """Return the goal at which a joint stays where it is; raise SafetyStop if it is far outside its range."""
        goal = min(max(count, joint.low_count), joint.high_count)
        if abs(goal - count) * abs(joint.rad_per_count) > _BEYOND_RAD:
            low, high = joint.range_rad
            raise SafetyStop(
                f"joint {joint.name!r} is at {joint.angle(count):.4g} rad, outside [{low:.4g}, {high:.4g}]",
                hint="move it by hand, or calibrate again",
            )
        return goal

    def _force_off(self, servo_id: int) -> None:
        if not self._opened().force(servo_id, reg.TORQUE_ENABLE, 0):
            raise HardwareLost(f"servo {servo_id} does not confirm that its torque is off", hint="cut its power")


def servos(port: str, ids: Sequence[int], drive: StsDrive, *, baud_rate: int, silence_s: float) -> StsServos:
    """Return servos on a port, not opened yet; what the name ``feetech`` stands for.

    Args:
        port: Device file of the port.
        ids: The servos' ids, in the order of commands and measurements.
        drive: How they follow a position, and the joints that they move.
        baud_rate: Bits per second.
        silence_s: Longest time without an instruction while torque is on [s].
    """
    joints = {joint.servo_id: joint for joint in drive.joints}
    chosen = [joints.get(i) or CalibratedJoint(f"servo {i}", i) for i in ids]
    return StsServos(StsConfig(port, baud_rate, silence_s=silence_s), chosen, drive)
