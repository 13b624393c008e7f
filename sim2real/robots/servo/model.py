"""A composed task as the model of a robot of servos: its world, its parameters, and its MJCF."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from sim2real.errors import UsageError
from sim2real.identify.export.plain import PlainSimulation, converged
from sim2real.identify.parameters import Parameter
from sim2real.later import at_once, jnp
from sim2real.robots.loop import ACTUATOR, WORLD
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotModel
from sim2real.robots.servo import parameters
from sim2real.robots.servo.following import identified_following
from sim2real.robots.servo.parts import REFERENCE, GoalTask
from sim2real.robots.servo.payload import PAYLOAD, Hand
from sim2real.robots.servo.servos import Servos, gear_of
from sim2real.robots.servo.task import NO_AIM, Aim
from sim2real.robots.session import Embedded
from sim2real.types import Array, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.emulation.bus import BusEmulation
    from sim2real.hardware.safety.following import Following
    from sim2real.worlds.rollouts import WorldParams

mj: Any = mujoco

_AT_ONCE = 1e9
"""Speed that stands for an infinite one in a document [rad/s]."""


class ComposedModel(RobotModel):
    """A composed task on MJX, whose control step is the world's tick.

    Args:
        dynamics: Returns the parameters; default: those of the servos, and the payload.
    """

    def __init__(
        self,
        servos: Servos,
        make_task: Callable[[], GoalTask],
        aim: Aim = NO_AIM,
        hand: Hand | None = None,
        dynamics: Callable[[], list[Parameter]] | None = None,
        causes: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    ) -> None:
        self.servos, self.make_task, self.aim, self.hand, self.causes = servos, make_task, aim, hand, causes
        self._dynamics = dynamics
        self.profile_rad_s = servos.sheet.profile_rad_s
        self.watched_terms = (PAYLOAD,) if hand else ()

    @cached_property
    def task(self) -> GoalTask:
        """The composed task of this robot's world."""
        task, mounted = self.make_task(), list(self.servos.gears)
        if (built := [s.gear for s in task.robot.servos]) != mounted:
            raise UsageError(
                f"the model's servos have the gears {built}, the joints {mounted}",
                hint="pass the joint to each part, not its name: `Servo(joint, axis, sheet)`",
            )
        return task

    @property
    def tick_s(self) -> float:
        """The world's period [s]."""
        return float(self.task.control_timestep)

    @property
    def lead_s(self) -> float:
        """Half a step of the physics, which the world adds to the actuator's delay [s]."""
        return 0.5 * float(self.task.physics_timestep)

    @property
    def export_lead_s(self) -> float:
        """Time that C MuJoCo adds to the actuator's delay [s].

        It is half a step for the leapfrog, as in the graph, plus half a step because MuJoCo uses setpoints of a step's
        end, minus a quarter of a tick: in the graph a goal acts as its mean over a tick, so a profile starts up to a
        tick early. docs/guides/export.md has the remaining error.
        """
        return 2 * self.lead_s - 0.25 * self.tick_s

    def dynamics(self) -> list[Parameter]:
        """Return the parameters that may be identified, at their data sheet's values."""
        if self._dynamics is not None:
            return self._dynamics()
        of_servos = parameters.parameters(self.servos.sheet, self.servos.joints)
        return [*of_servos, self.hand.parameter()] if self.hand else of_servos

    def make_world(self, resumed: bool = False) -> PyTree:
        """Return the world's node; ``resumed``: episodes begin in the middle of a recording."""
        from sim2real.robots.servo.plain_world import servo_world  # record imports no physics

        fields, worn = self.fields(self.task), self.servos.sheet.worn
        return servo_world(WORLD, self.task, fields, resumed, ACTUATOR, worn)

    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> WorldParams:
        """Return the world's parameters for an episode."""
        position, velocity = (jnp.asarray(x, jnp.float32) for x in (start.position, start.velocity))
        return self._world_params.replace(values=self.place(values, start.aim), qpos=position, qvel=velocity)

    def true_state(self, state: PyTree) -> PyTree:
        """Return positions and velocities of all bodies' joints, and the servos' setpoints."""
        return state.data.qpos, state.data.qvel, state.variables[REFERENCE]

    def fields(self, task: GoalTask) -> Mapping[str, tuple[PyTree, str]]:
        """Return the parts of the model that differ between copies: name -> (elements, attribute)."""
        in_hand = self.hand.fields(task) if self.hand else {}
        return {**parameters.fields(task.robot), **in_hand, **self.aim.elements(task)}

    def place(self, values: Mapping[str, Scalar], aim: Array) -> dict[str, PyTree]:
        """Return the arrays of ``fields`` for parameters by name and an aim ``(k,)``."""
        s = self.servos
        of_servos = parameters.place(values, s.sheet, s.joints, self.task.physics_timestep)
        in_hand = self.hand.place(values, self._world_params.values) if self.hand else {}
        return {**of_servos, **in_hand, **self.aim.place(aim)}

    def identified_mjcf(self, values: Mapping[str, Scalar]) -> str:
        """Return the robot's model with identified values, as MJCF."""
        s, task = self.servos, self.task
        mjcf = parameters.identified_mjcf(self._mjcf, task.robot, values, s.sheet, s.joints)
        return self.hand.loaded(mjcf, task, values) if self.hand else mjcf

    def plain_simulation(self, values: Mapping[str, float]) -> PlainSimulation:
        """Return the composed model with identified values, and the numbers of its servos."""
        s, task = self.servos, self.task
        spec = mj.MjSpec.from_string(self.identified_mjcf(values))
        model = spec.compile()
        joints = tuple(j.full_identifier for j in task.joints)
        at = [(int(model.joint(j).qposadr[0]), int(model.joint(j).dofadr[0])) for j in joints]
        numbers = {"profile_rad_s": np.array([min(x.profile_rad_s, _AT_ONCE) for x in task.robot.servos])}
        if s.sheet.worn:
            widths = np.full(model.nv, _AT_ONCE)
            worn = parameters.of_joints(values, "stribeck", s.joints, _AT_ONCE)
            for (_, dof), joint, width in zip(at, s.joints, worn, strict=True):
                widths[dof] = float(width) / gear_of(joint)
            numbers["stribeck_rad_s"] = widths

        def begin(start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
            for (place, dof), position, speed in zip(at, *np.split(start, 2), strict=True):
                qpos[place], qvel[dof] = position, speed
            return qpos, qvel

        return PlainSimulation(
            converged(spec),
            joints,
            self.tick_s,
            begin,
            "setpoint",
            numbers,
            lead_s=self.lead_s,
            velocity_lead_s=self.lead_s,
        )

    def following(self, values: Mapping[str, float]) -> Following:
        """Return how the joints follow their goals, with every payload that the hand can bear."""
        hand, joints = self.hand, tuple(joint.full_identifier for joint in self.task.joints)
        loads = [{}] if hand is None else [{PAYLOAD: hand.least_kg}, {PAYLOAD: hand.most_kg}]
        return identified_following([self.identified_mjcf({**values, **load}) for load in loads], joints)

    def twin(self, emulator: BusEmulation, **factors: float) -> Embedded:
        """Return an emulated robot with this model's physics.

        Args:
            emulator: Latencies and losses; the servos' model is the data sheet's.
            **factors: Factors on the model's ``gain``, ``damping``, ``armature`` and ``friction``.
        """
        s = self.servos
        arguments = {
            "mjcf": self._mjcf,
            "joints": {name: j.full_identifier for name, j in zip(s.names, self.task.joints, strict=True)},
            "gears": list(s.gears),
            "servo_ids": s.ids,
            "p_gain": s.sheet.p_gain,
            "factors": factors,
        }
        emulator = replace(emulator, model_number=s.sheet.model_number)
        return Embedded("sim2real.emulation.servo_plant:TwinPlant", emulator, arguments)

    @property
    def _mjcf(self) -> str:
        return self.task.root_entity.mjcf_model.root_model.to_xml_string()

    @cached_property
    def _world_params(self) -> WorldParams:
        with at_once():  # a cached array must not belong to the function that JAX traces now
            return self.make_world().init_params()
