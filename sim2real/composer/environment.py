"""A task as a reinforcement learning environment on MuJoCo's C engine."""

from __future__ import annotations

import copy
import logging
import math
import warnings
import weakref
from collections import OrderedDict
from enum import Enum
from typing import TYPE_CHECKING

import dm_env
import numpy as np

from sim2real.composer.errors import EpisodeInitializationError, PhysicsError
from sim2real.composer.hooks import Hooks
from sim2real.composer.mjcf.schema import mj
from sim2real.composer.observation.updater import Updater
from sim2real.composer.physics.c.physics import Physics
from sim2real.composer.task import Task, count_steps, split_reward
from sim2real.errors import UsageError
from sim2real.types import PyTree

if TYPE_CHECKING:
    from sim2real.composer.entity import Entity
    from sim2real.composer.types import Hook

_log = logging.getLogger(__name__)


class ObservationPadding(Enum):
    """Values that fill a buffer until enough samples have arrived."""

    INITIAL_VALUE = -1
    """The first sample."""
    ZERO = 0
    """Zeros."""


class Observation(OrderedDict[str, PyTree]):
    """Name -> array; the models before a name may be left out, if only one key ends with it."""

    def __missing__(self, key: str) -> PyTree:
        matches = [k for k in self if k.endswith(f"/{key}")]
        if len(matches) == 1:
            return self[matches[0]]
        raise KeyError(f"{key!r}. Available: {', '.join(self)}")


