"""The messages between the nodes of a robot."""

from sim2real import pytree
from sim2real.graph.base import Base
from sim2real.types import Array, PyTree


@pytree.dataclass
class JointReading(Base):
    """A measurement.

    Attributes:
        position: Shape ``(joints,)`` [rad].
        velocity: Shape ``(joints,)`` [rad/s]; None: it is not measured.
    """

    position: Array
    velocity: PyTree = None


@pytree.dataclass
class Goals(Base):
    """A command.

    Attributes:
        goal: Shape ``(joints,)``: goal positions [rad].
    """

    goal: Array


@pytree.dataclass
class Decision(Base):
    """The agent's message: what the motors shall do, and the aim of the task.

    Attributes:
        command: Shape ``(actions,)``: the command, such as goal positions [rad].
        aim: Shape ``(k,)``: the task's aim at this time, e.g. a target's position ``(3,)`` [m]; None: it has none.
    """

    command: Array
    aim: Array | None = None


@pytree.dataclass
class EpisodeStart(Base):
    """The start and the aim of an episode.

    Attributes:
        position: Shape ``(channels,)``: positions of the joints [rad].
        velocity: Shape ``(channels,)`` [rad/s].
        aim: Shape ``(k,)``: the task's aim, e.g. a target's position ``(3,)`` [m].
        command: Shape ``(actions,)``: the command before the first step; None: the positions are.
    """

    position: Array
    velocity: Array
    aim: Array
    command: Array | None = None
