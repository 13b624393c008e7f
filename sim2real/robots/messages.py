"""The messages between the nodes of a robot, and their fields as columns."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sim2real import pytree
from sim2real.graph.base import Base
from sim2real.graph.delays import DelayDistribution
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
    """The agent's message: the command, and the aim of the task.

    Attributes:
        command: Shape ``(actions,)``: the command, such as goal positions [rad].
        aim: Shape ``(k,)``: the task's aim at this time, e.g. a target's position ``(3,)`` [m]; None: the task has
            none.
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
        command: Shape ``(actions,)``: the command before the first step; None: the positions.
    """

    position: Array
    velocity: Array
    aim: Array
    command: Array | None = None


States = tuple[np.ndarray, dict[str, np.ndarray]]
"""Times ``(N,)`` [s], and columns: states ``(N,)``, and the commands, one a step."""


class Trials(NamedTuple):
    """Episodes of a policy that are simulated beside those on the robot.

    Attributes:
        parameters: Parameters and delays of each simulation; simulation e does trial ``e % len(rest)``.
        computation: Node -> distribution of its computation time.
        rest: The measured positions ``(channels,)`` at the start of each trial.
        duration_s: Length of an episode [s].
        node: The node whose states are scored: the world, or the sensor.
        blend_s: Time in which the action grows from 0 to the policy's [s], as on the robot.
    """

    parameters: Sequence[Mapping[str, float]]
    computation: Mapping[str, DelayDistribution]
    rest: Sequence[np.ndarray]
    duration_s: float
    node: str
    blend_s: float = 0.0


def as_columns(fields: Mapping[str, PyTree]) -> dict[str, np.ndarray]:
    """Return the fields ``(N, ...)`` as columns ``(N,)``: a vector's entries become ``name[i]``."""
    columns = {}
    for name, values in fields.items():
        flat = np.asarray(values).reshape(len(values), -1)
        columns |= {name if flat.shape[1] == 1 else f"{name}[{i}]": column for i, column in enumerate(flat.T)}
    return columns


def as_sent(field: str, decided: Mapping[str, Any], commanded: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns of the agent's message, with the command as it was sent to the motors in a field."""
    return as_columns({**decided, "command": commanded[field]})
