"""A walking robot in simulation: its task on the ground, its world, and its parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.physics.mjx import stepping
from sim2real.emulation.body import FLOOR, HeightField
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.identification.parameters import Parameter
from sim2real.robots.loop import ACTUATOR, WORLD
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotModel
from sim2real.robots.walking.drive import BodyReading
from sim2real.types import Array, PyTree, Scalar
from sim2real.worlds.composed import ComposedWorld, WorldParams

if TYPE_CHECKING:
    from sim2real.composer.mjx_environment import State
    from sim2real.composer.physics.mjx.physics import MjxPhysics
    from sim2real.robots.walking.robot import ComposedRobot

FRICTION, STRENGTH, ROUGHNESS = "foot_friction", "motor_strength", "roughness"
PAYLOAD, ARMATURE, MOTOR_STRENGTH = "payload", "armature", "strength"
QUANTITIES = {
    "damping": ("N m s/rad", 0.1, 0.002, 2.0, "viscous friction of a joint"),
    "friction": ("N m", 0.2, 0.005, 2.0, "dry friction of a joint"),
    "armature": ("kg m^2", 0.01, 0.0005, 0.1, "rotor behind the gears"),
}
"""Quantity of a group of joints -> unit, nominal value, bounds, description."""
ZERO_RAD = 0.015
"""Standard deviation of the prior of an encoder's zero [rad]."""


@dataclass(frozen=True)
class JointParameters:
    """Names of the parameters of joints, and their places.

    Attributes:
        motors: Names of the joints, in the order of the motors.
        groups: Name of a group -> numbers of its joints, which share damping, friction and armature.
    """

    motors: tuple[str, ...]
    groups: Mapping[str, Sequence[int]]

    def dynamics(self) -> list[Parameter]:
        """Return damping, friction and armature of each group, and the strength of each motor."""
        rows = [
            Parameter(f"{group}_{name}", unit, nominal, low, high, about=about, vanishes=name != "armature")
            for group in self.groups
            for name, (unit, nominal, low, high, about) in QUANTITIES.items()
        ]
        about = "factor on the motor's torque"
        return rows + [Parameter(f"{m}_{MOTOR_STRENGTH}", "1", 1.0, 0.4, 2.0, about=about) for m in self.motors]

    def zeros(self) -> list[Parameter]:
        """Return the encoders' zeros, with a prior: legs in the air weigh little, so a log hardly shows their zeros."""
        prior, about = (0.0, ZERO_RAD), "encoder at the model's zero"
        return [
            Parameter(f"{m}_zero", "rad", 0.0, -0.1, 0.1, "linear", "measurement", about, prior=prior)
            for m in self.motors
        ]

    def of_group(self, values: Mapping[str, Scalar], quantity: str, xp: PyTree = np) -> Array:
        """Return a quantity of all joints, ``(joints,)``."""
        each = {i: values[f"{group}_{quantity}"] for group, at in self.groups.items() for i in at}
        return xp.stack([xp.asarray(each[i], dtype=float) for i in range(len(self.motors))])

    def of_motor(self, values: Mapping[str, Scalar], quantity: str, xp: PyTree = np) -> Array:
        """Return a quantity that is identified for each motor, ``(joints,)``."""
        return xp.stack([xp.asarray(values[f"{motor}_{quantity}"], dtype=float) for motor in self.motors])


_SMOOTHED_S = 0.4
"""Time constant of the mean velocity by which success is judged, as a gait sways within a step [s]."""


