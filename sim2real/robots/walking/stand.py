"""Legs in a stand as a model to identify: the base is fixed, the feet are in the air."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import OtherMotion
from sim2real.graph.episode import Episode
from sim2real.graph.node import BaseNode
from sim2real.identification.parameters import ParameterTable
from sim2real.robots.loop import ACTUATOR, SENSOR, WORLD, delay_parameters, recorded_loop
from sim2real.robots.model.drives import EncoderParams, Encoders, driven_spec
from sim2real.robots.model.file import read_spec
from sim2real.robots.walking.drive import gravity_of
from sim2real.robots.walking.world import MOTOR_STRENGTH, STRENGTH
from sim2real.types import Array, MjModel, PyTree, Scalar
from sim2real.worlds.driven import DriveCommand, DrivenWorld
from sim2real.worlds.mjx import MjxState
from sim2real.worlds.recorded import DelayParams, RecordedActuator

if TYPE_CHECKING:
    from sim2real.robots.walking.robot import ComposedRobot

STEP_S, FINE_S = 0.002, 0.001
"""Time step of the simulation, and the shorter step of training, to which parameters refer [s]. A time step acts like
an armature of half the step times the damping, so the longer step gets less armature. It halves the time of a fit.
"""
_STILL_RAD_S, _LEVEL_RAD = 0.04, 0.01
"""Largest standard deviation in a stand: of the gyro [rad/s], and of the tilt [rad], which legs on a floor change
slowly.
"""


class LegsInAStand:
    """Simulates what the encoders of legs in a stand measure; an ``identification.model.IdentifiableModel``.

    Args:
        max_delay_s: Upper bound of each delay [s].
    """

    sensor, ahead_s = SENSOR, STEP_S

    def __init__(self, robot: ComposedRobot, max_delay_s: float) -> None:
        self.channels, self._rate_hz, self._kd = robot.drive.channels, robot.policy_hz, robot.gains[1]
        self._joints, self._model = robot.model.joints, stand_model(robot.mjcf)
        # Each motor has a strength, so a common factor on all of them is not identified.
        fixed = [replace(p, free=False) for p in robot.model.parameters_without_joint() if p.name == STRENGTH]
        rows = [*self._joints.dynamics(), *fixed, *self._joints.zeros(), *delay_parameters(max_delay_s)]
        self.parameters = ParameterTable(rows)
        columns: dict[str, PyTree] = {"goal": "q", "goal_velocity": "dq", "torque": "tau", "kp": "kp", "kd": "kd"}
        self.given: Mapping[str, PyTree] = {ACTUATOR: DriveCommand(**columns)}
        self._world = self._make_world()
        self._plain = self._world.init_params()

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, connected with delays of up to ``max_delay_s`` [s]."""
        world, still = self._make_world(), jnp.zeros(len(self._joints.motors))
        sensor = Encoders(SENSOR, self._rate_hz, world, velocity=True)
        command = DriveCommand(goal=still, goal_velocity=still, torque=still, kp=still, kd=still)
        actuator = RecordedActuator(ACTUATOR, self._rate_hz, command)
        return recorded_loop(sensor, actuator, world, max_delay_s, self.ahead_s, world.lead_s)

    def check(self, episode: Episode) -> None:
        """Refuse a log in which the base turns: it was not in a stand.

        Raises:
            OtherMotion: The gyro measured a rotation, or the tilt changed.
        """
        sensed, level = episode.outputs[self.sensor], np.array([[1.0, 0.0, 0.0, 0.0]])
        gyro = np.asarray(sensed.get("gyro", np.zeros((1, 3))), np.float64)
        tilt = [gravity_of(q)[:2] for q in np.asarray(sensed.get("quaternion", level), np.float64)]
        turning, tilting = float(gyro.std(axis=0).max()), float(np.std(tilt, axis=0).max())
        if turning > _STILL_RAD_S or tilting > _LEVEL_RAD:
            raise OtherMotion(
                f"the base of the robot moved (its gyro varies by {turning:.2g} rad/s, its tilt by {tilting:.2g} rad), "
                "and this model is of legs in a stand",
                hint="record the robot in a stand, with its legs in the air; give a log on its feet as --standing",
            )

    def params(self, values: Mapping[str, Scalar], start: Array) -> dict[str, PyTree]:
        """Return the nodes' parameters.

        Args:
            start: Shape ``(2 * joints,)``: positions as measured, then velocities.
        """
        joints, dofs, count = self._joints, self._world.qvel_at, len(self._joints.motors)
        places = {"dof_damping": "damping", "dof_frictionloss": "friction", "dof_armature": "armature"}
        fields = {
            field: getattr(self._plain.model, field).at[dofs].set(joints.of_group(values, quantity, jnp))
            for field, quantity in places.items()
        }
        # A motor's strength is a factor on its whole torque.
        strength, zero = (joints.of_motor(values, name, jnp) for name in (MOTOR_STRENGTH, "zero"))
        damping = fields["dof_damping"].at[dofs].add(self._kd * strength)
        fields["dof_armature"] -= 0.5 * (STEP_S - FINE_S) * damping
        still, state = jnp.zeros(count), jnp.asarray(start)
        drive = {"kp": strength, "kd": strength, "gain": strength, "zero": zero, "released": still, "voltage": still}
        world = self._plain.replace(model=self._plain.model.tree_replace(fields), **drive)
        late_s = values["sensor_delay"] + self.ahead_s
        return {
            WORLD: self._world.started(world, state[:count] - zero, state[count:]),
            SENSOR: EncoderParams(zero=zero, delay=late_s),
            ACTUATOR: DelayParams(values["actuator_delay"]),
        }

    def _make_world(self) -> DrivenWorld:
        return _World(WORLD, 1.0 / STEP_S, self._model)


def stand_model(mjcf: Path) -> MjModel:
    """Return the model of a walking robot whose base is fixed, with a drive on each joint with an actuator."""
    joints = [actuator.target for actuator in read_spec(mjcf).actuators]
    spec = driven_spec(mjcf, joints, STEP_S, fix_base=True, contacts=False)
    for geom in spec.geoms:  # MJX refuses some kinds of geoms, even with contacts switched off
        geom.contype = geom.conaffinity = 0
    return spec.compile()


class _World(DrivenWorld):
    """The legs, with the velocities of the shorter time step."""

    def message(self, state: PyTree, qpos: jax.Array, qvel: jax.Array, qacc: jax.Array) -> MjxState:
        # MuJoCo's velocities are half a step older than its positions.
        return super().message(state, qpos, qvel + 0.5 * (STEP_S - FINE_S) * qacc, qacc)
