"""How identified servos follow their goals: what their weight, at most with the heaviest payload, lets them sink."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from sim2real.hardware.safety.following import RESPONSE_S, Following

mj: Any = mujoco

LIMIT_RAD: Final = 0.15
"""Largest distance of a joint from where goals, weight and friction put it [rad]. In sound deployments with any payload
up to the heaviest it was 0.11 rad."""

_POSES, _SHARE, _LEAST_RAD_S = 200, 0.5, 0.1


def identified_following(mjcfs: Sequence[str], joints: Sequence[str]) -> Following:
    """Return how the joints of an identified model follow their goals.

    Args:
        mjcfs: The model with a position actuator on each joint: with the lightest payload, and with the heaviest.
        joints: Names of the joints, in the order of the servos.
    """
    models = [mj.MjModel.from_xml_string(mjcf) for mjcf in mjcfs]
    states, model = [mj.MjData(m) for m in models], models[0]
    places = [int(model.joint(joint).qposadr[0]) for joint in joints]
    dofs = [int(model.joint(joint).dofadr[0]) for joint in joints]
    driven = model.actuator_trnid[:, 0].tolist()
    motors = [driven.index(int(model.joint(joint).id)) for joint in joints]
    stiffness = model.actuator_gainprm[motors, 0]
    friction_rad = model.dof_frictionloss[dofs] / stiffness
    most_rad = model.actuator_forcerange[motors, 1] / stiffness

    def weight(position_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sinks = []
        for m, data in zip(models, states, strict=True):
            data.qpos[places] = position_rad
            mj.mj_kinematics(m, data)
            mj.mj_comPos(m, data)
            mj.mj_crb(m, data)
            mj.mj_comVel(m, data)
            mj.mj_rne(m, data, 0, data.qfrc_bias)
            sinks.append(-data.qfrc_bias[dofs] / stiffness)
        return np.min(sinks, axis=0) - friction_rad, np.max(sinks, axis=0) + friction_rad

    # On a longer way a joint has at least a share of the speed at which damping takes what weight and friction leave.
    low, high = model.jnt_range[[int(model.joint(joint).id) for joint in joints]].T
    poses = np.random.default_rng(0).uniform(low, high, (_POSES, len(joints)))
    sinks_rad = np.max([np.abs(weight(pose)).max(axis=0) for pose in poses], axis=0)
    speed = _SHARE * np.maximum(most_rad - sinks_rad, 0.0) * stiffness / np.maximum(model.dof_damping[dofs], 1e-9)
    return Following(LIMIT_RAD, RESPONSE_S, np.clip(speed, _LEAST_RAD_S, None), "the identified model", weight)
