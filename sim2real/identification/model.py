"""The part of a robot that identification uses: its measured fields, and a graph or a plain simulation of them."""

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
        velocity: Field of its rate; None if the log has none.
        position_sigma: Deviation of a measured position [position's unit].
        velocity_sigma: Deviation of a measured velocity, or of one estimated from a few positions.
        index: Entry of the fields, if they are vectors.
        label: Name for tables; default: the position's field.
        goal: Field of a command that holds the joint's goal, in the position's unit and under the same index; None if
            commands are no positions.
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
        """Field and deviation of position and velocity, in the order of residuals."""
        both = ((self.position, self.position_sigma), (self.velocity, self.velocity_sigma))
        return tuple((f, s) for f, s in both if f is not None)

    def of(self, rows: Rows) -> Rows:
        """Return the channel's entry of a field, ``(..., F)`` -> ``(...)``."""
        return rows if self.index is None else rows[..., self.index]


def position_of(channel: Channel) -> str:
    """Return the name of a channel's position among the columns."""
    return channel.position if channel.index is None else f"{channel.position}[{channel.index}]"


def measured_channels(model: IdentifiableModel, episodes: Sequence[Episode]) -> IdentifiableModel:
    """Return the model without the velocities that a log lacks, as files of other recorders do."""
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
        channels: Initial states have a position and a velocity for each.
        ahead_s: Delay of the sensor's simulated steps behind the recorded ones [s]; ``params`` adds it to the sensor's
            delay, so the prediction does not shift. 0 if samples fall on the world's ticks; one tick if the sensor
            interpolates between ticks, as it reads the tick after the sample.
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
        """Return limit -> the largest value that recordings reach."""
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
        """Raise a ``Sim2RealError`` if a log is of another motion, such as a walk beside a model of legs in a stand."""
        ...


@dataclass(frozen=True)
class PlainSimulation:
    """A robot for a simulation in plain MuJoCo.

    Attributes:
        mjcf: The model with the estimates.
        joints: Joint of each channel.
        tick_s: Time over which a command acts as its mean [s].
        begin: Measured positions and velocities ``(2 * channels,)`` -> ``qpos`` and ``qvel``.
        law: Law of the drives, a function in ``reproduce.py``.
        numbers: Numbers of that law.
        integrator: MuJoCo's own, or the function ``verlet`` in ``reproduce.py``.
        lead_s: Time that is added to the delay of commands, as MuJoCo moves joints half a step early [s].
        velocity_lead_s: Time over which velocities are extrapolated [s].
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
    """Return a model as MJCF whose solver iterates as often as in an identification on C MuJoCo.

    Args:
        spec: A ``mujoco.MjSpec``; it is changed.
    """
    spec.option.iterations = max(spec.option.iterations, 100)
    spec.option.ls_iterations = max(spec.option.ls_iterations, 50)
    spec.compile()
    return spec.to_xml()
