"""A plant behind mountings: emulated servos on joints with a zero, a direction and a gear."""

from collections.abc import Mapping, Sequence
from typing import Any

from sim2real.errors import UsageError
from sim2real.hardware.joint import Joint
from sim2real.hardware.plant import ConfigurablePlant, OperatingMode, load_plant


class MountedPlant:
    """A plant whose servos drive its joints through their mountings; see `sim2real.hardware.plant.Plant`.

    The plant inside works on the joints' side: it gets their angles, speeds and voltages, and has their true states.

    Args:
        joints: Fields of `Joint`, one row per servo, in the order of the plant's `servo_ids`.
        zero_rad: The encoder's angle from count 0 where the device reports 0 [rad]; in the plant inside, that of a
            joint at 0.

    Raises:
        UsageError: There is another number of joints than of servos.
    """

    def __init__(
        self, plant: str, plant_args: Mapping[str, Any], joints: Sequence[Mapping[str, Any]], zero_rad: float
    ) -> None:
        self._plant, self._zero_rad = load_plant(plant, plant_args), zero_rad
        self.servo_ids = tuple(self._plant.servo_ids)
        if len(joints) != len(self.servo_ids):
            raise UsageError(f"{len(joints)} joints are mounted on {len(self.servo_ids)} servos")
        self._joints = {i: Joint(**fields) for i, fields in zip(self.servo_ids, joints, strict=True)}

    def advance(self, t_s: float) -> None:
        """Integrate up to ``t_s`` [s]."""
        self._plant.advance(t_s)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Command a servo; see `Plant.command`. The goal is the servo's, not its joint's."""
        joint = self._joints[servo_id]
        if mode in (OperatingMode.POSITION, OperatingMode.EXTENDED_POSITION):
            goal = joint.angle(goal - self._zero_rad) + self._zero_rad
        elif mode == OperatingMode.VELOCITY:
            goal = joint.speed(goal)
        else:
            goal = joint.direction * goal
        self._plant.command(servo_id, mode, goal)

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's position controller if the plant inside has one; see `ConfigurablePlant`."""
        if isinstance(self._plant, ConfigurablePlant):
            speed = profile_velocity_rad_s / self._joints[servo_id].gear
            self._plant.configure(servo_id, p_gain, d_gain, speed)

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return the encoder's angle from count 0 [rad], its speed [rad/s], and the servo's load."""
        joint = self._joints[servo_id]
        angle, speed, load = self._plant.measure(servo_id)
        encoder = joint.encoder(angle - self._zero_rad) + self._zero_rad
        return encoder, joint.direction * joint.gear * speed, joint.direction * load

    def state(self) -> dict[str, float]:
        """Return the true state of the plant inside."""
        return self._plant.state()

    def truth(self) -> dict[str, Any]:
        """Return the true parameters of the plant inside."""
        return self._plant.truth()
