"""A plant made from a robot's own MJCF model: an emulated robot for when there is no hardware yet.

Its parameters differ from the model's by factors, so that an identification has a task. It cannot check the model's
structure: an error of the MJCF is also in its twin.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
from mujoco import MjData, MjModel, mj_step  # pyright: ignore[reportAttributeAccessIssue]

from sim2real.errors import UsageError
from sim2real.hardware.device import OperatingMode

mj: Any = mujoco
_RAD_PER_COUNT = 2.0 * math.pi / 4096  # of the encoders of DYNAMIXEL X and Feetech STS servos
_CENTRE_RAD = 2048 * _RAD_PER_COUNT
_FACTORS = ("gain", "damping", "armature", "friction")


def plain_model(mjcf: Path, step_s: float, armature: float, damping: float, carried_kg: float, carrier: str) -> Any:
    """Return an MJCF's model for a plant: hinges with rotors and friction, and a mass at a site.

    Friction constraints are as stiff as the solver allows: with the defaults, a joint held by friction creeps.

    Args:
        damping: Of each joint [N m s/rad].
        carried_kg: Mass at the site ``carrier``; 0: none.
    """
    spec = mj.MjSpec.from_file(str(mjcf))
    spec.option.timestep, spec.option.integrator = step_s, mj.mjtIntegrator.mjINT_IMPLICITFAST
    if carried_kg:
        site = spec.site(carrier)
        body = site.parent.add_body(name="carried", pos=site.pos)
        body.explicitinertial, body.mass, body.inertia = True, carried_kg, [1e-8] * 3
    # Before it compiles: MuJoCo derives the stiffness of stops and friction from the rotors.
    for joint in spec.joints:
        joint.armature, joint.damping = armature, [damping, 0.0, 0.0]
        joint.solref_friction, joint.solimp_friction[:3] = [4 * step_s, 1.0], [0.999, 0.999, 0.001]
    return spec.compile()


class TwinPlant:
    """Position-controlled servos on a model's position actuators; see ``sim2real.emulation.plant.Plant``.

    A joint is at 0 where its encoder reads the centre of its range; ``MountedPlant`` puts other mountings in between.
    With torque off the motor applies no torque, but the model's damping still acts. Position errors are computed in
    whole counts, as in the firmware.

    Args:
        mjcf: The model, with one position actuator per joint.
        joints: Name of each joint, in the order of the servos -> its name in the model.
        p_gain: Position P Gain that corresponds to the actuators' ``kp`` [counts].
        factors: Factors on the model's parameters: ``gain``, ``damping``, ``armature``, ``friction``; default: 1.
        step_s: MuJoCo's time step [s].
        gears: Turns of each servo for one of its joint; default: 1. The model's numbers are the joints', the counts of
            the firmware and ``truth`` the servos'.

    Raises:
        UsageError: When a factor or a joint is unknown.
    """

    def __init__(
        self,
        mjcf: str,
        joints: Mapping[str, str],
        servo_ids: Sequence[int],
        p_gain: int,
        factors: Mapping[str, float] | None = None,
        step_s: float = 0.0005,
        gears: Sequence[float] = (),
    ) -> None:
        self.servo_ids = tuple(servo_ids)
        self.joints = tuple(joints)
        self._gears = tuple(gears) or (1.0,) * len(self.joints)
        elements = [joints[name] for name in self.joints]
        # Check names before the model is changed.
        f = dict.fromkeys(_FACTORS, 1.0) | dict(factors or {})
        if unknown := set(f) - set(_FACTORS):
            raise UsageError(f"a twin has no factor {sorted(unknown)[0]!r}. Available: {', '.join(_FACTORS)}")
        model = self.model = MjModel.from_xml_string(mjcf)
        names = [model.joint(i).name for i in range(model.njnt)]
        if missing := [j for j in elements if j not in names]:
            raise UsageError(f"the twin's model has no joint {missing[0]!r}. Available: {', '.join(names)}")
        # Scale the model's parameters.
        model.opt.timestep = step_s
        model.actuator_gainprm[:, 0] *= f["gain"]
        model.actuator_biasprm[:, 1] *= f["gain"]
        model.actuator_forcerange[:] *= f["gain"]
        model.dof_damping[:] *= f["damping"]
        model.dof_armature[:] *= f["armature"]
        model.dof_frictionloss[:] *= f["friction"]
        # Friction constraints as stiff as the solver allows: with the defaults, a joint held by friction creeps.
        model.dof_solref[:] = (4 * step_s, 1.0)
        model.dof_solimp[:, :3] = (0.999, 0.999, 0.001)
        self.data = MjData(model)
        # Find each servo's joint and actuator in the model.
        self._p_gain, self._kp = p_gain, model.actuator_gainprm[:, 0].copy()
        self._force_range = model.actuator_forcerange.copy()
        self._qpos = [int(model.joint(j).qposadr[0]) for j in elements]
        self._dofs = [int(model.joint(j).dofadr[0]) for j in elements]
        driven = model.actuator_trnid[:, 0].tolist()
        self._motors = [driven.index(int(model.joint(j).id)) for j in elements]
        self._profiles = [float("inf")] * len(self.joints)
        self._goals: list[float | None] = [None] * len(self.joints)
        self._references = [0.0] * len(self.joints)

    def advance(self, t_s: float) -> None:
        """Integrate up to ``t_s`` [s]."""
        model, data, step_s = self.model, self.data, self.model.opt.timestep
        for _ in range(round((t_s - data.time) / step_s)):
            for i, goal in enumerate(self._goals):
                angle, motor = float(data.qpos[self._qpos[i]]), self._motors[i]
                # Torque off: a goal at the present angle makes the actuator's force 0.
                if goal is None:
                    data.ctrl[motor] = angle
                    continue
                # Move the setpoint along its profile, and round the error to counts as the firmware does.
                reach = self._profiles[i] * step_s
                self._references[i] += min(max(goal - self._references[i], -reach), reach)
                count_rad = _RAD_PER_COUNT / self._gears[i]
                counts = round(self._references[i] / count_rad) - round(angle / count_rad)
                data.ctrl[motor] = angle + counts * count_rad
            mj_step(model, data)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Set a servo's goal.

        Args:
            mode: Position; any other mode counts as torque off.
            goal: Goal position [rad from the encoder's count 0].
        """
        i = self.servo_ids.index(servo_id)
        if mode == OperatingMode.POSITION and self._goals[i] is None:
            self._references[i] = float(self.data.qpos[self._qpos[i]])
        self._goals[i] = goal - _CENTRE_RAD if mode == OperatingMode.POSITION else None

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's position controller.

        Args:
            p_gain: Position P Gain [counts].
            d_gain: Not emulated; drives set it to 0.
            profile_velocity_rad_s: Largest speed of the setpoint [rad/s]; inf: no limit.
        """
        del d_gain
        i = self.servo_ids.index(servo_id)
        motor = self._motors[i]
        self._profiles[i] = profile_velocity_rad_s
        kp = self._kp[motor] * p_gain / self._p_gain
        self.model.actuator_gainprm[motor, 0], self.model.actuator_biasprm[motor, 1] = kp, -kp

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return angle from the encoder's count 0 [rad], velocity [rad/s], and load, a fraction of the stall torque."""
        i = self.servo_ids.index(servo_id)
        load = float(self.data.actuator_force[self._motors[i]]) / float(self._force_range[self._motors[i], 1])
        angle, speed = self.data.qpos[self._qpos[i]], self.data.qvel[self._dofs[i]]
        return float(angle) + _CENTRE_RAD, float(speed), load

    def state(self) -> dict[str, float]:
        """Return the true joint angles [rad] and velocities [rad/s]."""
        position = {f"position[{i}]": float(self.data.qpos[a]) for i, a in enumerate(self._qpos)}
        return position | {f"velocity[{i}]": float(self.data.qvel[a]) for i, a in enumerate(self._dofs)}

    def truth(self) -> dict[str, Any]:
        """Return the parameters that can be identified from a log, named as in ``sim2real.robots.servo.model``.

        Parameters that the joints share are those of the first servo; ``gain`` belongs to ``p_gain``.
        """
        dof, motor, gear = self._dofs[0], self._motors[0], self._gears[0]
        dofs = zip(self.joints, self._dofs, self._gears, strict=True)
        friction = {f"friction_{name}": float(self.model.dof_frictionloss[d]) / g for name, d, g in dofs}
        return {
            "gain": float(self._kp[motor]) / gear**2,
            "damping": float(self.model.dof_damping[dof]) / gear**2,
            "armature": float(self.model.dof_armature[dof]) / gear**2,
            **friction,
        }
