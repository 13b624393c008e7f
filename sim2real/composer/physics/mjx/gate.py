"""Refuses, before anything is compiled, what MJX would ignore or compute differently."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mujoco import mjx

from sim2real.composer.mjcf.schema import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjModel

_INTEGRATORS = (mj.mjtIntegrator.mjINT_EULER, mj.mjtIntegrator.mjINT_RK4, mj.mjtIntegrator.mjINT_IMPLICITFAST)
_PASSIVE = (mj.mjtDisableBit.mjDSBL_SPRING, mj.mjtDisableBit.mjDSBL_DAMPER)


def check_model(model: MjModel) -> None:
    """Refuse a compiled model that MJX would simulate differently; UsageError with the option or the elements."""
    if int(model.opt.noslip_iterations) > 0:
        raise UsageError(
            f"MJX has no no-slip solver: option noslip_iterations is {model.opt.noslip_iterations}",
            hint="set it to 0 in the model that sets it",
        )
    # MJX switches springs and dampers together.
    passive = [int(model.opt.disableflags) & int(flag) != 0 for flag in _PASSIVE]
    if any(passive) and not all(passive):
        raise UsageError(
            "MJX leaves out both springs and dampers if one of them is disabled",
            hint="disable both, or neither and set stiffness or damping to 0",
        )
    # MJX has no history of controls and sensor data.
    for kind, count in (("actuator", model.nactuator), ("sensor", model.nsensor)):
        object_type = getattr(mj.mjtObj, f"mjOBJ_{kind.upper()}")
        adr = getattr(model, f"{kind}_historyadr", None)
        late = [] if adr is None else [mj.mj_id2name(model, object_type, i) for i in range(count) if adr[i] >= 0]
        if late:
            raise UsageError(
                f"MJX ignores MuJoCo's own delays and intervals: {kind} {', '.join(map(repr, late))}",
                hint="remove delay, nsample and interval from the MJCF; delay the observable or the connection instead",
            )
    if model.opt.integrator not in _INTEGRATORS:
        raise UsageError(
            f"MJX has no integrator {mj.mjtIntegrator(model.opt.integrator).name}",
            hint="use Euler, RK4 or implicitfast",
        )


def settle_cone(model: MjModel) -> None:
    """Make friction cones pyramidal in models without contacts; refuse cones that MJX lacks.

    With elliptic cones, the default of arenas, MJX 3.17 fails on models that have constraints but no contacts.
    """
    if model.opt.cone != mj.mjtCone.mjCONE_ELLIPTIC:
        return
    model.opt.cone = mj.mjtCone.mjCONE_PYRAMIDAL
    data: Any = mjx.make_data(model, impl="jax")
    if data._impl.ncon == 0:
        return
    if (data._impl.contact.dim == 1).any():
        smooth = (model.geom_condim == 1) & ((model.geom_contype | model.geom_conaffinity) != 0)
        names = [mj.mj_id2name(model, mj.mjtObj.mjOBJ_GEOM, i) for i in smooth.nonzero()[0]]
        raise UsageError(
            f"MJX has no contacts of condim 1 with elliptic friction cones: geoms {', '.join(map(repr, names))}",
            hint='give them condim 3, or set option cone to "pyramidal"',
        )
    model.opt.cone = mj.mjtCone.mjCONE_ELLIPTIC
