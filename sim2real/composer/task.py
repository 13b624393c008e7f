"""Tasks: what an agent has to do in a world."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import reduce
from operator import add
from typing import TYPE_CHECKING

import numpy as np
from dm_env import specs

from sim2real.composer import define
from sim2real.composer.arena import Arena
from sim2real.composer.entity import Entity, WithHooks
from sim2real.composer.observation.observable.base import Generic
from sim2real.composer.physics.layout import names_of
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.observation.observable.base import Observable
    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import Array, RandomState
    from sim2real.types import PyTree

UNLIMITED = 1e10
"""Bound in dm_control's specs of an action without bounds."""


def _steps(control_timestep: float, physics_timestep: float) -> int:
    """Return how many physics steps a control step has."""
    ratio = control_timestep / physics_timestep
    steps = round(ratio)
    if abs(ratio - steps) > 1e-6:
        raise UsageError(
            "Control timestep should be an integer multiple of physics timestep: "
            f"got {control_timestep!r} and {physics_timestep!r}"
        )
    if steps < 1:
        raise UsageError(
            f"a control step of {control_timestep!r} s is shorter than a physics step of {physics_timestep!r} s"
        )
    return steps


def count_steps(time_limit: float, control_timestep: float) -> float:
    """Return after how many control steps a time limit [s] is reached; infinite without one."""
    limit = time_limit / control_timestep
    return math.ceil(limit - 1e-6) if math.isfinite(limit) else math.inf


def split_reward(reward: PyTree) -> tuple[PyTree, dict[str, PyTree]]:
    """Return a task's reward as a number, the sum of its terms, and the terms by name.

    Raises:
        UsageError: The dictionary of terms is empty.
    """
    if not isinstance(reward, Mapping):
        return reward, {}
    if not reward:
        raise UsageError("the task's get_reward returned no terms", hint="return a number, or terms by name")
    return reduce(add, reward.values()), dict(reward)


class Task(WithHooks):
    """Reward, termination and the initial state of an episode, in a world of entities."""

    _root_entity: Entity | None = None

    @property
    def root_entity(self) -> Entity:
        """The entity that holds all others; subclasses override it, or the environment sets it."""
        if self._root_entity is None:
            raise NotImplementedError(f"{type(self).__name__} has no root_entity: define it, or pass an arena")
        return self._root_entity

    def iter_entities(self) -> Iterator[Entity]:
        """Yield all entities, depth first."""
        return self.root_entity.iter_entities()

    @property
    def observables(self) -> OrderedDict[str, Observable]:
        """Name -> observable: those of the task, then those of every entity."""
        observables: OrderedDict[str, Observable] = OrderedDict()
        for name, function in define.declared(self).items():
            observables[name] = Generic(function)
            observables[name].enabled = True
        observables.update(self.task_observables)
        for entity in self.iter_entities():
            observables.update(entity.observables.as_dict())
        return observables

    @property
    def task_observables(self) -> Mapping[str, Observable]:
        """Name -> observable, for observables that belong to no entity."""
        return OrderedDict()

    def _check_root_entity(self, name: str) -> None:
        try:
            _ = self.root_entity
        except Exception as error:
            raise error from RuntimeError(f"call to `{name}` made before `root_entity` is available")

    @property
    def control_timestep(self) -> float:
        """Time between two actions [s]; default: the physics's time step."""
        self._check_root_entity("control_timestep")
        return self.__dict__.get("_control_timestep", self.physics_timestep)

    @control_timestep.setter
    def control_timestep(self, value: float) -> None:
        self._check_root_entity("control_timestep")
        _steps(value, self.physics_timestep)
        self._control_timestep = value

    @property
    def physics_timestep(self) -> float:
        """Time step of the physics [s]."""
        self._check_root_entity("physics_timestep")
        return self.root_entity.mjcf_model.option.timestep or 0.002

    @physics_timestep.setter
    def physics_timestep(self, value: float) -> None:
        self._check_root_entity("physics_timestep")
        if "_control_timestep" in self.__dict__:
            _steps(self._control_timestep, value)
        self.root_entity.mjcf_model.option.timestep = value

    def set_timesteps(self, control_timestep: float, physics_timestep: float) -> None:
        """Set both time steps [s]; raise UsageError if a control step is no whole number of physics steps."""
        self._check_root_entity("set_timesteps")
        _steps(control_timestep, physics_timestep)
        self.root_entity.mjcf_model.option.timestep = physics_timestep
        self._control_timestep = control_timestep

    @property
    def physics_steps_per_control_step(self) -> int:
        """Physics steps in a control step."""
        return _steps(self.control_timestep, self.physics_timestep)

    def action_spec(self, physics: BasePhysics) -> specs.BoundedArray:
        """Return shape ``(nu,)`` and bounds of an action; its name lists the actuators, separated by tabs."""
        model = physics.model
        limited = np.asarray(model.actuator_ctrllimited, bool)
        low, high = np.asarray(model.actuator_ctrlrange, float).T
        names = names_of(physics.model.ptr, "actuator")
        return specs.BoundedArray(
            (model.nu,),
            float,
            np.where(limited, low, -UNLIMITED),
            np.where(limited, high, UNLIMITED),
            name="\t".join(name or str(i) for i, name in enumerate(names)),
        )

    def get_reward_spec(self) -> specs.Array | None:
        """Return the spec of the reward; None: a number."""
        return None

    def get_discount_spec(self) -> specs.BoundedArray | None:
        """Return the spec of the discount; None: a number in [0, 1]."""
        return None

    # -- hooks

    def before_step(self, physics: BasePhysics, action: PyTree, random_state: RandomState) -> None:
        """Act before a control step; default: the action, shape ``(nu,)``, becomes the control."""
        del random_state
        physics.set_control(action)

    def before_substep(self, physics: BasePhysics, action: PyTree, random_state: RandomState) -> None:
        """Act before a step of the physics."""

    @abstractmethod
    def get_reward(self, physics: BasePhysics) -> PyTree:
        """Return the reward of the last step, or its terms by name, which are added up."""

    def should_terminate_episode(self, physics: BasePhysics) -> bool | Array:
        """Return whether the episode ends here; default: the result of ``get_termination``."""
        return self.get_termination(physics)

    def get_termination(self, physics: BasePhysics) -> bool | Array:
        """Return whether the episode ends here; another name for ``should_terminate_episode``."""
        del physics
        return False

    def get_discount(self, physics: BasePhysics) -> float | Array:
        """Return the discount of the rewards after this step, in [0, 1]."""
        del physics
        return 1.0


class NullTask(Task):
    """A task without a reward.

    Args:
        root_entity: The entity that holds all others; default: an empty arena.
    """

    def __init__(self, root_entity: Entity | None = None) -> None:
        self._root_entity = Arena() if root_entity is None else root_entity

    def get_reward(self, physics: BasePhysics) -> float:
        """Return 0."""
        del physics
        return 0.0
