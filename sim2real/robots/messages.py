"""What the nodes of a servo robot tell each other."""

from __future__ import annotations

from typing import Any

from flax import struct

from sim2real.graph.base import Base


@struct.dataclass
class JointReading(Base):
    """Positions ``(joints,)`` [rad] and velocities ``(joints,)`` [rad/s]."""

    position: Any
    velocity: Any


@struct.dataclass
class Goals(Base):
    """Where the joints are told to be, ``(joints,)`` [rad]."""

    goal: Any


@struct.dataclass
class Decision(Base):
    """What the policy decided, and what for.

    Attributes:
        goal: Where the joints shall be, ``(joints,)`` [rad].
        aim: What the episode is about, in the task's units, such as a target's position ``(3,)`` [m].
    """

    goal: Any
    aim: Any
