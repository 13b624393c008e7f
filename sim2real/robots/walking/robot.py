"""A walking robot, made of an MJCF file and terms of a reward."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import jax

from sim2real.emulation.body import Terrain
from sim2real.policy.runner import BlendedRunner
from sim2real.robots.loop import DELAYS
from sim2real.robots.messages import States, Trials
from sim2real.robots.robot import Robot
from sim2real.robots.walking.drive import LegMotors, WalkingDrive
from sim2real.robots.walking.stand import LegsInAStand
from sim2real.robots.walking.task import Commands, Moment, Term, WalkingTask
from sim2real.robots.walking.world import WalkingModel

if TYPE_CHECKING:
    from sim2real.artifacts.bundle import Bundle


class ComposedRobot(Robot):
    """A robot with a floating base that follows commanded velocities.

    Attributes:
        mjcf: The model, with its floor.
        joints: Names of the joints, in the order of the motors.
        feet: Names of the feet; a foot is a sphere, and a site of the same name in its middle.
        stance: Positions of the joints for the action 0 [rad].
        height_m: Height of the base in this stance [m].
        touching_m: Height of a foot's site below which it touches the ground [m].
        scale: Change of a target for the action 1 [rad].
        policy_hz: Steps of the policy per second [Hz].
        history: Number of earlier observations that the policy gets.
        gains: kp [N m/rad] and kd [N m s/rad] of the motors, as in the MJCF file.
        motors: The motors on hardware; None: the robot has no device.
        delays_s: Delays of sensor and actuator without an identification [s].
        terrain: Rough ground, for a training with the parameter ``roughness``.
        groups: Name of a group -> numbers of its joints, which share damping, dry friction and armature; empty: all
            joints are in the group ``joint``.
        noise: Field of the reading -> standard deviation and bias of its noise without an identification, in the
            field's unit.
    """

    mjcf: ClassVar[Path]
    joints: ClassVar[tuple[str, ...]]
    feet: ClassVar[tuple[str, ...]]
    stance: ClassVar[tuple[float, ...]]
    height_m: ClassVar[float]
    touching_m: ClassVar[float]
    scale: ClassVar[float] = 0.5
    history: ClassVar[int] = 2
    policy_hz: ClassVar[float] = 50.0
    commands: Commands = Commands()
    terrain: ClassVar[Terrain] = Terrain()
    gains: ClassVar[tuple[float, float]] = (35.0, 0.6)
    motors: ClassVar[LegMotors | None] = None
    delays_s: ClassVar[tuple[float, float]] = (0.008, 0.008)
    groups: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType({})
    noise: ClassVar[Mapping[str, tuple[float, float]]] = MappingProxyType({})

    model: WalkingModel

    def __init__(self) -> None:
        self.drive, self.model, self.task = WalkingDrive(self), WalkingModel(self), WalkingTask(self)

    @abstractmethod
    def terms(self) -> Mapping[str, Term]:
        """Return the terms of the reward by name: weight, and a function of a ``Moment``."""

    def falls(self, now: Moment) -> jax.Array:
        """Return whether the robot has fallen: its base is below half of its height, or it lies on its side."""
        return (now.height < 0.5 * self.height_m) | (now.gravity[2] > -0.5)

    def commanded(self, command: tuple[float, float, float]) -> ComposedRobot:
        """Return the robot with this command in all trials."""
        robot = copy.copy(self)  # with its name and defaults
        robot.commands, robot._world = replace(self.commands, fixed=command), None
        robot.__init__()
        return robot

    def nominal(self) -> dict[str, float]:
        return super().nominal() | dict(zip(DELAYS, self.delays_s, strict=True))

    def identifiable(self, max_delay_s: float) -> LegsInAStand:
        return LegsInAStand(self, max_delay_s)

    def simulated(self, bundle: Bundle, trials: Trials) -> list[tuple[States, States]]:
        """Return one episode of each trial in C MuJoCo: its graph takes over ten minutes to compile on a processor."""
        from sim2real.robots.walking.twin import episode

        runner, nominal = BlendedRunner(bundle.runner(), trials.blend_s), self.nominal()
        values = [nominal | dict(row) for row in trials.parameters[: len(trials.rest)]]
        played = [episode(self, runner, row, number, trials.duration_s) for number, row in enumerate(values)]
        return [(states, states) for states in played]
