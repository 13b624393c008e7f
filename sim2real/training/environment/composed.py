"""A composed task as an environment for PPO, without a graph: one control step is one row."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.composer.mjx_environment import MjxEnvironment
from sim2real.composer.task import UNLIMITED
from sim2real.errors import UsageError
from sim2real.training.environment.protocol import Step, TrainingEnvironment, to_vector
from sim2real.training.environment.tasks import REWARD

if TYPE_CHECKING:
    from sim2real.composer.mjx_environment import State


class TaskState(NamedTuple):
    """The state of a ``TaskEnvironment``.

    Attributes:
        terms: Sum of each named reward term so far.
    """

    inner: State
    terms: dict[str, jax.Array]


class TaskEnvironment(TrainingEnvironment):
    """A composed task on MJX as an environment; the observation is the vector of all its observables, in their order.

    Args:
        environment: The task; it needs a time limit unless its own termination ends the episodes.

    Raises:
        UsageError: The action is not a vector with bounds.
    """

    def __init__(self, environment: MjxEnvironment) -> None:
        self.environment = environment
        self.observation_size = sum(leaf.size for leaf in environment.observation_spec().values())
        spec = environment.action_spec()
        bounds = [np.broadcast_to(getattr(spec, name, np.inf), spec.shape) for name in ("minimum", "maximum")]
        if len(spec.shape) != 1 or not (np.abs(bounds) < UNLIMITED).all():
            raise UsageError(
                f"PPO's actions are vectors with bounds, and the task's action_spec is {spec!r}",
                hint="give every actuator a ctrlrange, or override action_spec in the task",
            )
        self.action_low, self.action_high = bounds

    def reset(self, key: jax.Array, width: jax.Array | None = None) -> tuple[TaskState, jax.Array]:
        """Return the state at the start of an episode and the first observation."""
        state = self.environment.reset(key)
        return TaskState(state, state.terms), to_vector(state.observation)

    def step(self, state: TaskState, action: jax.Array, key: jax.Array) -> Step:
        """Make one control step; ``action (A,)`` [the actuators' units].

        ``key`` has no effect: the state has its own key.
        """
        del key
        new = self.environment.step(state.inner, action)
        terminated = new.done & ~new.truncated
        terms = {name: state.terms[name] + term for name, term in new.terms.items()}
        metrics = {f"{REWARD}{name}": term for name, term in terms.items()}
        return Step(
            TaskState(new, terms),
            to_vector(new.observation),
            new.reward,
            terminated,
            new.truncated,
            jnp.bool_(True),
            metrics,
        )

    def privileged(self, state: TaskState) -> jax.Array:
        """Return the true state, shape ``(P,)``, in MuJoCo's units.

        Positions and velocities of all joints, then the fields of the model that hooks set, such as drawn masses, and
        the task's ``physics.variables``, by name.
        """
        inner = state.inner
        leaves = jax.tree.leaves((inner.data.qpos, inner.data.qvel, inner.leaves, inner.variables))
        return jnp.concatenate([jnp.ravel(leaf).astype(jnp.float32) for leaf in leaves])
