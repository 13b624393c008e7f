"""Terms of friction and drive that change with a joint's state, and so from step to step.

Dry friction stays a constraint of MuJoCo, so that a joint sticks; only its size follows the state. The same code runs
in MJX and, on arrays of copies, between the steps of C MuJoCo.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from sim2real import pytree
from sim2real.graph.base import Base
from sim2real.types import Array, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.graph.base import Value


NO_LIMIT = 1e6
"""Value of an absent limit, in its unit: no robot reaches it."""

_TERMS = (
    *("load", "static", "drag", "bias", "damping_bias", "back_emf", "play", "top_speed"),
    *("cogging_cos", "cogging_sin", "eccentric_cos", "eccentric_sin"),
)
"""Terms whose computation is left out if they are absent."""


@pytree.dataclass
class DriveTerms(Base):
    """Coefficients, each of shape ``(joints,)``; with 0 a term adds nothing.

    Attributes:
        load: Dry friction of gears, as a share of the drive's torque [1].
        static: Additional dry friction at standstill (Stribeck effect, Tustin's form) [N m].
        stribeck_rad_s: Speed at which 1/e of ``static`` is left [rad/s].
        drag: Friction proportional to the square of the speed [N m s^2/rad^2].
        bias: Dry friction in positive direction minus the mean of both directions [N m].
        damping_bias: Damping in positive direction minus the mean of both directions [N m s/rad].
        back_emf: Loss of torque per speed by the motor's back-EMF, with torque on; the limit does not hold for it [N m
            s/rad].
        play: Error of the angle below which the drive does not push: dead zone of a servo, play of its gears [rad].
        top_speed: Largest speed at which the drive corrects an error, against the damping of drive and joint [rad/s].
        cogging_cos: Amplitude of the cogging torque with the cosine of ``cogging_per_turn`` times the angle [N m].
        cogging_sin: Amplitude with the sine [N m].
        cogging_per_turn: Number of periods of cogging in a turn of the joint [1].
        eccentric_cos: Amplitude of an eccentric encoder's error with the cosine of the angle [rad].
        eccentric_sin: Amplitude with the sine [rad].
    """

    load: Value = 0.0
    static: Value = 0.0
    stribeck_rad_s: Value = 0.1
    drag: Value = 0.0
    bias: Value = 0.0
    damping_bias: Value = 0.0
    back_emf: Value = 0.0
    play: Value = 0.0
    top_speed: Value = NO_LIMIT
    cogging_cos: Value = 0.0
    cogging_sin: Value = 0.0
    cogging_per_turn: Value = 1.0
    eccentric_cos: Value = 0.0
    eccentric_sin: Value = 0.0

    def read(self, angle: Value) -> Value:
        """Return the readings of eccentric encoders at angles [rad], without their zeros."""
        return angle + self.eccentric_cos * jnp.cos(angle) + self.eccentric_sin * jnp.sin(angle)

    def rate(self, angle: Value, speed: Value) -> Value:
        """Return the rate of change of ``read`` [rad/s]."""
        return speed * (1.0 - self.eccentric_cos * jnp.sin(angle) + self.eccentric_sin * jnp.cos(angle))

    def angle(self, reading: Value) -> Value:
        """Return the angles for readings [rad], by three fixed-point iterations like ``Encoder.angle``."""
        angle = reading
        for _ in range(3):
            angle = reading - (self.read(angle) - angle)
        return angle


class DriveLaw:
    """Sets damping and dry friction of a ``DrivenWorld``'s joints before every step.

    Args:
        qpos_at: Shape ``(joints,)``: indices of the joints' positions.
        qvel_at: Shape ``(joints,)``: indices of their velocities.
        others: Indices of the velocities of joints without a drive; ``qvel_at`` and ``others`` cover the model.
    """

    fields: tuple[str, ...] = ("dof_damping", "dof_frictionloss")
    """Fields of the model that it sets, ``(nv,)`` each."""

    def __init__(self, qpos_at: np.ndarray, qvel_at: np.ndarray, others: np.ndarray) -> None:
        self._qpos_at, self._qvel_at = qpos_at, qvel_at
        order = np.argsort(np.concatenate([qvel_at, others]))
        self._order = None if np.all(order == np.arange(len(order))) else order
        self._size, self._beside = len(order), len(others) > 0
        self._absent: frozenset[str] = frozenset()

    def among(self, values: Mapping[str, np.ndarray]) -> DriveLaw:
        """Return the law without terms that no copy has: in numpy they would take as long as a step in C."""
        law = copy.copy(self)
        law._absent = frozenset(name for name in _TERMS if not np.any(values[name]))
        if np.all(values["top_speed"] >= NO_LIMIT):
            law._absent |= {"top_speed"}
        return law

    def steady(
        self, values: Mapping[str, np.ndarray], control: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]] | None:
        """Return controls of all steps, applied forces, damping and friction; None if a term depends on the state."""
        law, count = self.among(values), len(self._qvel_at)
        same = {"bias"}
        on = control[..., 3 * count : 4 * count]
        if law._has("back_emf") and np.all(on == on[:, :1]):
            same.add("back_emf")
        if law._has(*set(_TERMS) - same):
            return None
        still = np.zeros((len(control), self._size))
        _, applied, fields = law(np, values, control[:, 0], np.zeros((1, 1 + int(self._qpos_at.max()))), still)
        return control[..., : 3 * count], applied, fields

    def __call__(
        self, xp: Any, values: Mapping[str, Scalar], control: Array, qpos: Array, qvel: Array
    ) -> tuple[Any, Any, dict[str, PyTree]]:
        """Return controls ``(..., nu)``, applied forces ``(..., nv)`` and fields of the model for the next step.

        Args:
            values: Coefficients and the model's own ``damping``, ``frictionloss`` and ``limit``, ``(..., joints)``;
                ``other_damping`` and ``other_frictionloss`` of the joints without a drive, ``(..., others)``.
            control: Forces, stiffnesses, dampings, 1 with torque on, goals: ``(..., 5 * joints)``.
            qpos: Positions ``(..., nq)`` [rad].
            qvel: Velocities ``(..., nv)`` [rad/s].
        """
        # Split the controls.
        v, count = values, len(self._qvel_at)
        force, kp, kd, on, goal = (control[..., i * count : (i + 1) * count] for i in range(5))
        angle, speed = qpos[..., self._qpos_at], qvel[..., self._qvel_at]
        braked = on * v["back_emf"] if self._has("back_emf") else 0.0
        if self._has("eccentric_cos", "eccentric_sin", "play", "top_speed"):
            force = self._force(xp, v, (force, kp, kd, goal), angle, braked)
        # Damping of each joint; where it depends on the direction, at least 0: negative damping would drive the joint.
        damping = v["damping"] + v["damping_bias"] * xp.sign(speed) if self._has("damping_bias") else v["damping"]
        damping, fast = xp.maximum(damping, 0.0) + braked, xp.abs(speed)
        if self._has("drag"):
            damping = damping + v["drag"] * fast
        # Dry friction of each joint.
        friction = v["frictionloss"]
        if self._has("static"):
            friction = friction + v["static"] * xp.exp(-fast / v["stribeck_rad_s"])
        if self._has("load"):
            drive = _within(xp, force - kp * angle - kd * speed, v["limit"]) - braked * speed
            friction = friction + v["load"] * xp.abs(drive)
        # Friction that differs by direction is a mean friction and a constant torque, with the same range of sticking.
        still = 0.0 * speed
        applied = still - v["bias"] if self._has("bias") else still
        if self._has("cogging_cos", "cogging_sin"):
            phase = v["cogging_per_turn"] * angle
            applied = applied - v["cogging_cos"] * xp.cos(phase) - v["cogging_sin"] * xp.sin(phase)
        # Add the joints without a drive, in the model's order.
        rows = [still + damping, still + friction, applied]
        if self._beside:
            none = still[..., :1]
            more = (v["other_damping"] + none, v["other_frictionloss"] + none, 0.0 * v["other_damping"] + none)
            rows = [xp.concatenate(pair, axis=-1) for pair in zip(rows, more, strict=True)]
        if self._order is not None:
            rows = [row[..., self._order] for row in rows]
        controls = xp.concatenate([force, kp, kd], axis=-1)
        return controls, rows[2], dict(zip(self.fields, rows, strict=False))

    def _has(self, *names: str) -> bool:
        """Return whether one of some terms is present."""
        return not self._absent.issuperset(names)

    def _force(self, xp: Any, v: Mapping[str, Scalar], control: tuple[Array, ...], angle: Array, braked: Scalar) -> Any:
        """Return the forces after the effects of encoder, dead zone and largest speed.

        Args:
            control: Forces, stiffnesses, dampings and goals.
            braked: Loss of torque per speed by the motor's back-EMF [N m s/rad].
        """
        # A servo sees the error of its encoder, and does not correct an error within its dead zone.
        force, kp, kd, goal = control
        off = 0.0
        if self._has("eccentric_cos", "eccentric_sin"):
            off = v["eccentric_cos"] * xp.cos(angle) + v["eccentric_sin"] * xp.sin(angle)
        error = goal - angle - off
        dead = _within(xp, error, v["play"]) if self._has("play") else 0.0
        if not self._has("top_speed"):
            return force - kp * (off + dead)
        # Limit the push so that damping cancels it at the largest speed.
        top = v["top_speed"]
        push, most = kp * (error - dead), xp.where(top < NO_LIMIT, top * (kd + v["damping"] + braked), xp.inf)
        return force - kp * (off + dead) - push + _within(xp, push, most)


def _within(xp: Any, value: Any, most: Any) -> Any:
    """Clip a value to plus and minus a limit; numpy's ``clip`` takes three times as long on few copies."""
    return xp.minimum(xp.maximum(value, -most), most)
