"""A robot of LeRobot as a device: its follower class reads and commands, in joint angles [rad]."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np

from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.bus.servos import GuardedServos
from sim2real.hardware.device import POSITION, CommandKind, Device, Reading, Transaction
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.models import MODELS
from sim2real.hardware.lerobot.link import LerobotConfig, LerobotLink
from sim2real.installation import with_extra

_FULL_ERROR_RAD: Final = 1 / (16 * reg.P_GAIN_UNIT_PER_RAD)
"""Position error at which a servo with LeRobot's P gain of 16 pushes with its whole duty [rad]."""


@dataclass(frozen=True)
class LerobotSettings:
    """A robot of LeRobot: the values that its commands take as ``--robot.type`` and ``--robot.id``.

    Args:
        name: Id of the robot, the name of its calibration file.
        calibration_dir: Folder of that file; None: LeRobot's own.
        module: The module that registers the type.
    """

    kind: str = "so101_follower"
    name: str | None = None
    calibration_dir: Path | None = None
    module: str = "lerobot.robots.so_follower"

    def make(self, port: str) -> Any:
        """Return LeRobot's robot, not connected; raise UsageError without LeRobot, or without such a robot."""
        try:
            from lerobot.robots import RobotConfig, make_robot_from_config  # pyright: ignore[reportMissingImports]

            import_module(self.module)
        except ImportError as error:
            raise UsageError(
                f"the device 'lerobot' cannot import a robot of LeRobot: {error}", hint=with_extra("lerobot")
            ) from error
        kinds = RobotConfig.get_known_choices()
        if self.kind not in kinds:
            raise UsageError(
                f"{self.module} has no robot {self.kind!r}. Available: {', '.join(sorted(kinds))}",
                hint="LerobotSettings.module names the module that registers it",
            )
        return make_robot_from_config(kinds[self.kind](port=port, id=self.name, calibration_dir=self.calibration_dir))


