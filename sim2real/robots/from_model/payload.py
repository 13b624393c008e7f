"""A payload that each log names: a mass on a body of a robot from a file."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.types import MjModel, MjSpec
from sim2real.worlds.driven import PAYLOAD, payload_place

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
    payload = body.add_body(name=PAYLOAD, pos=middle)
    payload.explicitinertial, payload.mass, payload.inertia = True, _NO_MASS, [_NO_MASS] * 3
    payload.ipos, payload.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]  # not the holder's, as a new body has


def holding(model: MjModel, sent: Mapping[str, np.ndarray]) -> MjModel:
    """Return a model with the payload of a log, if it holds one.

    Args:
        sent: The log's commands by field.
    """
    if all(model.body(i).name != PAYLOAD for i in range(model.nbody)):
        return model
    model = copy.copy(model)
    model.body(PAYLOAD).mass[:] += sent["payload"][0, 0]
    if "payload_reach" in sent:
        model.body(PAYLOAD).pos[:] = payload_place(model, sent["payload_reach"][0, 0])
    return model