class Ground(composer.Task):
    """A robot on the floor of its MJCF file; one control step is one step of the physics.

    Args:
        path: MJCF with one free joint, and an actuator for each other joint.
        feet: Sites in the middle of the feet's spheres.
        touching_m: Height of such a site below which the foot touches the ground [m].
        collide: Geoms that collide with the floor in training; empty: all.
        rough: Heights of rough ground that replaces the model's floor; None: the floor.
    """

    def __init__(
        self,
        path: Path,
        feet: Sequence[str],
        touching_m: float,
        collide: Sequence[str] = (),
        rough: HeightField | None = None,
    ) -> None:
        model = mjcf.from_path(str(path))
        self._entity = composer.ModelWrapperEntity(model)
        free = [j for j in model.find_all("joint") if j.tag == "freejoint" or j.type == "free"]
        if len(free) != 1:
            raise UsageError(f"{path} has {len(free)} free joints, and a walking robot has one")
        self.base = free[0].parent
        self.feet = [model.find("site", name) for name in feet]
        self.actuators = model.find_all("actuator")
        self.joints = [actuator.joint for actuator in self.actuators]
        self.foot_geoms = [model.find("geom", name) for name in feet]
        self._touching_m, self.rough = touching_m, rough
        if rough is not None:
            floor = model.find("geom", FLOOR)
            if floor is None:
                raise UsageError(f"{path} has no geom {FLOOR!r}, which rough ground replaces")
            # MJCF lists the rows of heights in reverse order.
            (rows, columns), share = rough.heights.shape, rough.heights[::-1] / rough.heights.max()
            floor.type, floor.hfield = (
                "hfield",
                model.asset.add(
                    "hfield", name="ground", nrow=rows, ncol=columns, size=rough.size, elevation=share.ravel()
                ),
            )
        if collide:
            for geom in model.find_all("geom"):
                if geom.name != FLOOR:
                    geom.contype, geom.conaffinity = 0, int(geom.name in collide)
        self._entity.observables.disable_all()

    @property
    def root_entity(self) -> Any:
        return self._entity

    def initialize_episode(self, physics: Any, random_state: Any) -> None:
        del random_state
        xp, count = physics.np, len(self.feet)
        for name in ("air_s", "ground_s", "swing_s", "slip_m_s"):
            physics.variables[name] = xp.zeros(count)
        physics.variables["at_m"] = xp.zeros((count, 3))
        physics.variables["mean"] = xp.zeros(3)

    def after_step(self, physics: Any, random_state: Any) -> None:
        del random_state
        v, xp, tick_s = physics.variables, physics.np, self.physics_timestep
        at = physics.bind(self.feet).xpos
        height = at[:, 2] if self.rough is None else at[:, 2] - self.rough.at(at[:, :2])
        touches, moved = height < self._touching_m, xp.sqrt(xp.sum((at - v["at_m"])[:, :2] ** 2, axis=-1)) / tick_s
        lands = touches & (v["air_s"] > 0)
        v["swing_s"] = xp.where(lands, v["air_s"], v["swing_s"])
        v["slip_m_s"] = xp.where(touches & (v["ground_s"] > 0), moved, 0.0)
        v["air_s"] = xp.where(touches, 0.0, v["air_s"] + tick_s)
        v["ground_s"] = xp.where(touches, v["ground_s"] + tick_s, 0.0)
        v["at_m"] = at
        turn, speed = physics.bind(self.base).xmat.reshape(3, 3), physics.data.qvel
        now = xp.concatenate([(turn.T @ speed[:3])[:2], speed[5:6]])
        v["mean"] = v["mean"] + (tick_s / _SMOOTHED_S) * (now - v["mean"])

    def get_reward(self, physics: Any) -> float:
        del physics
        return 0.0


mj: Any = mujoco

LOADS_KG = (-1.0, 3.0)
"""Smallest and largest load in the base [kg]."""
_CONTACTS, _ROWS_OF_CONSTRAINTS = 16, 96
"""Most contacts, and most rows of constraints, of a copy on Warp."""
_ROWS = 9
"""Number of loads for which constants are computed; between them, constants are interpolated."""
_LOADED = ("body_mass", "body_ipos", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
_LOADED_FIELDS = (*_LOADED, "dof_M0", "actuator_acc0")


class WalkingWorld(ComposedWorld):
    """A robot on the ground.

    A load in the base changes masses, and constants that MuJoCo derives from them. A program that computes these
    constants takes 7 s longer to compile. So the host computes them for a few loads, and the program interpolates.
    """

    floats = True
    _table: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None

    def __init__(self, task: Ground, parameters: Mapping[str, tuple[Any, str]], **options: Any) -> None:
        super().__init__(WORLD, task, ACTUATOR, "q", parameters, **options)
        self._rough = task.rough
        model = self.environment.model
        base = model.body(task.base.full_identifier).id
        kilograms = np.linspace(*LOADS_KG, _ROWS)
        rows = [load_base(model, base, load) for load in kilograms]
        on_warp = stepping.is_warp(self.environment.mjx_model)
        names = [n for n in _LOADED_FIELDS if not on_warp or stepping.varies(n)]
        self._table = {n: (kilograms, np.stack([getattr(row, n) for row in rows])) for n in names}
        actuated = [model.joint(j.full_identifier) for j in task.joints]
        self._qpos = jnp.array([int(j.qposadr[0]) for j in actuated])
        self._qvel = jnp.array([int(j.dofadr[0]) for j in actuated])

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> WorldParams:
        params = super().init_params(rng, graph_state)
        if self._table is None:  # during the base class's constructor
            return params
        armature = jnp.asarray(self.environment.model.dof_armature[np.asarray(self._qvel)], jnp.float32)
        return params.replace(values={**params.values, PAYLOAD: jnp.float32(0.0), ARMATURE: armature})

    def _set(self, physics: MjxPhysics, params: WorldParams) -> None:
        super()._set(physics, params)
        if self._table is None:
            return
        # Constants that MuJoCo derives from an armature only condition its solver, so they stay as compiled.
        armature = physics.mjx_model.dof_armature.at[self._qvel].set(params.values[ARMATURE])
        physics.replace("model", "dof_armature", armature)
        for name, (loads, rows) in self._table.items():
            place = (params.values[PAYLOAD] - loads[0]) / (loads[1] - loads[0])
            low = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, len(loads) - 2)
            table = jnp.asarray(rows, jnp.float32)
            physics.replace("model", name, table[low] + (place - low) * (table[low + 1] - table[low]))

    def output(self, state: State) -> BodyReading:
        data = state.data
        return BodyReading(data.qpos[self._qpos], data.qvel[self._qvel], data.qpos[3:7], data.qvel[3:6])

    def true_state(self, state: State) -> PyTree:
        """Return the part of the state that a value function may observe; heights are above the ground."""
        data, v = state.data, state.variables
        position = data.qpos[2:]
        if self._rough is not None:
            position = position.at[0].add(-self._rough.at(data.qpos[:2]))
        return position, data.qvel, data.actuator_force, v["air_s"], v["ground_s"], v["mean"]

    def velocity(self, state: State) -> jax.Array:
        """Return the velocities of the base: linear ``(3,)`` [m/s], then angular ``(3,)`` [rad/s]."""
        return state.data.qvel[:6]

    def with_velocity(self, state: Any, velocity: jax.Array) -> State:
        """Return the state with other velocities of the base."""
        return state.replace(data=state.data.replace(qvel=state.data.qvel.at[:6].set(velocity)))


