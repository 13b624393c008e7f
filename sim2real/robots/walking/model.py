"""A walking robot in simulation, and its parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.identification.parameters import Parameter
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotModel
from sim2real.robots.walking.joints import STRENGTH as MOTOR_STRENGTH
from sim2real.robots.walking.joints import JointParameters
from sim2real.robots.walking.scene import Ground
from sim2real.robots.walking.terrain import Terrain
from sim2real.robots.walking.world import ARMATURE, PAYLOAD, WalkingWorld
from sim2real.types import PyTree, Scalar
from sim2real.worlds.composed import WorldParams

FRICTION, STRENGTH, ROUGHNESS = "foot_friction", "motor_strength", "roughness"


class WalkingModel(RobotModel):
    """A composed task on MJX: on Warp if JAX computes on a GPU, as MJX's JAX is 20 times slower with contacts there.

    Args:
        joints: Parameters of the joints, in the order of the actuators.
        height_m: Height of the base at the start of an episode [m].
        terrain: Largest roughness, and where in the task's ground it is.
        make_task: Makes the composed task; True: on rough ground.
        rooms: Contacts and rows of constraints that Warp has room for in a copy.
    """

    needs_gpu = True

    def __init__(
        self,
        make_task: Callable[[bool], Ground],
        joints: JointParameters,
        height_m: float,
        terrain: Terrain,
        loads: tuple[float, float] = (-1.0, 3.0),
        rooms: tuple[int, int] = (16, 96),
        rough: bool = False,
    ) -> None:
        self._make_task, self.joints, self._height_m, self._terrain = make_task, joints, height_m, terrain
        self._loads, self._rooms, self._rough = loads, rooms, rough

    @cached_property
    def task(self) -> Ground:
        """The composed task."""
        return self._make_task(self._rough)

    @property
    def tick_s(self) -> float:
        """The world's period [s]."""
        return float(self.task.control_timestep)

    def dynamics(self) -> list[Parameter]:
        """Return friction of feet, load, strength of motors, roughness of the ground, and parameters of joints."""
        return [*self.around(), *self.joints.dynamics()]

    def unidentified(self) -> dict[str, float]:
        """Return friction of the feet, load and roughness of the ground: legs in a stand determine none of them."""
        return {p.name: p.nominal for p in self.around() if p.name != STRENGTH}

    def around(self) -> list[Parameter]:
        """Return the parameters that are of no joint: legs in the air determine none of them."""
        return [
            Parameter(FRICTION, "1", 0.8, 0.2, 2.0, about="friction of the feet on the ground"),
            Parameter(PAYLOAD, "kg", 0.0, *self._loads, "linear", about="load in the base"),
            Parameter(STRENGTH, "1", 1.0, 0.5, 1.5, about="factor on the motors' gains"),
            Parameter(ROUGHNESS, "m", 0.0, 0.0, self._terrain.most_m, "linear", about="height of bumps of the ground"),
        ]

    def for_training(self, values: Mapping[str, float], draws: Mapping[str, np.ndarray]) -> WalkingModel:
        """Return a model whose ground is a height field if episodes have roughness: a plane costs less."""
        bumps_m = np.asarray(draws.get(ROUGHNESS, values.get(ROUGHNESS, 0.0)))
        if not bumps_m.any():
            return self
        low, high, most_m = float(bumps_m.min()), float(bumps_m.max()), self._terrain.most_m
        if low < 0.0 or high > most_m:
            raise UsageError(
                f"roughness must lie in [0, {most_m:g}] m, got {low:.3g} to {high:.3g}",
                hint="`terrain = Terrain(most_m=0.2)` in the robot's file makes its ground rougher",
            )
        return WalkingModel(
            self._make_task, self.joints, self._height_m, self._terrain, self._loads, self._rooms, rough=True
        )

    def make_world(self, resumed: bool = False) -> WalkingWorld:
        """Return the world's node."""
        del resumed
        task, on_gpu = self.task, jax.default_backend() == "gpu"
        places = {
            FRICTION: (task.foot_geoms, "friction"),
            "gain": (task.actuators, "gainprm"),
            "bias": (task.actuators, "biasprm"),
            "damping": (task.joints, "damping"),
            "friction": (task.joints, "frictionloss"),
        }
        options = {"impl": "warp", "nconmax": self._rooms[0], "njmax": self._rooms[1]} if on_gpu else {}
        return WalkingWorld(task, places, self._loads, **options)

    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> WorldParams:
        """Return the world's parameters for an episode: the base is level and at rest.

        On rough ground the base starts at the place that has the roughness, above the highest bump there.
        """
        usual, joints = self._world_params.values, self.joints
        strength = jnp.asarray(values[STRENGTH], jnp.float32) * joints.of_motor(values, MOTOR_STRENGTH, jnp)
        placed = {
            FRICTION: usual[FRICTION].at[..., 0].set(values[FRICTION]),
            "gain": usual["gain"] * strength[:, None],
            "bias": usual["bias"] * strength[:, None],
            "damping": joints.of_group(values, "damping", jnp),
            "friction": joints.of_group(values, "friction", jnp),
            ARMATURE: joints.of_group(values, "armature", jnp),
            PAYLOAD: jnp.asarray(values[PAYLOAD], jnp.float32),
        }
        bumps_m = jnp.asarray(values[ROUGHNESS] if self.task.rough else 0.0, jnp.float32)
        x_m = self._terrain.start_m(bumps_m) if self.task.rough else 0.0
        base = jnp.array([x_m, 0.0, self._height_m + bumps_m, 1.0, 0.0, 0.0, 0.0], jnp.float32)
        position, velocity = (jnp.asarray(x, jnp.float32) for x in (start.position, start.velocity))
        return WorldParams(placed, jnp.concatenate([base, position]), jnp.concatenate([jnp.zeros(6), velocity]))

    def true_state(self, state: PyTree) -> PyTree:
        """Return height above the ground, positions, velocities and torques, and what the feet did."""
        data, v = state.data, state.variables
        position = data.qpos[2:]
        if self.task.rough is not None:
            position = position.at[0].add(-self.task.rough.at(data.qpos[:2]))
        return position, data.qvel, data.actuator_force, v["air_s"], v["ground_s"], v["mean"]

    @cached_property
    def _world_params(self) -> WorldParams:
        with jax.ensure_compile_time_eval():  # a cached array must not belong to the function that JAX traces now
            return self.make_world().init_params()
