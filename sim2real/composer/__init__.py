"""Worlds from parts: entities, arenas, tasks, observables and the environment that runs them.

Names and semantics are those of ``dm_control.composer``. ``mjcf`` has models, ``physics`` the two engines.
``BraxEnv`` and ``MjxVectorEnv`` live in ``sim2real.interop``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from sim2real.composer.arena import Arena as Arena
from sim2real.composer.define import abstract_observable as abstract_observable
from sim2real.composer.define import cached_property as cached_property
from sim2real.composer.define import observable as observable
from sim2real.composer.entity import Entity as Entity
from sim2real.composer.entity import FreePropObservableMixin as FreePropObservableMixin
from sim2real.composer.entity import ModelWrapperEntity as ModelWrapperEntity
from sim2real.composer.environment import Environment as Environment
from sim2real.composer.environment import ObservationPadding as ObservationPadding
from sim2real.composer.errors import EpisodeInitializationError as EpisodeInitializationError
from sim2real.composer.errors import PhysicsError as PhysicsError
from sim2real.composer.hooks import HOOK_NAMES as HOOK_NAMES
from sim2real.composer.initializer import Initializer as Initializer
from sim2real.composer.mjcf.model import RootElement
from sim2real.composer.observables import Observables as Observables
from sim2real.composer.physics.c.physics import Physics as Physics
from sim2real.composer.placing import PropPlacer as PropPlacer
from sim2real.composer.robot import SENSOR_SITES_GROUP as SENSOR_SITES_GROUP
from sim2real.composer.robot import Robot as Robot
from sim2real.composer.task import NullTask as NullTask
from sim2real.composer.task import Task as Task
from sim2real.composer.variation.base import Variation as Variation

if TYPE_CHECKING:
    from sim2real.composer.mjx_environment import MjxEnvironment as MjxEnvironment
    from sim2real.interop.brax import BraxEnv as BraxEnv
    from sim2real.interop.vector import CopiesVectorEnv
    from sim2real.worlds.composed import ComposedWorld as ComposedWorld

    MjxVectorEnv = CopiesVectorEnv

Model = RootElement
_LAZY = {
    "BraxEnv": ("sim2real.interop.brax", "BraxEnv"),
    "ComposedWorld": ("sim2real.worlds.composed", "ComposedWorld"),
    "MjxEnvironment": ("sim2real.composer.mjx_environment", "MjxEnvironment"),
    "MjxVectorEnv": ("sim2real.interop.vector", "CopiesVectorEnv"),
}


def __getattr__(name: str) -> object:
    """Import names that need JAX, brax or gymnasium at their first use."""
    if name not in _LAZY:
        raise AttributeError(f"module 'sim2real.composer' has no attribute {name!r}")
    module, attribute = _LAZY[name]
    value = globals()[name] = getattr(importlib.import_module(module), attribute)
    return value
