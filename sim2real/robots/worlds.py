"""Worlds by name: an installed package provides another simulation of a robot, which replaces its own."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.later import jax, jnp
from sim2real.robots.contract import RecordedRobot, Robot, RobotModel, RobotTask
from sim2real.robots.control_loop.loop import Draw
from sim2real.robots.control_loop.messages import EpisodeStart
from sim2real.robots.from_model.recorded import LoggedRobot
from sim2real.robots.roles import Roles
from sim2real.training.environment.tasks import EndingTask, Rewards
from sim2real.types import Array, Key, PyTree, Scalar
from sim2real.worlds.recorded import RecordedActuator

if TYPE_CHECKING:
    from sim2real.training.environment.graph_environment import TrainingTask

AnyRobot = TypeVar("AnyRobot", bound=RecordedRobot)


class WorldModel(ABC):
    """A simulation of a robot. An entry point of the group ``sim2real.worlds`` makes it from the robot.

    The input of its node is the robot's actuator, and its output has the fields of the robot's own world. A field
    ``start`` of the node's parameters, shape ``(2 * channels,)``, is an episode's start: positions, then velocities.
    """

    def __init__(self, robot: RecordedRobot) -> None:
        self.robot = robot

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return the parameters that can be identified; the ``leaf`` of each is ``world.FIELD``."""

    @abstractmethod
    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the node, with the name that the robot's roles give it."""

    @cached_property
    def node(self) -> BaseNode:
        """A node of this world, for its descriptions."""
        return self.make_world()

    def params(self, values: Mapping[str, Scalar], start: PyTree) -> PyTree:
        """Return the node's parameters.

        Args:
            start: Shape ``(2 * channels,)``: positions, then velocities.
        """
        node = self.node
        placed = ParameterTable(self.dynamics()).placed({node.name: node.init_params()}, values)
        return placed[node.name].replace(start=jnp.asarray(start, jnp.float32))


def in_world(robot: AnyRobot, name: str | None) -> AnyRobot:
    """Return a robot in the world of a name.

    Args:
        name: The world; None: the robot's own.

    Raises:
        UsageError: There is no such world, it is no ``WorldModel``, or the robot cannot use another world.
    """
    if name is None:
        return robot
    # Load the world of an installed package.
    from sim2real.hardware.entries import WORLDS
    from sim2real.hardware.registry import load_entry

    model = load_entry("world", name, WORLDS, "robots.worlds.WorldModel")(robot)
    if not isinstance(model, WorldModel):
        raise UsageError(
            f"world {name!r} makes a {type(model).__name__}", hint="it has to be a sim2real.robots.worlds.WorldModel"
        )
    _check(name, robot, model)
    # Put it in the place of the robot's own.
    if isinstance(robot, Robot):
        moved: PyTree = copy.copy(robot)
        moved.model, moved.task = _OtherWorld(model, name), _OtherWorldsTask(robot.task)
        return moved
    if isinstance(robot, LoggedRobot):
        moved = copy.copy(robot)
        moved.__class__ = type(type(robot).__name__, (_LogInWorld, type(robot)), {"model": model, "world": name})
        return moved
    raise UsageError(
        f"{type(robot).__name__} makes its nodes itself: it cannot use world {name!r}",
        hint="only robots that inherit from Robot or LoggedRobot can",
    )


def _check(name: str, robot: RecordedRobot, model: WorldModel) -> None:
    node, role = model.node, robot.roles.world
    if node.name != role:
        raise UsageError(f"the node of world {name!r} is called {node.name!r}", hint=f"this robot calls it {role!r}")
    if lost := [p.name for p in model.dynamics() if not (p.leaf or "").startswith(f"{role}.")]:
        raise UsageError(f"world {name!r} has no leaf for {', '.join(lost)}", hint=f'give it a leaf="{role}.FIELD"')
    if not hasattr(node.init_params(), "start"):
        raise UsageError(f"the parameters of world {name!r} have no field 'start'", hint="positions, then velocities")


class _OtherWorld(RobotModel):
    """The model of a robot in another world."""

    def __init__(self, model: WorldModel, name: str) -> None:
        self._model, self._name = model, name
        self.tick_s, self.lead_s = 1.0 / model.node.rate, float(getattr(model.node, "lead_s", 0.0))

    def dynamics(self) -> list[Parameter]:
        return self._model.dynamics()

    def make_world(self, resumed: bool = False) -> BaseNode:
        return self._model.make_world(resumed)

    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> PyTree:
        return self._model.params(values, jnp.concatenate([*map(jnp.asarray, (start.position, start.velocity))]))

    def check_task(self, task: TrainingTask) -> None:
        node = self.make_world()

        def judged() -> PyTree:
            gs = GraphState(params=task.params(jax.random.key(0)))
            gs = gs.replace(state={node.name: node.init_state(None, gs)})
            ended = task.terminated(gs) if isinstance(task, EndingTask) else None
            return task.reward(gs, jnp.asarray(task.action_low)), task.success(gs), ended

        try:
            jax.eval_shape(judged)
        except (AttributeError, KeyError) as error:
            raise UsageError(
                f"no policy can be trained in world {self._name!r}: its state lacks a field that the task reads: "
                f"{error}",
                hint="give the world's state the fields that the robot's own world has",
            ) from error


class _OtherWorldsTask(RobotTask):
    """The task of a robot in another world: its own, with values of the other world's parameters."""

    def __init__(self, task: RobotTask) -> None:
        self._task, self.aim_size = task, task.aim_size

    def random(self, key: Key, draw: Draw) -> tuple[dict[str, PyTree], EpisodeStart]:
        of_task, of_world = jax.random.split(key)
        values = draw(of_world)
        return values, self._task.random(of_task, lambda _: values)[1]

    def at_rest(self, trial: int) -> EpisodeStart:
        return self._task.at_rest(trial)

    def moved(self, start: EpisodeStart, position: Array, velocity: Array) -> EpisodeStart:
        return self._task.moved(start, position, velocity)

    def judged(self, graph_state: GraphState, roles: Roles) -> PyTree:
        return self._task.judged(graph_state, roles)

    def reward(self, state: PyTree, action: jax.Array) -> Rewards:
        return self._task.reward(state, action)

    def success(self, state: PyTree) -> jax.Array:
        return self._task.success(state)

    def terminated(self, state: PyTree) -> jax.Array:
        return self._task.terminated(state)

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        return self._task.score(t_s, states)


class _LogInWorld(LoggedRobot):
    """A robot of recordings in another world; sensor, actuator and their parameters are its own."""

    model: WorldModel
    world: str

    def dynamics(self) -> list[Parameter]:
        rows, role = super().dynamics(), f"{self.roles.world}."
        return [*self.model.dynamics(), *(p for p in rows if not (p.leaf or "").startswith(role))]

    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        sensor, actuator, replaced = super().make_nodes()
        world = self.model.make_world(resumed=True)
        if world.rate != replaced.rate:
            raise UsageError(
                f"world {self.world!r} has {world.rate:g} ticks a second, that of these recordings {replaced.rate:g}",
                hint="samples of the recordings must fall on ticks of the world",
            )
        return sensor, actuator, world
