"""A payload that each log names: a mass on a body of a robot from a file."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.types import MjModel, MjSpec, PyTree, Scalar
from sim2real.worlds.driven import DriveCommand, DriveParams

BODY = "sim2real_payload"
UNITS = {"payload": "kg", "payload_reach": "m"}
"""Fields of a log's commands: the mass, and its distance from the origin of the body that holds it."""
_NO_MASS = 1e-9


def hold(spec: MjSpec, model: MjModel, joints: Sequence[str], holder: str) -> None:
    """Add the payload to a model, without mass; its mass and its place are set for each log.

    Args:
        holder: Body that holds it, at its centre of mass; "": that of the last joint.
    """
    names = [model.body(i).name for i in range(1, model.nbody)]
    if holder and holder not in names:
        raise UsageError(f"no body {holder!r} for the payload. Available: {', '.join(filter(None, names))}")
    body: Any = spec.body(holder) if holder else spec.joint(joints[-1]).parent
    middle = model.body_ipos[model.body(holder).id if holder else model.jnt_bodyid[model.joint(joints[-1]).id]]
    if not np.any(middle):
        raise UsageError(
            f"the centre of mass of body {body.name!r} is at its origin, so a payload has no direction from there",
            hint="give the body an inertial, or name another one with --payload-body",
        )
    payload = body.add_body(name=BODY, pos=middle)
    payload.explicitinertial, payload.mass, payload.inertia = True, _NO_MASS, [_NO_MASS] * 3
    payload.ipos, payload.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]  # not the holder's, as a new body has


def check(sent: Mapping[str, np.ndarray], commands: Collection[str]) -> None:
    """Raise an error if the payload changes within a log, or is no mass.

    Args:
        sent: The log's commands by field.
        commands: Fields that the robot reads.
    """
    for field in (f for f in UNITS if f in sent and f in commands):
        values = np.unique(sent[field])
        if len(values) > 1 or not np.all(values >= 0.0):
            listed = ", ".join(f"{v:g}" for v in values[:4])
            raise Sim2RealError(
                f"{field} is {listed} {UNITS[field]}: a log has one payload, of 0 or more",
                hint="cut the log where the payload changes, or remove the field from the mapping",
            )


def holding(model: MjModel, sent: Mapping[str, np.ndarray], commands: Collection[str]) -> MjModel:
    """Return a model with the payload of a log; the arguments are those of ``check``."""
    model = copy.copy(model)
    if "payload" in commands:
        model.body(BODY).mass[:] += sent["payload"][0, 0]
    if "payload_reach" in commands:
        model.body(BODY).pos[:] = _place(model, sent["payload_reach"][0, 0])
    return model


def loaded(model: MjModel, world: DriveParams, command: DriveCommand) -> DriveParams:
    """Return a world's parameters with the payload of a command."""
    if command.payload is None:
        return world
    fields, at = world.model, model.body(BODY).id
    changed: dict[str, PyTree] = {"body_mass": jnp.asarray(fields.body_mass).at[at].add(jnp.ravel(command.payload)[0])}
    if command.payload_reach is not None:
        changed["body_pos"] = (
            jnp.asarray(fields.body_pos).at[at].set(_place(model, jnp.ravel(command.payload_reach)[0]))
        )
    return world.replace(model=fields.tree_replace(changed))


def _place(model: MjModel, reach: Scalar) -> PyTree:
    """Return where a payload is in the frame of its body, ``(3,)`` [m]."""
    middle = model.body(BODY).pos
    return reach * middle / np.linalg.norm(middle)
