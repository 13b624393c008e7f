"""A robot from a file as a simulation in plain MuJoCo, for a model card."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import mujoco
import numpy as np

from sim2real.errors import UsageError
from sim2real.identify.export.plain import PlainSimulation, converged
from sim2real.robots.from_model.mjcf import copy_back, driven_spec
from sim2real.types import Json
from sim2real.worlds.drive_terms import DriveTerms
from sim2real.worlds.driven import DrivenWorld, DriveParams

mj: Any = mujoco


def driven_simulation(
    params_of: Callable[[np.ndarray], DriveParams], world: DrivenWorld, how: tuple[Json, ...]
) -> PlainSimulation:
    """Return the driven model with identified values, and the numbers of its drives.

    Args:
        params_of: Measured positions and velocities ``(2 * joints,)`` -> the world's parameters.
        how: Arguments of ``driven_spec``, which begin with path, joints and time step.
    """
    n = len(world.joints)
    params = params_of(np.zeros(2 * n))
    # Set the fields of the model that the values change.
    spec = driven_spec(*how)
    model = spec.compile()
    for name, value in world.fields(params, None).items():
        holder, _, field = name.rpartition(".")
        getattr(model.opt if holder else model, field)[...] = np.asarray(value)
    copy_back(spec, model)
    for joint, number in zip(how[1], world.joints, strict=True):  # MuJoCo's copy_back omits the limits, too
        spec.joint(joint).actfrcrange = model.jnt_actfrcrange[number]
    mjcf = converged(spec)
    made = mj.MjModel.from_xml_string(mjcf)
    for name in world.fields(params, None):
        holder, _, field = name.rpartition(".")
        pair = (getattr(m.opt if holder else m, field) for m in (model, made))
        if not np.allclose(*pair, rtol=1e-4, atol=1e-9):
            raise UsageError(f"MJCF does not keep the identified {name} of this model", hint="export to json")
    # Collect the numbers of the drives.
    numbers = {
        f: np.asarray(getattr(params, f)) + np.zeros(n) for f in ("kp", "kd", "gain", "released", "zero", "voltage")
    }
    numbers |= {
        name: np.array(unit) for name, unit in zip(("kp_unit", "kd_unit", "volts_unit"), world.units, strict=True)
    }
    numbers |= {"joints_at": world.joints, "qpos_at": world.qpos_at, "qvel_at": world.qvel_at}
    if params.terms is not None:
        numbers |= {f.name: np.asarray(getattr(params.terms, f.name)) + np.zeros(n) for f in fields(DriveTerms)}

    def begin(start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        started = params_of(start)
        return np.asarray(started.qpos), np.asarray(started.qvel)

    return PlainSimulation(mjcf, how[1], how[2], begin, "drive", numbers, lead_s=world.lead_s)
