"""A task as a pure environment on MJX: ``reset(key)`` and ``step(state, action)``, to be jitted and vmapped."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real import pytree
from sim2real.composer.environment import ObservationPadding
from sim2real.composer.mjcf.schema import mj
from sim2real.composer.observation.observable.base import MujocoCamera, Observable
from sim2real.composer.observation.rings import Ring, Samples
from sim2real.composer.physics.c.physics import Physics
from sim2real.composer.physics.mjx import gate
from sim2real.composer.physics.mjx.import_mjx import mjx
from sim2real.composer.physics.mjx.physics import MjxPhysics, freeze
from sim2real.composer.physics.mjx.random import JaxRandomState, Registry
from sim2real.composer.physics.mjx.warp import warp
from sim2real.composer.task import Task, count_steps, split_reward
from sim2real.composer.traced_hooks import TracedHooks, check_variables
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from jax.typing import ArrayLike

    from sim2real.composer.entity import Entity
    from sim2real.composer.types import MjModel
    from sim2real.types import PyTree


@pytree.dataclass
class State:
    """One copy of the environment.

    Attributes:
        data: The ``mjx.Data``.
        leaves: Fields of the model that hooks set: name -> array.
        variables: Variables of the task between hooks: name -> array.
        key: Randomness.
        memory: Values that variations keep from draw to draw: name -> array.
        rings: Samples of the observables that may still be read.
        steps: int32: control steps since the reset.
        dirty: Whether hooks changed something after the derived quantities were last computed.
        observation: Name -> array.
        reward: Reward of the last step; 0 after a reset.
        discount: Discount of the following rewards, in [0, 1].
        done: Whether the episode ended with the last step.
        truncated: Whether it ended only because of the time limit.
        failed: Whether no acceptable initial state was found in ``max_reset_attempts`` attempts.
        terms: The terms of the reward by name; empty if it is a single number.
    """

    data: mjx.Data
    leaves: dict[str, jax.Array]
    variables: dict[str, PyTree]
    key: jax.Array
    memory: dict[str, jax.Array]
    rings: dict[str, Samples]
    steps: jax.Array
    dirty: jax.Array
    observation: dict[str, jax.Array]
    reward: jax.Array
    discount: jax.Array
    done: jax.Array
    truncated: jax.Array
    failed: jax.Array
    terms: dict[str, jax.Array]


class MjxEnvironment:
    """Runs a task on MJX.

    The hooks of the task and its entities are the same as on the C engine, but are called while the programs are
    traced: they read and set the physics, compute with ``physics.np``, draw from ``random_state`` and store values for
    later in ``physics.variables``. ``initialize_episode_mjcf`` and ``after_compile`` run once, when the environment is
    made; ``after_compile`` gets the C engine's physics, and its changes to the model are kept.

    Args:
        time_limit: Longest episode [s].
        seed: Seed for ``initialize_episode_mjcf`` and ``after_compile``, which run on the host.
        strip_singleton_obs_buffer_dim: Whether to leave out the first axis of observations with one sample.
        max_reset_attempts: How often the initial state is drawn if hooks call ``physics.fail``.
        legacy_step: Whether to compute positions and velocities of the new state after a step.
        impl: ``"jax"``, or ``"warp"``: MuJoCo Warp, from the extra ``warp``. It computes in single precision and has no
            derivatives.
        nconmax: On Warp: most contacts of a copy, on average, as copies share the room; default: a guess. If it is too
            small, the episodes of all copies end.
        njmax: On Warp: most rows of constraints of a copy; default: a guess. If it is too small, the episode of the
            copy ends, as after divergence.
        arena: The root entity of a task that has none.

    Raises:
        UsageError: The world has something that MJX lacks or computes differently.

    Attributes:
        model: The compiled ``mujoco.MjModel``.
        mjx_model: The ``mjx.Model``.
        initial: The ``mjx.Data`` from which episodes start.
        has_reward: Whether the task's ``get_reward`` returns anything but the number 0.
    """

    def __init__(
        self,
        task: Task,
        time_limit: float = math.inf,
        seed: int | None = None,
        strip_singleton_obs_buffer_dim: bool = False,
        max_reset_attempts: int = 1,
        delayed_observation_padding: ObservationPadding = ObservationPadding.ZERO,
        legacy_step: bool = True,
        *,
        impl: str = "jax",
        nconmax: int | None = None,
        njmax: int | None = None,
        arena: Entity | None = None,
    ) -> None:
        if arena is not None:
            task._root_entity = arena
        self.task, self._attempts, self._legacy = task, max_reset_attempts, legacy_step
        self._hooks, self._registry = TracedHooks(task), Registry()
        # Compile the model on the host, with the hooks that run there.
        random_state = np.random.RandomState(seed)
        self._hooks.run("initialize_episode_mjcf", random_state)
        self._hooks.refresh()
        self.model = task.root_entity.mjcf_model.root_model.compile()
        self._look_at_compiled(random_state)
        # Refuse unsupported options before anything is traced.
        observables = task.observables
        _check_observables(observables)
        gate.check_model(self.model)
        self._warp = warp.make_engine(self.model, impl, nconmax, njmax)
        if self._warp is None:
            gate.settle_cone(self.model)
        # Reserve the samples of the observables.
        self.substeps = task.physics_steps_per_control_step
        limit = count_steps(time_limit, task.control_timestep)
        self.step_limit = int(limit) if math.isfinite(limit) else None
        initial = delayed_observation_padding is ObservationPadding.INITIAL_VALUE
        sampling = self.substeps, strip_singleton_obs_buffer_dim, initial
        self._rings = [Ring(name, o, sampling, self._hooks.call) for name, o in observables.items() if o.enabled]
        # Move the model and its initial state to MJX.
        self.mjx_model = mjx.put_model(self.model, impl="jax") if self._warp is None else self._warp.model
        self.initial = _initial_data(self.model) if self._warp is None else self._warp.start
        freeze(self.model)
        # Trace once without physics to find the values that a copy must carry.
        self._changed: tuple[str, ...] = ()
        self.has_reward = self._stays_dirty = False
        self._steady = True
        self._earned: PyTree = (np.zeros(()), np.zeros(()), {})  # forms of a reward, a discount and a reward's terms
        self._discover()

    def _look_at_compiled(self, random_state: np.random.RandomState) -> None:
        """Run ``after_compile`` on the host, and ask for the action's shape there."""
        physics = Physics(self.model, self._legacy)
        view: Physics = weakref.proxy(physics)
        self._hooks.run("after_compile", view, random_state)
        self._action_spec = self.task.action_spec(view)

    def _physics(
        self,
        state: State | None = None,
        model: mjx.Model | None = None,
        initial: mjx.Data | None = None,
        dry: bool = False,
    ) -> tuple[MjxPhysics, JaxRandomState]:
        """Return the view of a state, or of an initial state, for hooks.

        Args:
            initial: Start of the episodes; default: the model's.
            dry: Whether no physics is computed.
        """
        initial = self.initial if initial is None else initial
        compiled = self.mjx_model if model is None else model
        data = initial if state is None else state.data
        physics = MjxPhysics(self.model, compiled, data, {}, self._legacy, self._warp)
        physics.changed.update(self._changed)  # every copy carries all fields that hooks set
        physics.switch_on()
        physics.start = initial
        physics.dry = dry
        if state is None:
            # On Warp nothing has been computed yet, and the copy's model differs from the model of the initial data.
            physics.is_dirty = self._warp is not None or model is not None
            memory = {k: jnp.asarray(v) for k, v in self._registry.initial.items()}
            return physics, JaxRandomState(None, memory, self._registry)
        random_state = JaxRandomState(state.key, {}, self._registry)
        physics.load((state.data, state.leaves, state.variables, state.key, state.memory), random_state)
        physics.is_dirty = state.dirty if self._stays_dirty else False
        return physics, random_state

    def _discover(self) -> None:
        """Trace resets and steps without physics to find the values that hooks set, which programs must carry."""
        key = jax.random.key(0)
        action = jax.tree.map(lambda s: jnp.zeros(s.shape, jax.dtypes.canonicalize_dtype(s.dtype)), self._action_spec)
        with self._hooks.watching((self.task, *self.task.iter_entities())):
            state, after = self._trace(key, action)
            self._earned = after.reward, after.discount, after.terms
            if self._stays_dirty:
                state, after = self._trace(key, action)
        self._changed = tuple(sorted({*state.leaves, *after.leaves}))
        missing = sorted(set(after.variables) - set(state.variables))
        if missing:
            raise UsageError(
                f"physics.variables {', '.join(map(repr, missing))} first appear in a step",
                hint="set them in initialize_episode, too: a compiled program always carries the same variables",
            )
        check_variables(state.variables, after.variables)

    def _trace(self, key: jax.Array, action: jax.Array) -> tuple[State, State]:
        state = jax.eval_shape(functools.partial(self._reset, dry=True), key)
        return state, jax.eval_shape(functools.partial(self._step, dry=True), state, action)

    def reset(
        self,
        key: jax.Array,
        model: mjx.Model | None = None,
        start: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> State:
        """Return a copy at the start of an episode.

        Args:
            model: The ``mjx.Model`` of this copy; default: the compiled one.
            start: Positions ``(nq,)`` and velocities ``(nv,)`` before the hooks; default: the model's, at rest.
        """
        return self._reset(key, model, start)

    def _reset(
        self,
        key: jax.Array,
        model: mjx.Model | None = None,
        start: tuple[ArrayLike, ArrayLike] | None = None,
        initial: mjx.Data | None = None,
        dry: bool = False,
    ) -> State:
        physics, random_state = self._physics(None, model, initial, dry)
        random_state.key = key
        if start is not None:
            physics.replace("data", "qpos", start[0])
            physics.replace("data", "qvel", start[1])
            physics.mark_as_dirty()

        def attempt() -> None:
            self._hooks.run("initialize_episode", physics, random_state)

        # Draw initial states until the hooks accept one, and compute all quantities of it.
        failed = physics.retry(attempt, random_state, self._attempts)
        physics.forward(actuation=False)
        # Take the first samples.
        rings = {r.name: r.reset(physics, random_state) for r in self._rings}
        steps = jnp.zeros((), jnp.int32)
        observation = {r.name: r.read(rings[r.name], steps) for r in self._rings}
        dirty = jnp.asarray(physics.is_dirty, bool)
        data, leaves, variables, key, memory = physics.tree(random_state)
        reward, discount, terms = jax.tree.map(lambda x: jnp.zeros(x.shape, data.qpos.dtype), self._earned)
        no = jnp.zeros((), bool)
        outcome = (observation, reward, discount + 1, no, no, failed, terms)
        return State(data, leaves, variables, key, memory, rings, steps, dirty, *outcome)

    def step(self, state: State, action: jax.Array, model: mjx.Model | None = None) -> State:
        """Return the copy one control step later, even after the episode's end; see ``done``.

        Args:
            action: Shape ``(nu,)``, unless the task overrides ``action_spec``.
            model: The ``mjx.Model`` of this copy; default: the compiled one.
        """
        return self._step(state, action, model)

    def _step(self, state: State, action: jax.Array, model: mjx.Model | None = None, dry: bool = False) -> State:
        # Run the hooks and the physics steps.
        physics, random_state = self._physics(state, model, dry=dry)
        self._hooks.run("before_step", physics, action, random_state)
        rings, diverged = self._substeps(physics, random_state, state, action)
        self._hooks.run("after_step", physics, random_state)
        steps = state.steps + 1
        now = steps * self.substeps
        # Take the last samples after the hooks, which may change the state.
        rings = {r.name: r.update(rings[r.name], now, physics, random_state, True) for r in self._rings}
        # Compute the reward, the discount and the end of the episode.
        dtype = state.reward.dtype
        earned, discount, ends = self._hooks.judge(physics)
        reward, terms = split_reward(earned)
        discount = jnp.asarray(discount, dtype)
        observation = {r.name: r.read(rings[r.name], now) for r in self._rings}
        if dry:  # while the environment is made
            self.has_reward = not (isinstance(earned, int | float) and earned == 0)
            self._stays_dirty = self._stays_dirty or physics.is_dirty is not False
        dirty = jnp.asarray(physics.is_dirty, bool)
        data, leaves, variables, key, memory = physics.tree(random_state)
        # A diverged copy ends its episode, without a reward.
        diverged = diverged | is_unstable(data)
        diverged = diverged if self._warp is None else diverged | warp.overflowed(data)
        earned = (reward, discount, terms)
        reward, discount, terms = jax.tree.map(lambda x: jnp.where(diverged, 0.0, x).astype(dtype), earned)
        ended = diverged | jnp.asarray(ends, bool)
        late = jnp.zeros((), bool) if self.step_limit is None else steps >= self.step_limit
        outcome = (observation, reward, discount, ended | late, late & ~ended, state.failed, terms)
        return State(data, leaves, variables, key, memory, rings, steps, dirty, *outcome)

    def _substeps(
        self, physics: MjxPhysics, random_state: JaxRandomState, state: State, action: jax.Array
    ) -> tuple[dict[str, Samples], jax.Array]:
        """Take all physics steps; return the rings, without the last samples, and whether a step diverged."""
        buffered = [r for r in self._rings if not r.direct]

        entry = physics.is_dirty

        def substep(carry: PyTree, i: jax.Array) -> tuple[PyTree, None]:
            tree, rings, dirty, diverged = carry
            physics.load(tree, random_state)
            physics.is_dirty = entry if self._steady or self.substeps == 1 else dirty
            self._hooks.run("before_substep", physics, action, random_state)
            physics.step()
            diverged = diverged | is_unstable(physics.mjx_data)  # copy now: hooks may overwrite it
            self._hooks.run("after_substep", physics, random_state)
            now, counts = state.steps * self.substeps + i + 1, i < self.substeps - 1
            new = {r.name: r.update(rings[r.name], now, physics, random_state, counts) for r in buffered}
            if physics.dry:  # whether ``dirty`` is the same before every physics step
                self._steady = physics.is_dirty is entry
            dirty = jnp.asarray(physics.is_dirty, bool)
            return (physics.tree(random_state), {**rings, **new}, dirty, diverged), None

        # One physics step needs no loop; several become a scan, so that programs stay small.
        carry = (physics.tree(random_state), state.rings, jnp.asarray(entry, bool), jnp.zeros((), bool))
        if self.substeps == 1 or physics.dry:
            carry, _ = substep(carry, jnp.zeros((), jnp.int32))
            tree, rings, _, diverged = carry
        else:
            (tree, rings, dirty, diverged), _ = jax.lax.scan(substep, carry, jnp.arange(self.substeps, dtype=jnp.int32))
            if not isinstance(physics.is_dirty, bool):  # otherwise, no physics step changes it
                physics.is_dirty = entry if self._steady else dirty
        physics.load(tree, random_state)
        return rings, diverged

    def action_spec(self) -> PyTree:
        """Return shape and bounds of an action, from the task."""
        return self._action_spec

    def carry(self, names: Iterable[str]) -> None:
        """Let every copy keep fields of the model of its reset, such as ``body_mass``, for the steps."""
        self._changed = tuple(sorted({*self._changed, *names}))

    def observation_spec(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Return name -> shape and dtype."""
        return dict(jax.eval_shape(self.reset, jax.random.key(0)).observation)

    def select(self, condition: jax.Array, a: State, b: State) -> State:
        """Return copy ``a`` where the condition is true, else copy ``b``; e.g. to reset finished copies."""
        return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _initial_data(model: MjModel) -> mjx.Data:
    """Return the ``mjx.Data`` that an episode starts from: the model's initial state, with all computed quantities."""
    physics = Physics(model)  # computes all quantities, without the actuators
    return mjx.put_data(model, physics.data.ptr, impl="jax")


def is_unstable(data: mjx.Data) -> jax.Array:
    """Return whether MuJoCo would warn of an instability: a value is not finite, or beyond ``mjMAXVAL``."""
    state = jnp.concatenate([data.qpos, data.qvel, data.qacc])
    return ~(jnp.abs(state) <= mj.mjMAXVAL).all()


def _check_observables(observables: Mapping[str, Observable]) -> None:
    """Refuse enabled observables that cannot be computed inside a compiled program."""
    cameras = [k for k, o in observables.items() if o.enabled and isinstance(o, MujocoCamera)]
    if cameras:
        raise UsageError(
            f"MJX renders no images: camera observables {', '.join(map(repr, cameras))}",
            hint="disable them, or use the C engine",
        )