class LerobotServos(GuardedServos[Any], Device):
    """The motors of a robot of LeRobot, read by ``get_observation`` and commanded by ``send_action``.

    LeRobot reports positions only: velocities are differences between readings.

    Args:
        ids: Numbers of the servos, in the order of LeRobot's motors.
    """

    link_type = LerobotLink

    def __init__(self, config: LerobotConfig, ids: Sequence[int]) -> None:
        super().__init__(config, ids)
        self._names: tuple[str, ...] = ()
        self._rad = self._zero = self._low = self._high = self._rest = np.zeros(len(ids))
        self._last: tuple[int, np.ndarray] | None = None

    @property
    def link(self) -> LerobotLink:
        """The link, once it is open."""
        return super().link

    @property
    def commanded(self) -> CommandKind:
        """Positions."""
        return POSITION

    @property
    def measures(self) -> Mapping[str, str]:
        """Positions, and velocities from their differences."""
        return {"position": "rad", "velocity": "rad/s"}

    def open(self) -> None:
        """Connect as LeRobot does, with torque off, and read units and ranges from its calibration."""
        super().open()
        try:
            bus = self.link.bus
            if list(bus.ids) != list(self.ids):
                raise UsageError(f"the robot has the servos {list(bus.ids)}, not {list(self.ids)}")
            self._names, self._last = tuple(bus.motors), None
            if (actions := set(self.link.robot.action_features)) != {f"{name}.pos" for name in self._names}:
                raise UsageError(
                    f"the robot's actions are {sorted(actions)}, not one position for each of its servos",
                    hint="a robot with wheels cannot be driven by positions alone",
                )
            units = [_unit(bus.motors[n].norm_mode.name, bus.calibration[n]) for n in self._names]
            self._rad, self._zero, self._low, self._high = np.array(units).T
            numbers, _ = self.link.call(lambda: bus.sync_read("Model_Number"))
            if unknown := set(numbers.values()) - set(MODELS):
                raise UsageError(f"unknown models {sorted(unknown)} of servos. Available: {sorted(MODELS)}")
            self.models = {bus.motors[name].id: MODELS[number] for name, number in numbers.items()}
        except BaseException:
            self.close()
            raise

    def facts(self) -> dict[str, dict[str, str]]:
        """Return firmware, supply voltage and temperature of each motor, by LeRobot's names of the registers."""
        names = ("Firmware_Major_Version", "Firmware_Minor_Version", "Present_Voltage", "Present_Temperature")
        # Read each register of all motors at once, in counts.
        bus = self.link.bus
        rows = [self.link.call(lambda name=name: bus.sync_read(name, normalize=False))[0] for name in names]
        major, minor, tenths_v, celsius = ([row[motor] for motor in self._names] for row in rows)
        texts = {
            "firmware": [f"{a}.{b}" for a, b in zip(major, minor, strict=True)],
            "voltage": [f"{0.1 * x:.1f} V" for x in tenths_v],
            "temperature": [f"{x} °C" for x in celsius],
        }
        return {fact: dict(zip(self.motors, row, strict=True)) for fact, row in texts.items()}

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest angles of the joints [rad], each ``(n,)``."""
        return self._low.copy(), self._high.copy()

    def enable(self) -> None:
        """Write the present positions as goals, and switch the torque on; see `Device.enable`."""
        self.guard()
        bus = self.link.bus
        try:
            counts, _ = self.link.call(lambda: bus.sync_read("Present_Position", normalize=False))
            self._rest = np.clip(self.measure().position_rad, self._low, self._high)
            if self.torque_withheld:
                self.link.withheld += 2
            else:
                self.link.call(lambda: bus.sync_write("Goal_Position", counts, normalize=False))
                self.link.call(bus.enable_torque)
            self.armed = True
        finally:
            self.stop_if_halted()

    def rest(self) -> np.ndarray:
        """Return the angles that the servos hold since `enable` [rad], ``(n,)``."""
        return self._rest.copy()

    def measure(self) -> Reading:
        """Read angles [rad]; speeds [rad/s] are those since the last reading, loads are not measured."""
        observation, transaction = self.link.call(self.link.robot.get_observation)
        position = np.array([observation[f"{name}.pos"] for name in self._names]) * self._rad + self._zero
        sent_ns, velocity = transaction.t_sent_ns, np.zeros(len(position))
        if self._last is not None and sent_ns > self._last[0]:
            velocity = (position - self._last[1]) / ((sent_ns - self._last[0]) * 1e-9)
        self._last = sent_ns, position
        return Reading(position, velocity, np.full(len(position), math.nan), transaction)

    def command(self, values: np.ndarray) -> Transaction:
        """Send angles [rad], ``(n,)``; the servos do not confirm them.

        Raises:
            SafetyStop: An angle is not finite or outside the joint's range, or torque is off.
        """
        if self.halted:
            raise SafetyStop("no command is sent: the servos have been made safe", hint="open them again")
        values = np.asarray(values, np.float64)
        if not np.all((values >= self._low - 1e-6) & (values <= self._high + 1e-6)):
            raise SafetyStop(f"commands {values.tolist()} are outside of the joints' ranges")
        goals = {f"{n}.pos": v for n, v in zip(self._names, ((values - self._zero) / self._rad).tolist(), strict=True)}
        link = self.link
        try:
            if self.torque_withheld:
                link.withheld += 1
                return link.call(link.robot.get_observation)[1]
            return link.call(lambda: link.robot.send_action(goals))[1]
        finally:
            self.stop_if_halted()

    def effort(self, command: np.ndarray, position_rad: np.ndarray) -> np.ndarray:
        """Return the duty that LeRobot's P gain computes from the position error."""
        return np.clip((command - position_rad) / _FULL_ERROR_RAD, -1.0, 1.0)

    def check(self) -> None:
        """Raise SafetyStop if the torque of a servo is off."""
        if not self.armed or self.torque_withheld:
            return
        states, _ = self.link.call(lambda: self.link.bus.sync_read("Torque_Enable"))
        if self.armed and (off := [name for name, state in states.items() if not state]):
            raise SafetyStop(f"the torque of {', '.join(off)} is off", hint="did its supply fail for a moment?")

    def disable(self) -> None:
        """Switch the torque off, confirmed by every servo."""
        with self.unguarded():
            self.link.call(self.link.bus.disable_torque)


def _unit(mode: str, calibration: Any) -> tuple[float, float, float, float]:
    """Return a LeRobot unit [rad], the angle at its value 0 [rad], and the lowest and the highest angle [rad].

    Angles are 0 in the middle of the range, as LeRobot's are in degrees. LeRobot mirrors its other units itself.
    """
    if mode == "DEGREES" and calibration.drive_mode:
        raise UsageError("drive_mode 1 of a joint in degrees: LeRobot does not mirror it", hint="run lerobot-calibrate")
    half = (calibration.range_max - calibration.range_min) / 2 * reg.RAD_PER_COUNT
    units = {
        "DEGREES": ((reg.COUNTS_PER_REVOLUTION - 1) / 360 * reg.RAD_PER_COUNT, 0.0),
        "RANGE_M100_100": (half / 100, 0.0),
        "RANGE_0_100": (half / 50, -half),
    }
    return (*units[mode], -half, half)


def servos(port: str, ids: Sequence[int], drive: LerobotSettings, *, baud_rate: int, silence_s: float) -> LerobotServos:
    """Return a robot of LeRobot on a port, not opened yet: the device ``lerobot``; see `DeviceFactory`."""
    return LerobotServos(LerobotConfig(port, baud_rate, silence_s=silence_s, make=drive.make), ids)
