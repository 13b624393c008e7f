"""The messages of a robot with a floating base."""

from __future__ import annotations

from typing import Any

from sim2real import pytree
from sim2real.arrays import namespace
from sim2real.graph.base import Base
from sim2real.types import Array


@pytree.dataclass
class BodyReading(Base):
    """A measurement of encoders and IMU.

    Attributes:
        position: Shape ``(joints,)`` [rad].
        velocity: Shape ``(joints,)`` [rad/s].
        quaternion: Shape ``(4,)``: orientation of the base in the world, w first.
        gyro: Shape ``(3,)``: angular velocity in the axes of the base [rad/s].
    """

    position: Array
    velocity: Array
    quaternion: Array
    gyro: Array


@pytree.dataclass
class WalkDecision(Base):
    """The agent's message.

    Attributes:
        q: Shape ``(joints,)``: targets of the joints [rad].
        aim: Shape ``(3,)``: the commanded velocity: forwards, to the left [m/s], yaw rate [rad/s].
    """

    q: Array
    aim: Array


@pytree.dataclass
class LegCommand(Base):
    """The command of the motors, each ``(joints,)``: its torque is ``tau + kp (q - position) + kd (dq - velocity)``.

    Attributes:
        q: Targets [rad].
        dq: Velocities [rad/s].
        kp: Gains of the position [N m/rad].
        kd: Gains of the velocity [N m s/rad].
        tau: Torques [N m].
    """

    q: Array
    dq: Array
    kp: Array
    kd: Array
    tau: Array


def leg_command(q: Array, kp: float, kd: float) -> LegCommand:
    """Return the command of targets ``(joints,)`` with the same gains for all motors."""
    xp = namespace(q)
    zero = xp.zeros_like(q)
    return LegCommand(q, zero, zero + kp, zero + kd, zero)


def into_base(quaternion: Array, vector: Any) -> Array:
    """Return a vector of the world ``(3,)`` in the axes of the base.

    Args:
        quaternion: Shape ``(4,)``, w first; its length is taken out, as the mean of two orientations is shorter than 1.
    """
    xp = namespace(quaternion, vector)
    unit = quaternion / xp.sqrt(xp.sum(quaternion**2))
    w, u = unit[0], -unit[1:]
    vector = xp.asarray(vector, dtype=unit.dtype)
    return vector + 2.0 * xp.cross(u, xp.cross(u, vector) + w * vector)


def gravity_of(quaternion: Array) -> Array:
    """Return the direction of gravity in the axes of the base, shape ``(3,)``; ``(0, 0, -1)`` while it is level."""
    return into_base(quaternion, (0.0, 0.0, -1.0))
