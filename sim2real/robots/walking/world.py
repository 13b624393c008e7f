"""The world of a walking robot: a composed task whose message is what encoders and IMU measure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from sim2real.composer.physics.mjx import stepping
from sim2real.graph.base import GraphState
from sim2real.robots.loop import ACTUATOR, WORLD
from sim2real.robots.walking.messages import BodyReading
from sim2real.robots.walking.scene import Ground
from sim2real.worlds.composed import ComposedWorld, WorldParams

if TYPE_CHECKING:
    from sim2real.composer.mjx_environment import State
    from sim2real.composer.physics.mjx.physics import MjxPhysics

mj: Any = mujoco

PAYLOAD, ARMATURE = "payload", "armature"
_ROWS = 9
"""Loads that the table of models has; between them the constants are interpolated."""
_LOADED = ("body_mass", "body_ipos", "body_inertia", "body_subtreemass", "body_invweight0", "dof_invweight0")
_LOADED_FIELDS = (*_LOADED, "dof_M0", "actuator_acc0")


class WalkingWorld(ComposedWorld):
    """A robot on the ground.

    A load in the base changes masses, and constants that MuJoCo derives from them. A program that computes them takes
    7 s longer to compile. So the host computes them for a few loads, and the program interpolates.

    Args:
        loads: Smallest and largest load in the base [kg].
    """

    floats: Literal[True] = True
    _table: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None

    def __init__(
        self, task: Ground, parameters: Mapping[str, tuple[Any, str]], loads: tuple[float, float], **options: Any
    ) -> None:
        super().__init__(WORLD, task, ACTUATOR, "q", parameters, **options)
        model = self.environment.model
        base = model.body(task.base.full_identifier).id
        kilograms = np.linspace(*loads, _ROWS)
        rows = [load_base(model, base, load) for load in kilograms]
        on_warp = stepping.is_warp(self.environment.mjx_model)
        names = [n for n in _LOADED_FIELDS if not on_warp or stepping.varies(n)]
        self._table = {n: (kilograms, np.stack([getattr(row, n) for row in rows])) for n in names}
        actuated = [model.joint(j.full_identifier) for j in task.joints]
        self._qpos = jnp.array([int(j.qposadr[0]) for j in actuated])
        self._qvel = jnp.array([int(j.dofadr[0]) for j in actuated])

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> WorldParams:
        """Return the parameters' compiled values, and no load."""
        params = super().init_params(rng, graph_state)
        if self._table is None:  # while it is made
            return params
        armature = jnp.asarray(self.environment.model.dof_armature[np.asarray(self._qvel)], jnp.float32)
        return params.replace(values={**params.values, PAYLOAD: jnp.float32(0.0), ARMATURE: armature})

    def _set(self, physics: MjxPhysics, params: WorldParams) -> None:
        super()._set(physics, params)
        if self._table is None:
            return
        # MuJoCo's constants that follow from an armature only condition its solver, so they stay as compiled.
        armature = physics.mjx_model.dof_armature.at[self._qvel].set(params.values[ARMATURE])
        physics.replace("model", "dof_armature", armature)
        for name, (loads, rows) in self._table.items():
            place = (params.values[PAYLOAD] - loads[0]) / (loads[1] - loads[0])
            low = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, len(loads) - 2)
            table = jnp.asarray(rows, jnp.float32)
            physics.replace("model", name, table[low] + (place - low) * (table[low + 1] - table[low]))

    def output(self, state: State) -> BodyReading:
        """Return what encoders and IMU measure."""
        data = state.data
        return BodyReading(data.qpos[self._qpos], data.qvel[self._qvel], data.qpos[3:7], data.qvel[3:6])

    def velocity(self, state: State) -> jax.Array:
        """Return the velocities of the base: linear ``(3,)`` [m/s], then angular ``(3,)`` [rad/s]."""
        return state.data.qvel[:6]

    def with_velocity(self, state: Any, velocity: jax.Array) -> State:
        """Return the state with other velocities of the base."""
        return state.replace(data=state.data.replace(qvel=state.data.qvel.at[:6].set(velocity)))


def load_base(model: Any, base: int, load_kg: float) -> Any:
    """Return a copy of a model with a load in the middle of a body; MuJoCo computes what follows."""
    loaded = mj.MjModel(model) if not hasattr(model, "__copy__") else model.__copy__()
    before = float(model.body_mass[base])
    loaded.body_mass[base] = before + load_kg
    loaded.body_ipos[base] = model.body_ipos[base] * before / (before + load_kg)
    mj.mj_setConst(loaded, mj.MjData(loaded))
    return loaded
