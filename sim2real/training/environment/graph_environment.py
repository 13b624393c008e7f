"""A compiled graph as an environment for PPO: one row of the graph is one environment step."""

from __future__ import annotations

import copy
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.runtime.compiled.graph import CompiledGraph, data_of, with_data
from sim2real.training.environment.protocol import Step, TrainingEnvironment
from sim2real.training.environment.pushes import Pushes
from sim2real.training.environment.tasks import REWARD, Rewards, TrainingTask, checked_end, terms_of, total_of
from sim2real.types import PyTree


class EnvState(NamedTuple):
    """The state of a ``GraphEnvironment``.

    Attributes:
        graph: The graph's state, run up to the supervisor's step of this row.
        terms: Sum of each named reward term so far.
        good: Number of rows in the second half of the episode in which the task was fulfilled.
        width: Share of the differences between episodes for this episode; None: 1.
    """

    graph: GraphState
    step_state: StepState
    total: jax.Array
    terms: dict[str, jax.Array]
    good: jax.Array
    width: jax.Array | None = None


class GraphEnvironment(TrainingEnvironment):
    """A graph as an environment; each episode has a random one of the graph's timelines, and its own parameters.

    An episode is truncated at the end of its timeline, or after the number of policy steps in ``steps``: the value of
    the final observation counts. A task with a method ``terminated``, or a composed task in the graph's world, may
    terminate it earlier: the value after it is 0, and the task counts as not fulfilled in the rest of the episode.

    Args:
        steps: Shape ``(E,)``: policy steps of each timeline; None: all of them.
        curriculum: Share of the differences between episodes at the first and at the last update; None: always 1.
            ``reset`` uses the last.
        follow: Success of episodes above which the share grows; 0: it grows with the updates.

    Raises:
        UsageError: The supervisor makes several steps in one row of the timelines, or the task has no curriculum.
    """

    def __init__(
        self,
        graph: CompiledGraph,
        task: TrainingTask,
        steps: np.ndarray | None = None,
        pushes: Pushes | None = None,
        curriculum: tuple[float, float] | None = None,
        follow: float = 0.0,
    ) -> None:
        self.graph, self.task = graph, task
        self.pushes, self.curriculum, self.follow = pushes, curriculum, follow
        if curriculum is not None and not task.has_curriculum:
            raise UsageError(
                f"a {type(task).__name__} has no curriculum",
                hint="set its has_curriculum and let params(key, width) use the width, or leave out --vary.curriculum",
            )
        self.observation_size = task.observation_size
        self.action_low, self.action_high = task.action_low, task.action_high
        of_task = task.privileged
        self.privileged = None if of_task is None else lambda state: of_task(state.graph)

        # One row less than in the tables, where the observation after an episode's last row is also looked up. So no
        # # row is past their end, and no state has to be masked.
        self.length = graph.rows - 1

        # The row of an episode's last step is not played, but gives the final observation.
        counts = graph.timeline.vertices[graph.supervisor].count if steps is None else steps
        self._last = jax.device_put(graph.last_row(np.asarray(counts)).astype(np.int32))
        self._data: PyTree = None

        # jit, so that each function is traced once for all its uses: tracing MuJoCo's worlds takes 5 s.
        self._start, self._play = jax.jit(self._reset), jax.jit(self._step)
        self._rewarding = [name for name, node in graph.nodes.items() if getattr(node, "has_reward", False)]
        # The world of a composed task may end an episode: its `ends` returns whether it is terminated, and truncated.
        ends = {name: getattr(node, "ends", None) for name, node in graph.nodes.items()}
        self._ending = {name: of_world for name, of_world in ends.items() if of_world is not None}

    @property
    def data(self) -> PyTree:
        """The data of graph and task, and the last row of each episode; see ``HoldsData``."""
        return (self.graph.data, data_of(self.task), self._last) if self._data is None else self._data

    def with_data(self, data: PyTree) -> GraphEnvironment:
        """Return a copy with other data, which may be traced."""
        env = copy.copy(self)
        env._data = data
        return env

    def reset(self, key: jax.Array, width: jax.Array | None = None) -> tuple[EnvState, jax.Array]:
        """Start an episode on a random timeline."""
        if width is None and self.curriculum is not None:
            width = jnp.float32(self.curriculum[1])
        return self._start(self.data, key, width)

    def step(self, state: EnvState, action: jax.Array, key: jax.Array) -> Step:
        """Make the supervisor's step with the policy's action ``(A,)``, then run the graph up to its next step."""
        return self._play(self.data, state, action, key)

    def _reset(self, data: PyTree, key: jax.Array, width: jax.Array | None) -> tuple[EnvState, jax.Array]:
        graph, task = self.graph.with_data(data[0]), with_data(self.task, data[1])

        # Draw a timeline and the parameters.
        k_eps, k_params, k_init = jax.random.split(key, 3)
        eps = jax.random.randint(k_eps, (), 0, graph.episodes)
        params = task.params(k_params) if width is None else task.params(k_params, width)

        # Run to the supervisor's first step.
        gs = graph.init(k_init, params=params, eps=eps)
        gs, step_state, _ = graph.observe(gs, inside=True)
        action = jnp.asarray(self.action_low, jnp.float32)
        for name in self._rewarding:
            _require_reward(task, gs, action, name)
        terms = terms_of(jax.eval_shape(task.reward, gs, action))
        zero = jnp.float32(0.0)
        state = EnvState(gs, step_state, zero, {n: zero for n in terms}, zero, width)
        return state, task.observe(step_state)

    def _step(self, data: PyTree, state: EnvState, action: jax.Array, key: jax.Array) -> Step:
        graph, task = self.graph.with_data(data[0]), with_data(self.task, data[1])

        # Make the supervisor's step, then all other steps of the row.
        valid = jnp.asarray(state.step_state.seq >= 0)
        step_state, output = task.act(state.step_state, action)
        gs = graph.advance(state.graph, step_state, output, inside=True)

        # Reward and success.
        rewards = task.reward(gs, action)
        reward = total_of(rewards)
        last = data[2][gs.eps]
        second_half = gs.step > last // 2
        good = state.good + jnp.where(second_half & task.success(gs), 1.0, 0.0)
        total = state.total + reward
        terms = {name: state.terms[name] + term for name, term in terms_of(rewards).items()}

        # End of the episode: by the task, by a world, or by the timeline.
        of_worlds = [ends(gs.state[name]) for name, ends in self._ending.items()]
        ended = checked_end(task.terminated(gs), task)
        terminated = jnp.any(jnp.array([*(e[0] for e in of_worlds), ended], bool))
        truncated = (gs.step >= last) | jnp.any(jnp.array([e[1] for e in of_worlds], bool))

        # Pushes, then everything up to the supervisor's next step.
        if self.pushes is not None:
            gs = self.pushes.apply(gs, key, state.width)
        gs, step_state, _ = graph.observe(gs, inside=True)
        metrics = {"return": total, "success": good / (last - last // 2)}
        metrics |= {f"{REWARD}{name}": term for name, term in terms.items()}
        new = EnvState(gs, step_state, total, terms, good, state.width)
        return Step(new, task.observe(step_state), reward, terminated, truncated, valid, metrics)


def _require_reward(task: TrainingTask, graph_state: GraphState, action: jax.Array, world: str) -> None:
    """Refuse a training task whose reward does not depend on the reward of the composed task in its world."""
    state = graph_state.state[world]

    def rewarded(earned: tuple[jax.Array, dict[str, jax.Array]]) -> Rewards:
        known = {**graph_state.state, world: state.replace(reward=earned[0], terms=earned[1])}
        return task.reward(graph_state.replace(state=known), action)

    # An input has no effect if no operation reads it and it is no output.
    program = jax.make_jaxpr(rewarded)((state.reward, state.terms)).jaxpr
    read = {id(v) for equation in program.eqns for v in equation.invars} | {id(v) for v in program.outvars}
    if not any(id(v) in read for v in program.invars):
        raise UsageError(
            f"the reward of {type(task).__name__} ignores `get_reward` of the task in world {world!r}",
            hint=f"use graph_state.state[{world!r}].reward or .terms in `reward`, or let get_reward return 0",
        )
