"""What identification needs of a robot: its measured fields, and a graph or a simulation that predicts them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, TypeVar, runtime_checkable

import numpy as np

from sim2real.graph.episode import Episode
from sim2real.graph.node import BaseNode
from sim2real.identification.parameters import ParameterTable
from sim2real.later import jax
from sim2real.types import Array, MjSpec, PyTree

Rows = TypeVar("Rows", np.ndarray, "jax.Array")


@dataclass(frozen=True)
class Channel:
    """A measured joint.

    Attributes:
        position: Field of the angle or position.
        velocity: Field of its velocity; None if the log has none.
        position_sigma: Standard deviation of a measured position [position's unit].
        velocity_sigma: Standard deviation of a measured velocity, or of one estimated from a few positions.
        index: Entry of the fields, if they are vectors.
        label: Name for tables; default: the position's field.
        goal: Field of the command with the joint's goal, in the position's unit and at the same index; None if commands
            are no positions.
    """

    position: str
    velocity: str | None
    position_sigma: float
    velocity_sigma: float
    index: int | None = None
    label: str = ""
    goal: str | None = None

    @property
    def name(self) -> str:
        """The channel's name in tables."""
        return self.label or (self.position if self.index is None else f"{self.position}[{self.index}]")

    @property
    def fields(self) -> tuple[tuple[str, float], ...]:
        """Field and standard deviation of position and velocity, in the order of residuals."""
        both = ((self.position, self.position_sigma), (self.velocity, self.velocity_sigma))
        return tuple((f, s) for f, s in both if f is not None)

    def of(self, rows: Rows) -> Rows:
        """Return the channel's entry of a field, ``(..., F)`` -> ``(...)``."""
        return rows if self.index is None else rows[..., self.index]


def position_of(channel: Channel) -> str:
    """Return the name of the column with a channel's position."""
    return channel.position if channel.index is None else f"{channel.position}[{channel.index}]"


def measured_channels(model: IdentifiableModel, episodes: Sequence[Episode]) -> IdentifiableModel:
    """Return the model without velocities that the logs lack, such as logs of other recorders."""
    for episode in episodes:
        fields = episode.outputs.get(model.sensor, {})
        if any(c.velocity is not None and c.velocity not in fields for c in model.channels):
            model.channels = tuple(replace(c, velocity=None) for c in model.channels)
    return model


class IdentifiableModel(Protocol):
    """The interface of a robot for identification.

    Attributes:
        sensor: Node whose outputs are predicted.
        given: Nodes whose recorded outputs drive the model: node -> a message with field names as its leaves.
        channels: The measured joints; an initial state has a position and a velocity of each.
        ahead_s: How much later the sensor's steps are simulated than recorded [s]; ``params`` adds it to the sensor's
            delay, so that the prediction does not shift. 0 if samples fall on the world's ticks; one tick if the sensor
            interpolates between ticks, as it needs the tick after the sample.
    """

    parameters: ParameterTable
    sensor: str
    given: Mapping[str, PyTree]
    channels: tuple[Channel, ...]
    ahead_s: float

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, given nodes and world, connected with trainable delays up to ``max_delay_s``."""
        ...

    def params(self, values: Mapping[str, Array], start: Array) -> dict[str, PyTree]:
        """Return node parameters for values and an initial state ``(2 * channels,)``: positions, then velocities."""
        ...


@runtime_checkable
class HasLimits(Protocol):
    """A model with limits among its optional terms."""

    def reached(self, recordings: Sequence[Episode]) -> Mapping[str, float]:
        """Return for each limit the largest value that recordings reach."""
        ...


@runtime_checkable
class CarriesPayload(Protocol):
    """A model with a payload that differs between logs."""

    def loaded(self, params: dict[str, PyTree], first: Mapping[str, PyTree]) -> dict[str, PyTree]:
        """Return node parameters with the payload that the first command of each given node names."""
        ...


@runtime_checkable
class ChecksLogs(Protocol):
    """A model that does not describe the motion of all logs."""

    def check(self, episode: Episode) -> None:
        """Raise a ``Sim2RealError`` if the model does not describe a log's motion, such as a walk of legs."""
        ...


@dataclass(frozen=True)
class PlainSimulation:
    """A robot for a simulation in MuJoCo without sim2real.

    Attributes:
        mjcf: The model with the estimates.
        joints: Joint of each channel.
        tick_s: Time over which a command acts as its mean [s].
        begin: Measured positions and velocities ``(2 * channels,)`` -> ``qpos`` and ``qvel``.
        law: Name of the function of ``reproduce.py`` that simulates the drives.
        numbers: Numbers for this function.
        integrator: MuJoCo's integrator, or the function ``verlet`` in ``reproduce.py``.
        lead_s: Time that is added to the delay of commands, because MuJoCo moves joints half a step early [s].
        velocity_lead_s: Time by which velocities are extrapolated [s].
    """

    mjcf: str
    joints: tuple[str, ...]
    tick_s: float
    begin: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    law: Literal["held", "setpoint", "drive"] = "held"
    numbers: Mapping[str, np.ndarray] = field(default_factory=dict)
    integrator: Literal["mj_step", "verlet"] = "mj_step"
    lead_s: float = 0.0
    velocity_lead_s: float = 0.0


def converged(spec: MjSpec) -> str:
    """Return a model as MJCF, with the solver's iterations of an identification on C MuJoCo.

    Args:
        spec: Changed in place.
    """
    spec.option.iterations = max(spec.option.iterations, 100)
    spec.option.ls_iterations = max(spec.option.ls_iterations, 50)
    spec.compile()
    return spec.to_xml()
