"""Joint positions that bring a site to a pose, on MuJoCo's C engine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.models.mjcf.translate import mj

if TYPE_CHECKING:
    from sim2real.composer.models.element import Element, Elements
    from sim2real.composer.physics.c.physics import Physics
    from sim2real.composer.types import ArrayLike

TOLERANCE = 1e-10
"""Norm of the error, metres and radians together, at which the pose is reached."""
_FAR, _DAMPING = 0.1, 3e-2
_LONGEST_STEP, _SLOWEST, _STEPS = 2.0, 20.0, 100


def reach(
    physics: Physics,
    site: Element,
    joints: Elements,
    position: ArrayLike,
    quaternion: ArrayLike,
    rotation_weight: float = 2.0,
) -> bool:
    """Move joints until a site has a pose; return whether that was reached. Limits of joints are not heeded.

    Damped least squares, undamped near the goal: Buss, Introduction to inverse kinematics with Jacobian transpose,
    pseudoinverse and damped least squares methods, 2004.

    Args:
        position: Of the site in the world, ``(3,)`` [m].
        quaternion: Of the site in the world, ``(4,)``.
        rotation_weight: Metres that a radian counts as.
    """
    model, data = physics.model.ptr, physics.data.ptr
    number, columns = (
        physics.bind(site).element_id,
        np.concatenate([np.atleast_1d(c) for c in _columns(physics, joints)]),
    )
    jacobian, step = np.empty((6, model.nv)), np.zeros(model.nv)
    for _ in range(_STEPS):
        # Measure the error of the pose.
        mj.mj_fwdPosition(model, data)
        error = _error(data.site_xpos[number], data.site_xmat[number], position, quaternion)
        size = np.linalg.norm(error[:3]) + rotation_weight * np.linalg.norm(error[3:])
        if size < TOLERANCE:
            physics.mark_as_dirty()
            return True
        # Solve for the step of the joints that reduces it; far from the goal damping keeps the step short.
        mj.mj_jacSite(model, data, jacobian[:3], jacobian[3:], number)
        reduced = jacobian[:, columns]
        damping = _DAMPING if size > _FAR else 0.0
        move = np.linalg.lstsq(reduced.T @ reduced + damping * np.eye(columns.size), reduced.T @ error, rcond=None)[0]
        length = np.linalg.norm(move)
        if size > _SLOWEST * length:  # it no longer comes nearer
            break
        step[columns] = move * min(1.0, _LONGEST_STEP / length)
        mj.mj_integratePos(model, data.qpos, step, 1.0)
    physics.mark_as_dirty()
    return False


def _columns(physics: Physics, joints: Elements) -> list[np.ndarray]:
    """Return the degrees of freedom of each joint."""
    model = physics.model.ptr
    width = {int(mj.mjtJoint.mjJNT_FREE): 6, int(mj.mjtJoint.mjJNT_BALL): 3}
    ids = np.atleast_1d(physics.bind(joints).element_id)
    return [model.jnt_dofadr[i] + np.arange(width.get(int(model.jnt_type[i]), 1)) for i in ids]


def _error(xpos: np.ndarray, xmat: np.ndarray, position: ArrayLike, quaternion: ArrayLike) -> np.ndarray:
    """Return the error: a translation [m] and a rotation vector [rad], in the world's axes, shape ``(6,)``."""
    error, there, missing = np.empty(6), np.empty(4), np.empty(4)
    error[:3] = np.asarray(position) - xpos
    goal = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    mj.mju_mat2Quat(there, xmat)
    there[1:] *= -1
    mj.mju_mulQuat(missing, goal, there)
    mj.mju_quat2Vel(error[3:], missing, 1.0)
    return error
