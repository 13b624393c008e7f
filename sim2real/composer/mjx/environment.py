"""A task as a pure environment on MJX: ``reset(key)`` and ``step(state, action)``, to be jitted and vmapped."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from mujoco import mjx

from sim2real.composer.environment import ObservationPadding
from sim2real.composer.hooks import Hooks
from sim2real.composer.mjx import gate, stepping
from sim2real.composer.mjx.leaks import guarded
from sim2real.composer.mjx.physics import MjxPhysics
from sim2real.composer.mjx.random import JaxRandomState, Registry
from sim2real.composer.mjx.rings import make_rings
from sim2real.composer.mjx.warp import WarpEngine
from sim2real.composer.task import Task
from sim2real.errors import UsageError


@struct.dataclass
class State:
    """One copy of the environment.

    Attributes:
        data: The ``mjx.Data``.
        leaves: Fields of the model that hooks set: name -> array.
        variables: What the task keeps from hook to hook: name -> array.
        key: Randomness.
        memory: What variations keep from draw to draw: name -> array.
        rings: Samples of the observables that may still be read.
        steps: int32: control steps since the reset.
        observation: Name -> array.
        reward: Reward of the last step; 0 after a reset.
        discount: Discount of what comes next, in [0, 1].
        done: Whether the episode ended with the last step.
        truncated: Whether it ended only because of the time limit.
        failed: Whether no acceptable initial state was found in ``max_reset_attempts`` attempts.
    """

    data: Any
    leaves: Any
    variables: Any
    key: Any
    memory: Any
    rings: Any
    steps: Any
    observation: Any
    reward: Any
    discount: Any
    done: Any
    truncated: Any
    failed: Any


class MjxEnvironment:
    """Runs a task on MJX.

    The hooks of the task and its entities are those of the C engine, called while the programs are traced: they read
    and set the physics, compute with ``physics.np``, draw from ``random_state`` and keep what they need later in
    ``physics.variables``. ``initialize_episode_mjcf`` runs once, when the environment is made.

    Args:
        task: The task.
        time_limit: Longest episode [s].
        seed: For ``initialize_episode_mjcf`` and ``after_compile``, which run on the host.
        strip_singleton_obs_buffer_dim: Leave the first axis out of observations whose buffer holds one sample.
        max_reset_attempts: How often the initial state is drawn when hooks call ``physics.fail``.
        delayed_observation_padding: What fills buffers at first.
        legacy_step: After a step, also compute positions and velocities of the new state.
        impl: ``"jax"``, or ``"warp"``: MuJoCo Warp, from the extra ``sim2real[warp]``. It computes in single precision
            and has no derivatives. A step of it cannot begin elsewhere, so ``legacy_step`` costs a second forward
            computation.
        naconmax: On Warp: contacts that there is room for, of all copies together; default: a guess for one copy.
        njmax: On Warp: rows of constraints that there is room for in each copy. Where it is too small the episode of
            the copy ends, as where it diverged; where ``naconmax`` is, those of all copies.
        arena: The root entity of a task that has none of its own.

    Raises:
        UsageError: When the world asks for something that MJX does not do, or does otherwise; it names what.

    Attributes:
        model: The compiled ``mujoco.MjModel``.
        mjx_model: The ``mjx.Model``.
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
        naconmax: int | None = None,
        njmax: int | None = None,
        arena: Any = None,
    ) -> None:
        if arena is not None:
            task._root_entity = arena  # pyright: ignore[reportAttributeAccessIssue]
        self.task, self._attempts, self._legacy = task, max_reset_attempts, legacy_step
        self._hooks, self._registry = Hooks(task), Registry()
        random_state = np.random.RandomState(seed)
        self._hooks.run("initialize_episode_mjcf", random_state)
        observables = task.observables
        gate.check_observables(observables)
        self.model = task.root_entity.mjcf_model.root_model.compile()
        gate.check_model(self.model)
        gate.simplify_cone(self.model)
        self.substeps = task.physics_steps_per_control_step
        limit = time_limit / task.control_timestep
        self.step_limit = math.ceil(limit - 1e-6) if math.isfinite(limit) else None
        initial = delayed_observation_padding is ObservationPadding.INITIAL_VALUE
        self._rings = make_rings(observables, self.substeps, strip_singleton_obs_buffer_dim, initial)
        self._warp = self._make_warp(impl, naconmax, njmax)
        self.mjx_model = mjx.put_model(self.model, impl="jax") if self._warp is None else self._warp.model
        self._changed: tuple[str, ...] = ()
        self._dry = False
        self._hooks.refresh()
        self._discover()

    def _make_warp(self, impl: str, naconmax: int | None, njmax: int | None) -> WarpEngine | None:
        if impl == "warp":
            return WarpEngine(self.model, naconmax, njmax)
        if impl != "jax":
            raise UsageError(f"MJX has no implementation {impl!r}", hint="available: 'jax', 'warp'")
        if (naconmax, njmax) != (None, None):
            raise UsageError("naconmax and njmax are Warp's: MJX's JAX has room for every contact", hint='impl="warp"')
        return None

    def _physics(self, state: State | None = None, model: Any = None) -> tuple[MjxPhysics, JaxRandomState]:
        """Return the view of a state, or of the model's initial state, for hooks."""
        model = self.mjx_model if model is None else model
        if state is None:
            data = mjx.make_data(self.model, impl="jax") if self._warp is None else self._warp.start
            physics = MjxPhysics(self.model, model, data, {}, self._legacy, self._warp or stepping)
            physics.is_dirty = True
            memory = {k: jnp.asarray(v) for k, v in self._registry.initial.items()}
            random_state = JaxRandomState(None, memory, self._registry)
        else:
            physics = MjxPhysics(self.model, model, state.data, {}, self._legacy, self._warp or stepping)
            random_state = JaxRandomState(state.key, {}, self._registry)
            physics.load((state.data, state.leaves, state.variables, state.key, state.memory), random_state)
        physics.changed.update(self._changed)  # every copy carries every field that any hook sets
        physics.dry = self._dry
        return physics, random_state

    def _discover(self) -> None:
        """Trace a reset and a step, without physics, to find out what hooks set and keep; programs must carry it."""
        key, action = jax.random.key(0), jnp.zeros(self.model.nu)
        owners = (self.task, *self.task.iter_entities())
        self._dry = True
        with guarded(owners):
            state = jax.eval_shape(self.reset, key)
            after = jax.eval_shape(self.step, state, action)
        self._dry = False
        self._changed = tuple(sorted({*state.leaves, *after.leaves}))
        missing = sorted(set(after.variables) - set(state.variables))
        if missing:
            raise UsageError(
                f"physics.variables {', '.join(map(repr, missing))} first appear in a step",
                hint="set them in initialize_episode too: a compiled program carries the same variables all along",
            )

    def reset(self, key: Any, model: Any = None, start: tuple[Any, Any] | None = None) -> State:
        """Return a copy at the start of an episode.

        Args:
            key: JAX key.
            model: The ``mjx.Model`` of this copy; default: the compiled one.
            start: Positions ``(nq,)`` and velocities ``(nv,)`` that the hooks find; default: the model's, at rest.
        """
        physics, random_state = self._physics(None, model)
        random_state.key = key
        if start is not None:
            physics.replace("data", "qpos", start[0])
            physics.replace("data", "qvel", start[1])

        def attempt() -> None:
            self._hooks.run("initialize_episode", physics, random_state)

        failed = physics.retry(attempt, random_state, self._attempts)
        physics.forward(actuation=False)
        rings = {r.name: r.reset(physics, random_state) for r in self._rings}
        observation = {r.name: r.first(rings[r.name], physics, random_state) for r in self._rings}
        data, leaves, variables, key, memory = physics.tree(random_state)
        zero, no = jnp.zeros((), data.qpos.dtype), jnp.zeros((), bool)
        steps = jnp.zeros((), jnp.int32)
        return State(data, leaves, variables, key, memory, rings, steps, observation, zero, zero + 1, no, no, failed)

    def step(self, state: State, action: Any, model: Any = None) -> State:
        """Return the copy one control step later; an episode that is over goes on, look at ``done``.

        Args:
            state: The copy.
            action: Shape ``(nu,)``, or whatever the task makes of it.
            model: The ``mjx.Model`` of this copy; default: the compiled one.
        """
        physics, random_state = self._physics(state, model)
        self._hooks.run("before_step", physics, action, random_state)
        rings = self._substeps(physics, random_state, state, action)
        self._hooks.run("after_step", physics, random_state)
        steps = state.steps + 1
        now = steps * self.substeps
        rings = {r.name: r.update(rings[r.name], now, physics, random_state, True) for r in self._rings}
        dtype = state.reward.dtype
        reward = jnp.asarray(self.task.get_reward(physics), dtype)
        discount = jnp.asarray(self.task.get_discount(physics), dtype)
        observation = {r.name: r.read(rings[r.name], now, physics, random_state) for r in self._rings}
        data, leaves, variables, key, memory = physics.tree(random_state)
        diverged = ~(jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all() & jnp.isfinite(data.qacc).all())
        diverged = diverged if self._warp is None else diverged | self._warp.overflowed(data)
        reward, discount = (jnp.where(diverged, 0.0, x).astype(dtype) for x in (reward, discount))
        ended = diverged | jnp.asarray(self.task.should_terminate_episode(physics), bool)
        late = jnp.zeros((), bool) if self.step_limit is None else steps >= self.step_limit
        outcome = (observation, reward, discount, ended | late, late & ~ended, state.failed)
        return State(data, leaves, variables, key, memory, rings, steps, *outcome)

    def _substeps(self, physics: MjxPhysics, random_state: JaxRandomState, state: State, action: Any) -> Any:
        """Take all physics steps of a control step; return the rings, without the samples of the last one."""
        buffered = [r for r in self._rings if not r.direct]

        def substep(carry: Any, i: Any) -> tuple[Any, None]:
            tree, rings = carry
            physics.load(tree, random_state)
            self._hooks.run("before_substep", physics, action, random_state)
            physics.step()
            self._hooks.run("after_substep", physics, random_state)
            now, counts = state.steps * self.substeps + i + 1, i < self.substeps - 1
            new = {r.name: r.update(rings[r.name], now, physics, random_state, counts) for r in buffered}
            return (physics.tree(random_state), {**rings, **new}), None

        start = (physics.tree(random_state), state.rings)
        if self.substeps == 1 or self._dry:
            (tree, rings), _ = substep(start, jnp.zeros((), jnp.int32))
        else:
            (tree, rings), _ = jax.lax.scan(substep, start, jnp.arange(self.substeps, dtype=jnp.int32))
        physics.load(tree, random_state)
        return rings

    def observation_spec(self) -> dict[str, Any]:
        """Return name -> shape and dtype."""
        return dict(jax.eval_shape(self.reset, jax.random.key(0)).observation)

    def select(self, condition: Any, a: State, b: State) -> State:
        """Return copy ``a`` where the condition holds, else copy ``b``; for starting copies anew that are done."""

        def choose(x: Any, y: Any) -> Any:
            if not jnp.issubdtype(jnp.asarray(x).dtype, jax.dtypes.prng_key):
                return jnp.where(condition, x, y)
            data = jnp.where(condition, jax.random.key_data(x), jax.random.key_data(y))
            return jax.random.wrap_key_data(data, impl=jax.random.key_impl(x))

        return jax.tree_util.tree_map(choose, a, b)
