"""What the stages need of a robot: the protocol that ``pipelines/NAME/robot.py`` fulfils with its functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode
from sim2real.hardware.config import GateLimits
from sim2real.hardware.embedded import EmbeddedRobot
from sim2real.hardware.rig import ServoRig
from sim2real.identify.model import IdentifiableModel
from sim2real.stages.pipeline import Pipeline
from sim2real.train.env import Task


class Session(AbstractContextManager["Session"], Protocol):
    """An open robot; leaving it takes the torque off."""

    rig: ServoRig
    embedded: EmbeddedRobot | None


class Identifiable(Protocol):
    """What identification alone needs of a robot.

    A robot whose world is MuJoCo's may also have ``identified_mjcf(values) -> str``: its model with what was found.

    Attributes:
        UNITS: Field of a message -> its unit, for axes.
    """

    UNITS: Mapping[str, str]

    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model to identify."""
        ...


class Robot(Identifiable, Protocol):
    """A robot's parts.

    Attributes:
        RATE_HZ: Rate of the supervisor [Hz].
        SUPERVISOR: Name of the node that the policy acts for.
        COMMAND: Node and field of the command that reaches the motors, one entry an action.
        JOINTS: For the log: node -> joint -> quantity -> field, see ``McapRecorder``.
        OBSERVATION: Terms of the policy's observation in order: name, units of its entries, steps of history.
        ACTION: Names of the actions, with units, in order.
        ACTION_BOUNDS: Lowest and highest value of each that the robot bears [its unit].
    """

    RATE_HZ: float
    SUPERVISOR: str
    COMMAND: tuple[str, str]
    JOINTS: Mapping[str, Any]
    OBSERVATION: list[tuple[str, tuple[str, ...], int]]
    ACTION: list[tuple[str, str]]
    ACTION_BOUNDS: Sequence[tuple[float, float]]

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> Session:
        """Open the robot, with torque off."""
        ...

    def prepare(self, session: Session, settle_s: float) -> None:
        """Bring the robot to rest where the task starts, within ``settle_s`` [s] a try; torque is off afterwards."""
        ...

    def recording_nodes(self, session: Session, signal: np.ndarray) -> dict[str, BaseNode]:
        """Return the graph on hardware that plays a signal, one row a step: ``(N,)``, or ``(N, actions)``."""
        ...

    def deployment_nodes(
        self, session: Session, policy: Any, trial: int = 0
    ) -> tuple[dict[str, BaseNode], dict[str, Any]]:
        """Return the graph on hardware that runs a policy, and parameters of its nodes.

        Where what there is to do differs from trial to trial, the same number stands for the same, in simulation too.
        """
        ...

    def training(
        self,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        computation: Mapping[str, DelayDistribution],
        delays: bool,
    ) -> tuple[dict[str, BaseNode], Task]:
        """Return the graph in simulation and the task, whose copies take parameters from ``draws (K,)``."""
        ...

    def simulation_params(self, values: Mapping[str, float], policy: Any, trial: int = 0) -> dict[str, Any]:
        """Return node parameters of the graph in simulation that starts at rest and runs a policy."""
        ...

    def nominal(self) -> dict[str, float]:
        """Return the data sheet's values of the parameters, without any delay."""
        ...

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return how well a deployment went, ``success`` among it.

        Args:
            t_s: Times ``(N,)`` [s].
            states: Fields ``(N,)``, a vector's entries as ``name[i]``; and, one a step, what the supervisor sent and
                the command that reached the motors, ``command`` where it is one number.
        """
        ...


def moving_robot(pipeline: Pipeline) -> Robot:
    """Return the parts of a robot that can be recorded, trained for and deployed on.

    Raises:
        UsageError: When the pipeline is of recordings alone: it only knows what identification needs.
    """
    robot = pipeline.load()
    if not hasattr(robot, "connect"):
        name = pipeline.name
        raise UsageError(
            f"pipeline {name!r} is of recordings that somebody else made: there is no robot to record, train or deploy",
            hint=f"import a recording with `sim2real import FILE --pipeline {name}`, then `sim2real identify {name}`",
        )
    return cast(Robot, robot)
