"""Robots: entities with actuators."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.entity import Entity
from sim2real.composer.mjcf.element import Element

if TYPE_CHECKING:
    from collections.abc import Sequence

DOWN_QUATERNION = np.array([0.0, 0.70710678118, 0.70710678118, 0.0])
"""The orientation of a hand that points down."""
SENSOR_SITES_GROUP = 4
"""The group of sites that sensors are attached to."""


class Robot(Entity):
    """An entity that is driven by actuators."""

    @property
    @abstractmethod
    def actuators(self) -> Sequence[Element]:
        """The actuators, in the order of an action."""

    @property
    def joints(self) -> list[Element]:
        """The joints; default: all joints of the robot's own model."""
        return self.mjcf_model.find_all("joint", exclude_attachments=True)
