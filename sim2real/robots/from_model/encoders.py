"""Encoders of the joints of a recorded robot."""

from __future__ import annotations

import jax.numpy as jnp

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.types import Array, Key
from sim2real.worlds.drive_terms import DriveTerms
from sim2real.worlds.driven import DrivenWorld


@pytree.dataclass
class Measured(Base):
    """Readings of the encoders, each of shape ``(joints,)`` [rad, rad/s]; None without a velocity."""

    position: Array
    velocity: Array | None = None


class Encoders(BaseNode):
    """Reads the joints of a ``DrivenWorld``.

    Args:
        rate: Samples per second [Hz].
    """

    def __init__(self, name: str, rate: float, world: DrivenWorld, velocity: bool) -> None:
        super().__init__(name, rate)
        self._world, self._velocity = world, velocity

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> EncoderParams:
        """Return encoders that read 0 at the model's zero."""
        world = self._world.init_params(rng, graph_state)
        return EncoderParams(jnp.zeros(len(self._world.qpos_at)), world.terms)

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> Measured:
        """Return zeros."""
        del rng, graph_state
        still = jnp.zeros(len(self._world.qpos_at))
        return Measured(still, still if self._velocity else None)

    def step(self, step_state: StepState) -> tuple[StepState, Measured]:
        """Read."""
        message, params = step_state.inputs[self._world.name][-1].data, step_state.params
        angle, speed = message.qpos[self._world.qpos_at], message.qvel[self._world.qvel_at]
        if params.terms is not None:
            angle, speed = params.terms.read(angle), params.terms.rate(angle, speed)
        return step_state, Measured(angle + params.zero, speed if self._velocity else None)


@pytree.dataclass
class EncoderParams(Base):
    """Parameters of the encoders.

    Attributes:
        zero: Readings at the model's zero, ``(joints,)`` [rad].
        terms: The drives' own, which say how far each is off its axis; None: not at all.
    """

    zero: Array
    terms: DriveTerms | None = None
