"""Feetech STS servos as a device: joints in position mode, behind the contract of `sim2real.hardware.device`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.bus.link import ServoLink
from sim2real.hardware.bus.packets import Answer
from sim2real.hardware.bus.port import LinkConfig
from sim2real.hardware.bus.servos import GuardedServos
from sim2real.hardware.device import POSITION, CommandKind, Device, Reading, Transaction
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.calibration import CalibratedJoint
from sim2real.hardware.feetech.drive import StsDrive
from sim2real.hardware.feetech.models import MODELS
from sim2real.hardware.feetech.protocol import PROTOCOL, describe_alarms
from sim2real.hardware.safety.following import MOST_SHARE, RESPONSE_S, SLOW_RAD_S, Following

_STATE: Final = (reg.PRESENT_POSITION, reg.PRESENT_SPEED, reg.PRESENT_LOAD)
_SETTINGS: Final = (reg.TORQUE_ENABLE, reg.ACCELERATION, reg.GOAL_SPEED, reg.TORQUE_LIMIT)
_BEYOND_RAD: Final = 0.1
"""Largest distance of a joint from its range when torque goes on [rad]; it is pulled back to the end of the range."""


@dataclass(frozen=True)
class StsConfig(LinkConfig):
    """Port and time limits of a bus of Feetech servos; see `LinkConfig`. They have no watchdogs."""

    family = "Feetech"
    baud_rates = reg.BAUD_RATES


class StsLink(ServoLink):
    """Owner of the port of Feetech servos; see `ServoLink`."""

    form = PROTOCOL
    table = reg.TABLE

    def require_fine(self, answer: Answer, what: str) -> None:
        """Raise SafetyStop, as the error byte holds alarms."""
        del what
        raise SafetyStop(
            f"servo {answer.servo_id} reports an alarm: {describe_alarms(answer.error)}",
            hint="remove the cause, then switch its power off and on; does the supply's voltage fit the servo?",
        )


class StsServos(GuardedServos[StsLink], Device):
    """STS servos on one port, each moving one joint, commanded in joint angles [rad].

    Settings are written while the servos' lock is on: they last until the power goes, and `enable` writes them again.
    A servo does not report that it refuses a value, so every setting is read back. These servos have no watchdog: if
    this process dies, they go on to the last goal until the guardian takes their torque off.

    Args:
        joints: The joints, each with the servo that moves it; `read_calibration` reads them from LeRobot's file.
        drive: Gains and limits of the servos; its `joints` are ignored.

    Raises:
        UsageError: There are no joints, or two with one servo.
    """

    link_type = StsLink

    def __init__(self, bus: StsConfig, joints: Sequence[CalibratedJoint], drive: StsDrive | None = None) -> None:
        super().__init__(bus, [joint.servo_id for joint in joints])
        self.joints = tuple(joints)
        if not joints or len(set(self.ids)) < len(self.ids):
            raise UsageError(f"servos {list(self.ids)}: there must be at least one, each with an id of its own")
        self._drive = drive or StsDrive()
        self._zero = np.array([joint.zero_count for joint in joints])
        self._scale = np.array([joint.rad_per_count for joint in joints])
        self._unit_rad_s = np.ones(len(joints))
        self._phases: dict[int, int] = {}
        self._rest = np.zeros(len(joints))

    @property
    def commanded(self) -> CommandKind:
        """Positions."""
        return POSITION

    def open(self) -> None:
        """Open the port, find the servos, take their torque off and write their settings."""
        super().open()
        try:
            for joint in self.joints:
                self._find(joint)
                if not self.release(joint.servo_id):
                    raise HardwareLost(f"servo {joint.servo_id} does not confirm that its torque is off")
                self._prepare(joint)
        except BaseException:
            self.close()
            raise

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest angles of the joints [rad], each ``(n,)``."""
        low, high = np.array([joint.range_rad for joint in self.joints]).T
        return low, high

    def following(self) -> Following | None:
        """Return how joints follow their goals: near the limit, a servo pushes with nearly all of its torque."""
        drive = self._drive
        if not drive.p_gain:
            return None
        full_rad = reg.full_torque_error_rad(drive.p_gain)
        return Following(MOST_SHARE * full_rad, RESPONSE_S, min(SLOW_RAD_S, 0.5 * drive.speed_rad_s))

    def enable(self) -> None:
        """Write settings and goals, the present positions, and switch the torque on; see `Device.enable`."""
        link = self.link
        self.guard()
        goals = []
        for joint in self.joints:
            self._write_settings(joint.servo_id)
            goals.append(self._rest_count(joint, link.read(joint.servo_id, reg.PRESENT_POSITION)))
            # The goal comes before torque: some firmware switches it on at this write, and holds the position.
            link.set(joint.servo_id, reg.GOAL_POSITION, goals[-1])
            link.write(joint.servo_id, reg.TORQUE_ENABLE, 1)
        self._rest = (np.array(goals) - self._zero) * self._scale
        self.switched_on()

    def rest(self) -> np.ndarray:
        """Return the angles that the servos hold since `enable` [rad], ``(n,)``."""
        return self._rest.copy()

    def measure(self) -> Reading:
        """Read angles [rad], speeds [rad/s] and loads, fractions of the largest, of all joints."""
        counts, transaction = self.link.read_counts(self.ids, _STATE, "read of the state")
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
        # Refuse every angle before any is sent.
        goals = {}
        for joint, angle in zip(self.joints, values.tolist(), strict=True):
            count = joint.count(angle) if math.isfinite(angle) else -1
            if not joint.low_count <= count <= joint.high_count:
                low, high = joint.range_rad
                raise SafetyStop(f"joint {joint.name!r}: {angle:.6g} rad is outside [{low:.6g}, {high:.6g}]")
            goals[joint.servo_id] = count
        # One servo confirms its goal; several share one instruction without answers.
        link = self.link
        if len(goals) == 1:
            return link.write(self.ids[0], reg.GOAL_POSITION, goals[self.ids[0]])
        return link.write_each(reg.GOAL_POSITION, goals)

    def check(self) -> None:
        """Raise SafetyStop if a servo has lost its settings, or its torque is off."""
        if not self.armed:
            return
        counts, _ = self.link.read_counts(self.ids, _SETTINGS, "read of the settings")
        for servo_id, row in zip(self.ids, counts.tolist(), strict=True):
            expected = {reg.TORQUE_ENABLE: 1, **self._drive.registers(self._phases[servo_id])}
            for register, current in zip(_SETTINGS, row, strict=True):
                value = expected[register]
                if current != value and self.armed:  # `armed` may have changed: another thread took the torque off
                    raise SafetyStop(
                        f"servo {servo_id} has lost its settings: {register.name} is {current}, not {value}",
                        hint="did its supply fail for a moment?",
                    )

    def _find(self, joint: CalibratedJoint) -> None:
        """Find a joint's servo; raise HardwareLost if it is not there, another model, or calibrated differently."""
        servo_id, link = joint.servo_id, self.link
        self.find(servo_id, f" (joint {joint.name!r})")
        # Compare the model and the homing offset with the calibration.
        number = link.read(servo_id, reg.MODEL_NUMBER, despite_error=True)
        if number not in MODELS:
            names = ", ".join(f"{model.name} ({n})" for n, model in MODELS.items())
            raise HardwareLost(f"servo {servo_id} is model {number}, which is not supported. Available: {names}")
        self.models[servo_id] = MODELS[number]
        offset = link.read(servo_id, reg.HOMING_OFFSET, despite_error=True)
        if joint.homing_offset not in (None, offset):
            raise HardwareLost(
                f"servo {servo_id} (joint {joint.name!r}) has homing offset {offset}, its calibration has "
                f"{joint.homing_offset}",
                hint="this is another arm's calibration, or the servo was changed: run lerobot-calibrate",
            )

    def _prepare(self, joint: CalibratedJoint) -> None:
        """Write a servo's settings, with torque off, and check that it can go wherever its joint may."""
        # The unit of speeds depends on the firmware's phase setting.
        servo_id, link = joint.servo_id, self.link
        phase = self._phases[servo_id] = link.read(servo_id, reg.PHASE)
        self._unit_rad_s[self.ids.index(servo_id)] = reg.speed_unit_rad_s(phase)
        low, high = link.read(servo_id, reg.MIN_POSITION), link.read(servo_id, reg.MAX_POSITION)
        if (low, high) != (0, 0) and not low <= joint.low_count < joint.high_count <= high:
            raise HardwareLost(
                f"servo {servo_id} (joint {joint.name!r}) goes from {low} to {high} counts only, its joint from "
                f"{joint.low_count} to {joint.high_count}",
                hint="run lerobot-calibrate, or narrow the joint's range",
            )
        # Set the registers that the driver relies on.
        for register, value in (
            (reg.RESPONSE_LEVEL, 1),
            (reg.LOCK, 1),
            (reg.RETURN_DELAY_TIME, 0),
            (reg.OPERATING_MODE, int(reg.Mode.POSITION)),
        ):
            link.set(servo_id, register, value)
        self._write_settings(servo_id)

    def _write_settings(self, servo_id: int) -> None:
        link = self.link
        for register, value in self._drive.registers(self._phases[servo_id]).items():
            link.set(servo_id, register, value)

    def _rest_count(self, joint: CalibratedJoint, count: int) -> int:
        """Return the goal that holds a joint at its position; raise SafetyStop if that is far outside its range."""
        goal = min(max(count, joint.low_count), joint.high_count)
        if abs(goal - count) * abs(joint.rad_per_count) > _BEYOND_RAD:
            low, high = joint.range_rad
            raise SafetyStop(
                f"joint {joint.name!r} is at {joint.angle(count):.4g} rad, outside [{low:.4g}, {high:.4g}]",
                hint="move it by hand, or calibrate again",
            )
        return goal


def servos(port: str, ids: Sequence[int], drive: StsDrive, *, baud_rate: int, silence_s: float) -> StsServos:
    """Return servos on a port, not opened yet: the device of the name ``feetech``; see ``DeviceFactory``."""
    joints = {joint.servo_id: joint for joint in drive.joints}
    selected = [joints.get(i) or CalibratedJoint(f"servo {i}", i) for i in ids]
    return StsServos(StsConfig.patient(port, baud_rate, silence_s), selected, drive)
