"""The protocol of a robot: what the stages need from ``pipelines/NAME/robot.py``."""

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
from sim2real.hardware.rig import Rig
from sim2real.identify.model import IdentifiableModel
from sim2real.stages.pipeline import Pipeline
from sim2real.train.env import Task


class Session(AbstractContextManager["Session"], Protocol):
    """An open robot, as a context manager; leaving it takes the torque off.

    Attributes:
        rig: The device behind the safety gate.
        embedded: The emulated robot, if the session has one.
    """

    rig: Rig
    embedded: EmbeddedRobot | None


class Identifiable(Protocol):
    """What identification needs of a robot.

    A robot with a MuJoCo model may also have ``identified_mjcf(values) -> str``, which returns the model with the
    identified parameters.

    Attributes:
        UNITS: Field of a message -> its unit.
    """

    UNITS: Mapping[str, str]

    def identifiable(self, max_delay_s: float) -> IdentifiableModel:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""
        ...


class Robot(Identifiable, Protocol):
    """What all stages need of a robot.

    Attributes:
        RATE_HZ: Rate of the supervisor [Hz].
        SUPERVISOR: Name of the node whose steps the policy makes.
        COMMAND: Node and field of the command that is sent to the motors, with one entry per action.
        JOINTS: Node -> joint -> quantity -> field, for the log; see ``McapRecorder``.
        OBSERVATION: Terms of the policy's observation, in order: (name, units of its entries, steps of history).
        ACTION: The actions, in order: (name, unit).
        ACTION_BOUNDS: Lowest and highest allowed value of each action [the action's unit].
    """

    RATE_HZ: float
    SUPERVISOR: str
    COMMAND: tuple[str, str]
    JOINTS: Mapping[str, Any]
    OBSERVATION: list[tuple[str, tuple[str, ...], int]]
    ACTION: list[tuple[str, str]]
    ACTION_BOUNDS: Sequence[tuple[float, float]]

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> Session:
        """Open the robot, with torque off.

        Args:
            port: Device file of the port, or ``embedded`` for the emulated robot.
            limits: Limits of the safety gate.
            truth_path: File for the emulated robot's true states and latencies.
            seed: Seed of the emulated robot.
        """
        ...

    def prepare(self, session: Session, settle_s: float) -> None:
        """Bring the robot to rest where the task starts; torque is off afterwards.

        Args:
            session: The open robot.
            settle_s: Longest time to wait for rest, per attempt [s].
        """
        ...

    def recording_nodes(self, session: Session, signal: np.ndarray) -> dict[str, BaseNode]:
        """Return the graph on hardware that sends an excitation signal.

        Args:
            session: The open robot.
            signal: Shape ``(N,)`` or ``(N, actions)``: one command per step.
        """
        ...

    def deployment_nodes(
        self, session: Session, policy: Any, trial: int = 0
    ) -> tuple[dict[str, BaseNode], dict[str, Any]]:
        """Return the graph on hardware that runs a policy, and parameters of its nodes.

        Args:
            session: The open robot.
            policy: The policy: a pytree with ``get_action(observation)``.
            trial: Number of the trial. If the task differs between trials, e.g. in its target, the same number stands
                for the same task, on hardware and in simulation.
        """
        ...

    def training(
        self,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        computation: Mapping[str, DelayDistribution],
        delays: bool,
    ) -> tuple[dict[str, BaseNode], Task]:
        """Return the graph in simulation, and the training task.

        Args:
            values: Parameters by name.
            draws: Samples of some parameters, each of shape ``(K,)``; an episode uses one of the K joint samples in
                place of the values.
            computation: Node -> distribution of its computation delay.
            delays: Whether the graph has delays.
        """
        ...

    def simulation_params(self, values: Mapping[str, float], policy: Any, trial: int = 0) -> dict[str, Any]:
        """Return the nodes' parameters for an episode in simulation that starts at rest.

        Args:
            values: Parameters by name.
            policy: The policy.
            trial: Number of the trial, as in ``deployment_nodes``.
        """
        ...

    def nominal(self) -> dict[str, float]:
        """Return the data sheet's values of the parameters, without delays."""
        ...

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return figures of how well a deployment went, among them ``success``.

        Args:
            t_s: Times ``(N,)`` [s].
            states: Name -> values ``(N,)``; entries of a vector are named ``name[i]``. Besides the measured fields, one
                value per step of what the supervisor sent, and of ``command``, the command that was sent to the motors.
        """
        ...


def moving_robot(pipeline: Pipeline) -> Robot:
    """Return a pipeline's robot for the stages that need hardware or training.

    Raises:
        UsageError: When the pipeline is for recordings only, and has just what identification needs.
    """
    robot = pipeline.load()
    if not hasattr(robot, "connect"):
        name = pipeline.name
        raise UsageError(
            f"pipeline {name!r} is of recordings that somebody else made: there is no robot to record, train or deploy",
            hint=f"import a recording with `sim2real import FILE --pipeline {name}`, then `sim2real identify {name}`",
        )
    return cast(Robot, robot)
