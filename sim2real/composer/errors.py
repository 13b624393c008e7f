"""Errors of composed worlds."""

from __future__ import annotations

from sim2real.errors import Sim2RealError


class PhysicsError(Sim2RealError, RuntimeError):
    """MuJoCo warned, for example of a state that is not finite, a singular inertia or a full buffer."""


class NotAttachedError(Sim2RealError, RuntimeError):
    """The entity is not attached to another one."""


class EpisodeInitializationError(Sim2RealError, RuntimeError):
    """No acceptable initial state was found; raised by tasks, entities and initializers."""

    def __init__(self, message: str = "the episode could not be initialised", hint: str | None = None) -> None:
        super().__init__(message, hint)
