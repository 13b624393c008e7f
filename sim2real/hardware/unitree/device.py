"""A Go2's legs as a device, over its low-level interface."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.device import (
    Alone,
    CommandColumn,
    CommandKind,
    Device,
    Reading,
    ReadingPart,
    Transaction,
    WithoutHost,
)
from sim2real.hardware.safety.following import Following
from sim2real.hardware.unitree.dds import Address
from sim2real.hardware.unitree.guarded import GuardedLegs
from sim2real.hardware.unitree.legs import NAMES, TORQUE_NM, LegDrive, command
from sim2real.hardware.unitree.messages import MOTORS, LowCmd, LowState
from sim2real.hardware.unitree.sit_down import motors_on

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
"""Parts of a reading. The quaternion is (w, x, y, z). Gyro and accelerometer of this kind reach 35 rad/s and 157 m/s^2.
The force on a foot is the count of its sensor, in the order FR, FL, RR, RL: Unitree documents no unit."""
_WEAK_NM, _WEAK_S = 5.0, 0.1
"""By how much a motor's torque may be weaker than its law [N m], on average over a time [s]."""
_SOURCE: Final = (
    "Unitree documents no reaction of a Go2; a motor of its GO family goes on (unitree_actuator_sdk, issue 29); "
    "not measured by us"
)


class UnitreeLegs(GuardedLegs, Device):
    """The twelve motors of a Go2, each with a position controller, a velocity controller and a torque.

    The robot publishes its state at 500 Hz without a request; `measure` waits for the next one. A command is published
    once. If commands stop, the guardian lets the legs damp and takes the torque off.

    Args:
        port: Network interface and DDS domain, such as ``eth0:0``; see `Address`.
        ids: Places of the motors in the messages, in the order of the joints; each of 0 to 11 once.
        max_silence_s: Time without a state after which the robot is lost [s].

    Raises:
        UsageError: A motor is missing, or the port has no domain.
    """

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
        super().__init__(Address.parse(port), drive or LegDrive(), silence_s, max_silence_s)
        self._places = np.array(ids)
        self._rest = np.zeros((MOTORS, 5))
        self._left = 1.0

    @property
    def motors(self) -> tuple[str, ...]:
        """Names of the motors: ``FR_hip``, ``FR_thigh``, ..."""
        return tuple(NAMES[i] for i in self._places)

    @property
    def commanded(self) -> CommandKind:
        """The columns q, dq, kp, kd and tau; a stale command damps the joint."""
        return CommandKind.of_columns(
            "controllers",
            CommandColumn("q", "rad", "hold"),
            CommandColumn("dq", "rad/s", "zero"),
            CommandColumn("kp", "N m/rad", "zero"),
            CommandColumn("kd", "N m s/rad", self.drive.damping),
            CommandColumn("tau", "N m", "zero"),
        )

    @property
    def silence_s(self) -> float:
        """Longest time without a command or a measurement while torque is on [s]; 0: unlimited."""
        return self._silence_s

    @property
    def measures(self) -> Mapping[str, str]:
        """Quantity -> unit of a reading; the load is the torque that the motor estimates."""
        return {"position": "rad", "velocity": "rad/s", "load": "N m"}

    @property
    def parts(self) -> Mapping[str, ReadingPart]:
        """The parts `PARTS`."""
        return PARTS

    def without_host(self) -> tuple[WithoutHost, ...]:
        """Return the worst reaction, as none is documented."""
        return (WithoutHost("Go2", self.motors, Alone.GOES_ON, math.inf, _SOURCE, "no other reaction is documented"),)

    def facts(self) -> dict[str, dict[str, str]]:
        """Return the versions that the robot's state has, the battery's voltage and the motors' temperatures."""
        # Versions of 0 are those that the robot does not report.
        record = self.session.stream.next()[0].record
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
        """Return the lowest and the highest q, dq, kp, kd and tau, each ``(12, 5)``."""
        low, high = self.drive.reach
        return low[self._places], high[self._places]

    def enable(self) -> None:
        """Start the guardian, and let all motors damp at their positions; see `Device.enable`."""
        self._left, self._rest = 1.0, np.zeros((MOTORS, 5))
        low, high = self.reach()
        # A robot that lies may rest on the stops of its joints, a little beyond their range.
        self._rest[:, 0] = np.clip(self.measure().position_rad, low[:, 0], high[:, 0])
        self._rest[:, 3] = self.drive.damping
        self.switch_on(self._message(self._rest))

    def following(self) -> Following:
        """Return by how much a motor's torque may be weaker than its law."""
        return Following(_WEAK_NM, _WEAK_S, source="the motors' own torques", most_nm=TORQUE_NM[self._places])

    def rest(self) -> np.ndarray:
        """Return the command since `enable`, ``(12, 5)``: the positions of that time without a gain, and damping."""
        return self._rest.copy()

    def measure(self) -> Reading:
        """Wait for the next state: positions [rad], speeds [rad/s], estimated torques [N m], and `PARTS`."""
        # A guardian that has taken over is the reason of silence and of torque that is off.
        self.beat()
        armed = self.armed
        try:
            state, transaction = self.session.stream.next()
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
            SafetyStop: A value is not finite or beyond the reach, or the torque is off.
        """
        called_ns = self.clock.now_ns()
        self._require_possible(values)
        begin_ns, transfer_ns = self.publish(self._message(values))
        return Transaction(begin_ns, begin_ns - called_ns, transfer_ns, 0)

    def soften(self, command: np.ndarray, left: float) -> np.ndarray:
        """Return the command with a smaller position gain and torque, and more damping: the robot sinks."""
        # The rig gives the softened command of its last call, so this call's share is the ratio of both.
        share = left / self._left if 0.0 < left < self._left else float(left > 0.0)
        self._left = left
        softer = command * [1.0, share, share, share, share]
        softer[:, 3] += (1.0 - share) * self.drive.damping
        return softer

    def _message(self, values: np.ndarray) -> LowCmd:
        columns = np.empty((MOTORS, 5))
        columns[self._places] = values
        return command(columns)

    def _reading(self, state: LowState, transaction: Transaction) -> Reading:
        record = state.record
        motor, imu = record["motor_state"][self._places], record["imu_state"]
        position, velocity, load = (motor[name].astype(np.float64) for name in ("q", "dq", "tau_est"))
        if not np.isfinite(position + velocity).all():
            raise SafetyStop("an angle or a speed in the robot's state is no number", hint="start the robot again")
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
        bad = np.argwhere(~((values >= low) & (values <= high)))  # a value that is no number is in no range
        if bad.size:
            row, column = bad[0].tolist()
            raise SafetyStop(
                f"{self.motors[row]}: {self.commanded.columns[column].name} = {values[row, column]:.6g} is outside "
                f"[{low[row, column]:.6g}, {high[row, column]:.6g}]"
            )


def legs(port: str, ids: Sequence[int], drive: Any, *, baud_rate: int, silence_s: float) -> UnitreeLegs:
    """Return the legs of a Go2, not opened yet: the device of the name ``unitree``; see ``DeviceFactory``."""
    del baud_rate  # a network has none
    return UnitreeLegs(port, ids, drive, silence_s=silence_s, max_silence_s=max(0.1, silence_s))
