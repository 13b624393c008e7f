"""The base class of functions that set an initial state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import RandomState


class Initializer(ABC):
    """Sets a part of the initial state; called from ``initialize_episode``."""

    @abstractmethod
    def __call__(self, physics: BasePhysics, random_state: RandomState) -> Any:
        """Set the state; EpisodeInitializationError when no acceptable state was found."""
