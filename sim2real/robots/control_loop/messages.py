"""The messages between the nodes of a servo robot."""

from __future__ import annotations

from typing import Any

from flax import struct

from sim2real.graph.base import Base


@struct.dataclass
class JointReading(Base):
    """A measurement.

    Attributes:
        position: Shape ``(joints,)`` [rad].
        velocity: Shape ``(joints,)`` [rad/s].
    """

    position: Any
    velocity: Any


@struct.dataclass
class Goals(Base):
    """A command.

    Attributes:
        goal: Shape ``(joints,)``: goal positions [rad].
    """

    goal: Any


@struct.dataclass
class Decision(Base):
    """The agent's message: a command, and what the task asks for.

    Attributes:
        goal: Shape ``(joints,)``: goal positions [rad].
        aim: Shape ``(k,)``: what the task asks for in this episode, e.g. a target's position ``(3,)`` [m].
    """

    goal: Any
    aim: Any


@struct.dataclass
class EpisodeStart(Base):
    """Where an episode starts, and what it is about.

    Attributes:
        position: Shape ``(channels,)``: positions of the joints [rad].
        velocity: Shape ``(channels,)`` [rad/s].
        aim: Shape ``(k,)``: what the task asks for, e.g. a target's position ``(3,)`` [m].
    """

    position: Any
    velocity: Any
    aim: Any