def load_base(model: Any, base: int, load_kg: float) -> Any:
    """Return a copy of a model with a load in the middle of a body, and all derived constants."""
    loaded = mj.MjModel(model) if not hasattr(model, "__copy__") else model.__copy__()
    before = float(model.body_mass[base])
    loaded.body_mass[base] = before + load_kg
    loaded.body_ipos[base] = model.body_ipos[base] * before / (before + load_kg)
    mj.mj_setConst(loaded, mj.MjData(loaded))
    return loaded


class WalkingModel(RobotModel):
    """A walking robot on MJX; on a GPU on MuJoCo Warp, which is 20 times as fast with contacts.

    Args:
        rough: Whether the robot walks on its rough ground.
    """

    def __init__(self, robot: ComposedRobot, rough: bool = False) -> None:
        self._robot, self._rough = robot, rough
        self.joints = JointParameters(robot.joints, robot.groups or {"joint": range(len(robot.joints))})

    @cached_property
    def task(self) -> Ground:
        """The composed task; in training only the feet collide with the floor."""
        robot = self._robot
        ground = robot.terrain.growing() if self._rough else None
        return Ground(robot.mjcf, robot.feet, robot.touching_m, robot.feet, ground)

    @property
    def tick_s(self) -> float:
        return float(self.task.control_timestep)

    def dynamics(self) -> list[Parameter]:
        return [*self.parameters_without_joint(), *self.joints.dynamics()]

    def parameters_without_joint(self) -> list[Parameter]:
        """Return the parameters that belong to no joint; legs in the air determine none of them."""
        return [
            Parameter(FRICTION, "1", 0.8, 0.2, 2.0, about="friction of the feet on the ground"),
            Parameter(PAYLOAD, "kg", 0.0, *LOADS_KG, "linear", about="load in the base"),
            Parameter(STRENGTH, "1", 1.0, 0.5, 1.5, about="factor on the motors' gains"),
            Parameter(
                ROUGHNESS, "m", 0.0, 0.0, self._robot.terrain.most_m, "linear", about="height of bumps of the ground"
            ),
        ]

    def for_training(self, values: Mapping[str, float], draws: Mapping[str, np.ndarray]) -> WalkingModel:
        bumps_m = np.asarray(draws.get(ROUGHNESS, values.get(ROUGHNESS, 0.0)))
        if not bumps_m.any():
            return self
        low, high, most_m = float(bumps_m.min()), float(bumps_m.max()), self._robot.terrain.most_m
        if low < 0.0 or high > most_m:
            raise UsageError(
                f"roughness must lie in [0, {most_m:g}] m, got {low:.3g} to {high:.3g}",
                hint="`terrain = Terrain(most_m=0.2)` in the robot's file makes its ground rougher",
            )
        return WalkingModel(self._robot, rough=True)

    def make_world(self, resumed: bool = False) -> WalkingWorld:
        del resumed
        task, on_gpu = self.task, jax.default_backend() == "gpu"
        places = {
            FRICTION: (task.foot_geoms, "friction"),
            "gain": (task.actuators, "gainprm"),
            "bias": (task.actuators, "biasprm"),
            "damping": (task.joints, "damping"),
            "friction": (task.joints, "frictionloss"),
        }
        options = {"impl": "warp", "nconmax": _CONTACTS, "njmax": _ROWS_OF_CONSTRAINTS} if on_gpu else {}
        return WalkingWorld(task, places, **options)

    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> WorldParams:
        """Return the world's parameters for an episode: the base is level and at rest.

        The parameter ``roughness`` selects a place on the rough ground; the base starts above its highest bump.
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
        x_m = self._robot.terrain.start_m(bumps_m) if self.task.rough else 0.0
        base = jnp.array([x_m, 0.0, self._robot.height_m + bumps_m, 1.0, 0.0, 0.0, 0.0], jnp.float32)
        position, velocity = (jnp.asarray(x, jnp.float32) for x in (start.position, start.velocity))
        return WorldParams(placed, jnp.concatenate([base, position]), jnp.concatenate([jnp.zeros(6), velocity]))

    @cached_property
    def _world_params(self) -> WorldParams:
        with jax.ensure_compile_time_eval():  # a cached array must not be a tracer of the function that JAX traces now
            return self.make_world().init_params()
