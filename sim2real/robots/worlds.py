"""Worlds by name: another simulation of a robot, in the place of its own, that an installed package brings."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.episode import named_leaves
from sim2real.graph.node import BaseNode
from sim2real.hardware.entries import WORLDS
from sim2real.hardware.registry import load_entry
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.robots.contract import RecordedRobot
from sim2real.robots.control_loop.loop import DELAYS, DelayParams
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.control_loop.training_task import Draw
from sim2real.robots.from_model.recorded import LoggedRobot
from sim2real.train.environment.graph_environment import TrainingTask
from sim2real.train.environment.tasks import EndingTask
from sim2real.worlds.recorded import RecordedActuator

AnyRobot = TypeVar("AnyRobot", bound=RecordedRobot)


class WorldModel(ABC):
    """A simulation of a robot: what an entry point of the group ``sim2real.worlds`` makes, called with the robot.

    Its node hears the messages of the robot's actuator, and sends what the robot's own world sends. A field ``start``
    of the node's parameters, shape ``(2 * channels,)``, is where an episode begins: positions, then velocities.

    Args:
        robot: The robot, with a world of its own.
    """

    def __init__(self, robot: RecordedRobot) -> None:
        self.robot = robot

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return what may be identified; each has a ``leaf``, where it belongs: ``world.FIELD``."""

    @abstractmethod
    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the node, with the name that the robot's roles give it."""

    @cached_property
    def node(self) -> BaseNode:
        """A node of this world, for what it says about itself."""
        return self.make_world()

    def params(self, values: Mapping[str, Any], start: Any) -> Any:
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
        UsageError: There is no such world, it is none, or the robot cannot be put into another one.
    """
    if name is None:
        return robot
    model = load_entry("world", name, WORLDS, "robots.worlds.WorldModel")(robot)
    if not isinstance(model, WorldModel):
        raise UsageError(
            f"world {name!r} makes a {type(model).__name__}", hint="it has to be a sim2real.robots.worlds.WorldModel"
        )
    _check(name, robot, model)
    step = {"tick_s": 1.0 / model.node.rate, "lead_s": float(getattr(model.node, "lead_s", 0.0))}
    for base, kind, data in ((LoopRobot, _LoopInWorld, step), (LoggedRobot, _LogInWorld, {})):
        if isinstance(robot, base):
            made: Any = copy.copy(robot)
            made.__class__ = type(type(robot).__name__, (kind, type(robot)), {**data, "model": model, "world": name})
            return made
    raise UsageError(
        f"{type(robot).__name__} makes its nodes itself: it cannot be put into world {name!r}",
        hint="only robots that inherit from LoopRobot or LoggedRobot can",
    )


def _check(name: str, robot: RecordedRobot, model: WorldModel) -> None:
    node, role = model.node, robot.roles.world
    if node.name != role:
        raise UsageError(f"the node of world {name!r} is called {node.name!r}", hint=f"this robot calls it {role!r}")
    if lost := [p.name for p in model.dynamics() if not (p.leaf or "").startswith(f"{role}.")]:
        raise UsageError(
            f"world {name!r} does not say where {', '.join(lost)} belongs", hint=f'give it a leaf="{role}.FIELD"'
        )
    if not hasattr(node.init_params(), "start"):
        raise UsageError(f"the parameters of world {name!r} have no field 'start'", hint="positions, then velocities")


class _LoopInWorld(LoopRobot):
    """A robot of the control loop in another world; its policy, device, task and delays are its own."""

    model: WorldModel
    world: str

    def dynamics(self) -> list[Parameter]:
        return self.model.dynamics()

    def make_world(self, resumed: bool = False) -> BaseNode:
        return self.model.make_world(resumed)

    def true_state(self, state: Any) -> Any:
        return state  # of another kind than the robot's own

    def identified_mjcf(self, values: Mapping[str, Any]) -> str | None:
        del values  # of another model than the robot's own

    def resumed_params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        delays = zip((self.roles.sensor, self.roles.actuator), DELAYS, strict=True)
        own = {node: DelayParams(values.get(delay)) for node, delay in delays}
        return {**own, self.roles.world: self.model.params(values, start)}

    def rest_params(self, values: Mapping[str, Any], policy: Any, trial: int) -> dict[str, Any]:
        own: Any = self.model.robot
        return self._placed(own.rest_params(self._own(values), policy, trial), values)

    def random_params(self, key: jax.Array, draw: Draw) -> dict[str, Any]:
        own: Any = self.model.robot
        of_task, of_world = jax.random.split(key)
        drawn = draw(of_world)
        return self._placed(own.random_params(of_task, lambda _: self._own(drawn)), drawn)

    def training(
        self,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        computation: Mapping[str, DelayDistribution],
        delays: bool,
    ) -> tuple[dict[str, BaseNode], TrainingTask]:
        nodes, task = super().training(values, draws, computation, delays)
        self._require_judgement(task)
        return nodes, task

    def _require_judgement(self, task: TrainingTask) -> None:
        """Refuse a world whose state lacks what the task reads of the robot's own."""
        node = self.make_world()

        def judged() -> Any:
            gs = GraphState(params=task.params(jax.random.key(0)))
            gs = gs.replace(state={node.name: node.init_state(None, gs)})
            ended = task.terminated(gs) if isinstance(task, EndingTask) else None
            return task.reward(gs, jnp.asarray(task.action_low)), task.success(gs), ended

        try:
            jax.eval_shape(judged)
        except (AttributeError, KeyError) as error:
            raise UsageError(
                f"no policy can be trained in world {self.world!r}: the task reads of the world's state what it "
                f"does not have: {error}",
                hint="give the world's state the fields that the robot's own has",
            ) from error

    def _own(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the data sheet's values of the robot's own model, and the delays."""
        own: Any = self.model.robot
        return {**own.nominal(), **{name: values[name] for name in DELAYS if name in values}}

    def _placed(self, params: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
        """Return nodes' parameters with those of this world, which begins where the robot's own would."""
        own: Any = self.model.robot
        node = own.make_world()
        gs = GraphState(params=dict(params))
        first = named_leaves(node.init_output(None, gs.replace(state={node.name: node.init_state(None, gs)})))
        at = [c.of(first[c.position]) for c in self.channels]
        moving = [jnp.zeros(()) if c.velocity is None else c.of(first[c.velocity]) for c in self.channels]
        start = jnp.stack([jnp.asarray(x).reshape(()) for x in (*at, *moving)])
        return {**params, node.name: self.model.params(values, start)}


class _LogInWorld(LoggedRobot):
    """A robot of recordings in another world; sensor, actuator and their parameters are its own."""

    model: WorldModel
    world: str

    def dynamics(self) -> list[Parameter]:
        own, role = super().dynamics(), f"{self.roles.world}."
        return [*self.model.dynamics(), *(p for p in own if not (p.leaf or "").startswith(role))]

    def make_nodes(self) -> tuple[BaseNode, RecordedActuator, BaseNode]:
        sensor, actuator, own = super().make_nodes()
        world = self.model.make_world(resumed=True)
        if world.rate != own.rate:
            raise UsageError(
                f"world {self.world!r} has {world.rate:g} ticks a second, that of these recordings {own.rate:g}",
                hint="samples of the recordings fall on the ticks of the latter",
            )
        return sensor, actuator, world
