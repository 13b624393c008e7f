"""Computes unrecorded joint positions of a closed loop from the recorded joints and the model's equalities."""

from __future__ import annotations

import copy
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sim2real.composer.physics.mjx.import_mjx import held_links, mjx
from sim2real.types import MjModel, PyTree

mj: Any = mujoco

_PATH, _CORRECTIONS = 32, 8
"""Number of steps from the model's start to the recorded angles, and of Newton steps at the end. A loop has several
solutions: small steps keep to the solution at the model's start.
"""
_DAMPING = 1e-6
"""Damping of the least squares, as a share of the rows' mean square: a planar loop has redundant rows."""
_MOST = 0.3
"""Largest correction of a step [rad or m]."""
_OTHERS = ("LIMIT", "FRICTIONLOSS", "CONTACT")
"""Kinds of constraints besides equalities."""


class Closing:
    """Solves the equalities of a model for the joints that were not recorded.

    Args:
        model: Model whose first keyframe, or zero, is the start.
        qpos_at: Shape ``(joints,)``: indices of the recorded joints' positions.
        qvel_at: Shape ``(joints,)``: indices of their velocities.
    """

    def __init__(self, model: MjModel, qpos_at: np.ndarray, qvel_at: np.ndarray) -> None:
        # A model with equalities as its only constraints.
        equalities: Any = copy.copy(model)
        for kind in _OTHERS:
            equalities.opt.disableflags |= int(getattr(mj.mjtDisableBit, f"mjDSBL_{kind}"))
        self._model, self._data = mjx.put_model(equalities, impl="jax"), mjx.make_data(equalities, impl="jax")
        self._start = np.array(model.key_qpos[0] if model.nkey else model.qpos0)
        self._qpos_at, self._qvel_at = qpos_at, qvel_at
        self._others = np.setdiff1d(np.arange(model.nv), qvel_at)
        # Steps turn quaternions, and are added to other positions.
        self._turning = [
            (int(model.jnt_qposadr[i]) + 3 * free, int(model.jnt_dofadr[i]) + 3 * free)
            for i in range(model.njnt)
            if (free := model.jnt_type[i] == mj.mjtJoint.mjJNT_FREE) or model.jnt_type[i] == mj.mjtJoint.mjJNT_BALL
        ]
        turning = {q + k for q, _ in self._turning for k in range(4)}
        self._straight = np.array([i for i in range(model.nq) if i not in turning], int)
        turned = {v + k for _, v in self._turning for k in range(3)}
        self._straight_dofs = np.array([i for i in range(model.nv) if i not in turned], int)

    @functools.partial(jax.jit, static_argnums=0)
    def __call__(self, angle: jax.Array, speed: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return positions ``(nq,)`` and velocities ``(nv,)`` with closed loops.

        Args:
            angle: Shape ``(joints,)``: angles of the recorded joints [rad or m].
            speed: Shape ``(joints,)``: speeds of the recorded joints [rad/s or m/s].
        """
        begin = jnp.asarray(self._start, jnp.result_type(float))
        first = begin[self._qpos_at]

        def nearer(carry: tuple[jax.Array, jax.Array], share: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
            """Repeat the motion of the last step, which passes dead centres, then correct."""
            before, rate = carry
            going = share < 1.0
            qpos = (before + going * rate).at[self._qpos_at].set(first + share * (angle - first))
            error, jacobian = self._rows(qpos)
            qpos = self._moved(qpos, -self._solved(jacobian, error))
            return (qpos, jnp.where(going, qpos - before, rate) * straight), None

        straight = jnp.zeros(len(begin)).at[self._straight].set(1.0)
        shares = np.concatenate([np.linspace(1 / _PATH, 1, _PATH), np.ones(_CORRECTIONS)])
        qpos = jax.lax.scan(nearer, (begin, jnp.zeros(len(begin))), jnp.asarray(shares, begin.dtype))[0][0]
        _, jacobian = self._rows(qpos)
        qvel = -self._solved(jacobian, jacobian[:, self._qvel_at] @ speed, np.inf)
        return qpos, qvel.at[self._qvel_at].set(speed)

    def gap(self, angle: jax.Array) -> jax.Array:
        """Return the largest error of the equalities at recorded angles ``(joints,)``; above 0 if a loop stays open."""
        return jnp.abs(self._rows(self(angle, jnp.zeros(len(self._qvel_at)))[0])[0]).max(initial=0.0)

    def _rows(self, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return errors ``(rows,)`` and Jacobian ``(rows, nv)`` of the equalities."""
        with held_links():
            data: PyTree = mjx.com_pos(self._model, mjx.kinematics(self._model, self._data.replace(qpos=qpos)))
        if self._model.ntendon:
            data = mjx.tendon(self._model, data)
        data = mjx.make_constraint(self._model, data)
        return data._impl.efc_pos, data._impl.efc_J

    def _solved(self, jacobian: jax.Array, error: jax.Array, most: float = _MOST) -> jax.Array:
        """Return the smallest motion ``(nv,)`` of the other joints that changes the equalities by ``error``."""
        passive = jacobian[:, self._others]
        square = passive @ passive.T
        damping = _DAMPING * jnp.trace(square) / max(len(error), 1) + 1e-12
        move = passive.T @ jnp.linalg.solve(square + damping * jnp.eye(len(error)), error)
        move *= jnp.minimum(1.0, most / (jnp.abs(move).max() + 1e-12))
        return jnp.zeros(jacobian.shape[1], move.dtype).at[self._others].set(move)

    def _moved(self, qpos: jax.Array, step: jax.Array) -> jax.Array:
        """Return positions ``(nq,)`` after a small motion ``(nv,)``."""
        closed = qpos.at[self._straight].add(step[self._straight_dofs])
        for q, v in self._turning:
            x = jnp.concatenate([jnp.ones(1), 0.5 * step[v : v + 3]])
            a, b = qpos[q], qpos[q + 1 : q + 4]
            turned = jnp.concatenate([(a * x[0] - b @ x[1:])[None], a * x[1:] + x[0] * b + jnp.cross(b, x[1:])])
            closed = closed.at[q : q + 4].set(turned / jnp.linalg.norm(turned))
        return closed
