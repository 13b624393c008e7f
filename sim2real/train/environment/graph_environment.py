"""A compiled graph as an environment for PPO: one row of the graph is one environment step."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.runtime.compilation.compiled import CompiledGraph
from sim2real.runtime.program_arguments import data_of, with_data
from sim2real.train.environment.protocol import Step
from sim2real.train.environment.pushes import Pushes
from sim2real.train.environment.tasks import (
    REWARD,
    EndingTask,
    PrivilegedTask,
    Rewards,
    WideningTask,
    checked_end,
    terms_of,
    total_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable


class TrainingTask(Protocol):
    """The training task of a pipeline: observation, action, reward and success.

    It may have more: ``sim2real.train.environment.tasks`` has what.

    Attributes:
        supervisor: Name of the node whose steps the policy makes.
        observation_size: Number of entries of an observation.
        action_low: Shape ``(A,)``: lower bounds of the action [the command's unit].
        action_high: Shape ``(A,)``: upper bounds of the action [the command's unit].
    """

    supervisor: str
    observation_size: int
    action_low: np.ndarray
    action_high: np.ndarray

    def params(self, key: jax.Array) -> dict[str, Any]:
        """Draw the parameters of the graph's nodes for one episode."""
        ...

    def observe(self, step_state: StepState) -> jax.Array:
        """Return the policy's observation, shape ``(observation_size,)``, from the supervisor's step state."""
        ...

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, Any]:
        """Return the supervisor's new step state and its output for an action, shape ``(A,)``."""
        ...

    def reward(self, graph_state: GraphState, action: jax.Array) -> Rewards:
        """Return the reward of a row, or its terms by name, each of shape ``()``.

        Args:
            action: Shape ``(A,)``.
        """
        ...

    def success(self, graph_state: GraphState) -> jax.Array:
        """Return whether the task is fulfilled in the graph's state after a row, bool of shape ``()``."""
        ...


class EnvState(NamedTuple):
    """The state of a ``GraphEnvironment``.

    Attributes:
        graph: The graph's state, run up to the supervisor's step of this row.
        step_state: What the supervisor sees.
        total: Sum of the rewards so far.
        terms: The same of each term of the reward that has a name.
        good: Number of rows in the second half of the episode in which the task was fulfilled.
        width: Share of all differences between episodes that this one has; None: all.
    """

    graph: GraphState
    step_state: StepState
    total: jax.Array
    terms: dict[str, jax.Array]
    good: jax.Array
    width: jax.Array | None = None


class GraphEnvironment:
    """A graph as an environment; each episode has a random one of the graph's timelines, and its own parameters.

    An episode is truncated at the end of its timeline, or after as many policy steps as it is told: the value of what
    would have followed counts. A task with a method ``terminated``, or a composed task in the graph's world, may end it
    earlier: nothing follows then. In what is left of such an episode the task counts as not fulfilled.

    Args:
        graph: The compiled graph, with the task's supervisor.
        steps: Shape ``(E,)``: policy steps of each timeline; None: all of them.
        pushes: What hits the robot; None: nothing.
        curriculum: Share of the differences between episodes at the first and at the last update; None: always all.
            ``reset`` has the last.

    Raises:
        UsageError: When the supervisor makes several steps in one row of the timelines, or the task knows no shares.
    """

    def __init__(
        self,
        graph: CompiledGraph,
        task: TrainingTask,
        steps: np.ndarray | None = None,
        pushes: Pushes | None = None,
        curriculum: tuple[float, float] | None = None,
    ) -> None:
        self.graph, self.task = graph, task
        self.pushes, self.curriculum = pushes, curriculum
        if curriculum is not None and not isinstance(task, WideningTask):
            raise UsageError(
                f"episodes of a {type(task).__name__} cannot differ by a share: it has no `params_at`",
                hint="give the task a method params_at(key, width), or leave out --vary.curriculum",
            )
        self.observation_size = task.observation_size
        self.action_low, self.action_high = task.action_low, task.action_high
        # One row less than the tables have, as the observation after an episode's last row is looked up in them too.
        # So no row is past their end, and no state has to be masked.
        self.length = graph.rows - 1
        # The row of an episode's last step is not played: what the policy sees there is the final observation.
        counts = graph.timeline.vertices[graph.supervisor].count if steps is None else steps
        self._last = jnp.asarray(graph.last_row(np.asarray(counts)), jnp.int32)
        self._data: Any = None
        # jit, so that each is traced only once for all its uses: tracing MuJoCo's worlds takes 5 s.
        self._start, self._play = jax.jit(self._reset), jax.jit(self._step)
        # Worlds of composed tasks have a method `ends`. Looked up by name: importing their class would import MuJoCo.
        found: dict[str, Callable[[Any], tuple[jax.Array, jax.Array]] | None] = {
            name: getattr(node, "ends", None) for name, node in graph.nodes.items()
        }
        self._ending = {name: ends for name, ends in found.items() if ends is not None}

    @property
    def data(self) -> Any:
        """The numbers that follow from recordings: graph's, task's, and when episodes end; see ``HoldsData``."""
        return (self.graph.data, data_of(self.task), self._last) if self._data is None else self._data

    def with_data(self, data: Any) -> GraphEnvironment:
        """Return a copy with other data, which may be traced."""
        env = copy.copy(self)
        env._data = data
        return env

    def privileged(self, state: EnvState) -> jax.Array:
        """Return what is true in a state, shape ``(P,)``.

        Raises:
            UsageError: The task does not say.
        """
        if not isinstance(self.task, PrivilegedTask):
            raise UsageError(
                f"a value function cannot see more than the policy in a {type(self.task).__name__}",
                hint="give the task a method privileged(graph_state) -> (P,), or train without --ppo.privileged",
            )
        return self.task.privileged(state.graph)

    def reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        """Start an episode on a random timeline; with a curriculum, one with as many differences as at its end."""
        return self._start(self.data, key, None if self.curriculum is None else jnp.float32(self.curriculum[1]))

    def reset_at(self, key: jax.Array, width: jax.Array) -> tuple[EnvState, jax.Array]:
        """Start an episode that differs from others by a share, shape ``()``, of what it might."""
        return self._start(self.data, key, width)

    def step(self, state: EnvState, action: jax.Array, key: jax.Array) -> Step:
        """Make the supervisor's step with the policy's action, then run the graph up to its next step.

        Args:
            state: What ``reset`` or ``step`` returned.
            action: Shape ``(A,)``.
        """
        return self._play(self.data, state, action, key)

    def _reset(self, data: Any, key: jax.Array, width: jax.Array | None) -> tuple[EnvState, jax.Array]:
        graph, task = self.graph.with_data(data[0]), with_data(self.task, data[1])
        k_eps, k_params, k_init = jax.random.split(key, 3)
        eps = jax.random.randint(k_eps, (), 0, graph.episodes)
        if width is not None and isinstance(task, WideningTask):
            params = task.params_at(k_params, width)
        else:
            params = task.params(k_params)
        gs = graph.init(k_init, params=params, eps=eps)
        gs, step_state, _ = graph.observe(gs, inside=True)
        terms = terms_of(jax.eval_shape(task.reward, gs, jnp.asarray(self.action_low, jnp.float32)))
        zero = jnp.float32(0.0)
        state = EnvState(gs, step_state, zero, {n: zero for n in terms}, zero, width)
        return state, task.observe(step_state)

    def _step(self, data: Any, state: EnvState, action: jax.Array, key: jax.Array) -> Step:
        graph, task = self.graph.with_data(data[0]), with_data(self.task, data[1])
        valid: Any = state.step_state.seq >= 0
        step_state, output = task.act(state.step_state, action)
        gs = graph.advance(state.graph, step_state, output, inside=True)
        made = task.reward(gs, action)
        reward = total_of(made)
        last = data[2][gs.eps]
        second_half = gs.step > last // 2
        good = state.good + jnp.where(second_half & task.success(gs), 1.0, 0.0)
        total = state.total + reward
        terms = {name: state.terms[name] + term for name, term in terms_of(made).items()}
        ended = [ends(gs.state[name]) for name, ends in self._ending.items()]
        fallen = [checked_end(task.terminated(gs), task)] if isinstance(task, EndingTask) else []
        terminated = jnp.any(jnp.array([e[0] for e in ended] + fallen, bool))
        truncated: Any = (gs.step >= last) | jnp.any(jnp.array([e[1] for e in ended], bool))
        if self.pushes is not None:
            gs = self.pushes.apply(gs, key, state.width)
        gs, step_state, _ = graph.observe(gs, inside=True)
        metrics = {"return": total, "success": good / (last - last // 2)}
        metrics |= {f"{REWARD}{name}": term for name, term in terms.items()}
        new = EnvState(gs, step_state, total, terms, good, state.width)
        return Step(new, task.observe(step_state), reward, terminated, truncated, valid, metrics)