class Environment(dm_env.Environment):
    """Runs a task, with the interface of ``dm_env``.

    Args:
        time_limit: Longest episode [s]; it ends after the first control step that reaches it.
        n_sub_steps: Physics steps in a control step; deprecated, set the task's time steps.
        raise_exception_on_physics_error: Whether to raise MuJoCo's warnings; otherwise they end the episode with
            discount 0.
        strip_singleton_obs_buffer_dim: Whether to leave out the first axis of observations with one sample.
        max_reset_attempts: How often a reset is tried if it raises ``EpisodeInitializationError``.
        recompile_mjcf_every_episode: Whether to run ``initialize_episode_mjcf`` and compile at every reset, not only at
            the first.
        fixed_initial_state: Whether to draw the same random numbers at every reset.
        legacy_step: Whether to compute positions and velocities of the new state after a step.
        arena: The root entity of a task that has none.

    Raises:
        UsageError: An option is out of its range.
    """

    def __init__(
        self,
        task: Task,
        time_limit: float = math.inf,
        random_state: np.random.RandomState | int | None = None,
        n_sub_steps: int | None = None,
        raise_exception_on_physics_error: bool = True,
        strip_singleton_obs_buffer_dim: bool = False,
        max_reset_attempts: int = 1,
        recompile_mjcf_every_episode: bool = True,
        fixed_initial_state: bool = False,
        delayed_observation_padding: ObservationPadding = ObservationPadding.ZERO,
        legacy_step: bool = True,
        *,
        arena: Entity | None = None,
    ) -> None:
        # Arguments of dm_control, some of them deprecated.
        if not isinstance(delayed_observation_padding, ObservationPadding):
            raise UsageError(
                "`delayed_observation_padding` should be an `ObservationPadding` enum value: "
                f"got {delayed_observation_padding}"
            )
        if arena is not None:
            task._root_entity = arena
        if n_sub_steps is not None:
            warnings.warn("`n_sub_steps` is deprecated: set the task's time steps", DeprecationWarning, stacklevel=2)
        self._task, self._time_limit, self._fixed_sub_steps = task, time_limit, n_sub_steps
        self._random_state = (
            random_state if isinstance(random_state, np.random.RandomState) else np.random.RandomState(random_state)
        )
        self._raise_on_physics_error = raise_exception_on_physics_error
        self._strip, self._padding = strip_singleton_obs_buffer_dim, delayed_observation_padding
        self._max_reset_attempts, self._recompile = max_reset_attempts, recompile_mjcf_every_episode
        self._fixed_initial_state, self._legacy_step = fixed_initial_state, legacy_step
        # The state of the environment; ``_build`` compiles the physics.
        self._compiled_by_reset = False
        self._physics: PyTree = None
        self._text, self._model = "", None
        self._hooks = Hooks(task)
        self._build()
        self._fixed_random_state = self._random_state.get_state()
        self._reset_next_step = True
        self._steps_taken = 0

    def _build(self) -> None:
        """If the models have changed, compile them; start from their initial state."""
        self._drop()
        model = self._task.root_entity.mjcf_model.root_model
        text = model.to_xml_string()  # the text names files by their contents
        if text != self._text:
            self._model, self._text = mj.MjModel.from_xml_string(text, model.get_assets()), text
        # Each episode has new memory, so that arrays of earlier episodes stay as they were.
        self._physics = Physics(copy.copy(self._model), self._legacy_step)
        self._proxy: PyTree = weakref.proxy(self._physics)
        steps = self._fixed_sub_steps or self._task.physics_steps_per_control_step
        self._n_sub_steps = steps
        self._step_limit = count_steps(self._time_limit, self._physics.timestep() * steps)
        self._hooks.refresh()
        self._hooks.run("after_compile", self._proxy, self._random_state)
        self._updater, self._is_probed = self._make_updater(), False

    def _make_updater(self) -> Updater:
        initial = self._padding is ObservationPadding.INITIAL_VALUE
        return Updater(self._task.observables, self._n_sub_steps, self._strip, initial)

    @property
    def task(self) -> Task:
        """The task."""
        return self._task

    @property
    def physics(self) -> Physics:
        """The physics, as a weak reference, valid until the models are compiled again or ``close`` is called."""
        return self._proxy

    @property
    def random_state(self) -> np.random.RandomState:
        """The source of randomness."""
        return self._random_state

    def control_timestep(self) -> float:
        """Return the time between two actions [s]."""
        if self._fixed_sub_steps is not None:
            return self._physics.timestep() * self._fixed_sub_steps
        return self._task.control_timestep

    def add_extra_hook(self, hook_name: str, hook_callable: Hook) -> None:
        """Run a function after the hooks of the task and its entities, with the arguments of the task's hook.

        Raises:
            UsageError: There is no such hook, or ``hook_callable`` is no function.
        """
        self._hooks.add(hook_name, hook_callable)

    def reset(self) -> dm_env.TimeStep:
        """Start an episode; raise EpisodeInitializationError if all attempts fail."""
        self._reset_next_step = True
        for attempt in range(1, self._max_reset_attempts + 1):
            try:
                return self._reset_attempt()
            except EpisodeInitializationError as error:
                if attempt >= self._max_reset_attempts:
                    raise
                _log.error("Error during episode reset: %s", error)
        raise UsageError(f"max_reset_attempts must be at least 1, got {self._max_reset_attempts}")

    def _reset_attempt(self) -> dm_env.TimeStep:
        if self._recompile or not self._compiled_by_reset:
            if self._fixed_initial_state:
                self._random_state.set_state(self._fixed_random_state)
            self._hooks.run("initialize_episode_mjcf", self._random_state)
            self._build()
            self._compiled_by_reset = True
        if self._fixed_initial_state:
            self._random_state.set_state(self._fixed_random_state)
        with self._physics.reset_context():
            self._hooks.run("initialize_episode", self._proxy, self._random_state)
        self._updater.reset(self._proxy, self._random_state)
        self._is_probed = True
        self._reset_next_step, self._steps_taken = False, 0
        return dm_env.restart(self._observe())

    def step(self, action: PyTree) -> dm_env.TimeStep:
        """Advance by a control step under an action; without an episode, start one and ignore the action."""
        if self._reset_next_step:
            return self.reset()
        # Run the hooks and the physics steps; a warning of MuJoCo ends the episode, or is raised.
        diverged = False
        self._hooks.run("before_step", self._proxy, action, self._random_state)
        self._updater.prepare_for_next_control_step()
        try:
            for i in range(self._n_sub_steps):
                self._hooks.run("before_substep", self._proxy, action, self._random_state)
                self._physics.step()
                self._hooks.run("after_substep", self._proxy, self._random_state)
                if i < self._n_sub_steps - 1:  # the last step is observed after hooks that may change the state
                    self._updater.update()
        except PhysicsError as error:
            if self._raise_on_physics_error:
                raise
            _log.warning("%s", error)
            diverged = True
        # Take the last samples after the hooks, which may change the state.
        self._hooks.run("after_step", self._proxy, self._random_state)
        self._updater.update()
        self._steps_taken += 1
        # A diverged episode has no reward, and discount 0.
        reward, discount, last = 0.0, 0.0, True
        if not diverged:
            reward, discount, ends = self._hooks.judge(self._proxy)
            if self._task.get_reward_spec() is None:
                reward, _ = split_reward(reward)
            last = bool(ends) or self._steps_taken >= self._step_limit
        self._reset_next_step = last
        step_type = dm_env.StepType.LAST if last else dm_env.StepType.MID
        return dm_env.TimeStep(step_type, reward, discount, self._observe())

    def _observe(self) -> PyTree:
        values = self._updater.get_observation()
        return Observation(values) if isinstance(values, dict) else values

    def action_spec(self) -> PyTree:
        """Return shape and bounds of an action."""
        return self._task.action_spec(self._proxy)

    def observation_spec(self) -> PyTree:
        """Return name -> shape and dtype; before the first reset the observables are sampled for it."""
        if not self._is_probed:
            self._updater.reset(self._proxy, np.random.RandomState(0))
            self._is_probed = True
        return self._updater.observation_spec()

    def reward_spec(self) -> PyTree:
        """Return the task's reward spec; default: a number."""
        spec = self._task.get_reward_spec()
        return super().reward_spec() if spec is None else spec

    def discount_spec(self) -> PyTree:
        """Return the task's discount spec; default: a number in [0, 1]."""
        spec = self._task.get_discount_spec()
        return super().discount_spec() if spec is None else spec

    def close(self) -> None:
        """Free the physics."""
        self._drop()

    def _drop(self) -> None:
        if self._physics is not None:
            self._physics.free()
        self._physics = None
