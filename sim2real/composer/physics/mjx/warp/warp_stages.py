"""Steps of MuJoCo Warp with their stages in another order, as functions of JAX; needs Warp.

MJX offers only whole steps of Warp, which compute positions and velocities of the state before the step. Its functions
are generated: a thousand lines hand array after array to Warp, and end in one call, ``mujoco_warp.step(m, d)``. Here
the same functions, of the pinned release, end in another call.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
from collections.abc import Callable
from types import FunctionType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import jax
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src import collision_driver, constraint, sensor, smooth, solver, types
from mujoco.mjx.third_party.mujoco_warp._src import forward as stages
from mujoco.mjx.third_party.mujoco_warp._src.types import Contact, DisableBit, EnableBit
from mujoco.mjx.warp import ffi
from mujoco.mjx.warp import forward as generated

from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics.mjx.stepping import varies

if TYPE_CHECKING:
    from mujoco import mjx

wp: Any = importlib.import_module("warp")  # an extra, which type checkers may not find
Order = Callable[[types.Model, types.Data], None]
"""A function that changes the data of ``mujoco_warp``, given its model."""


@wp.kernel
def _clear(sensors: wp.array[int], addresses: wp.array[int], values: wp.array2d[float]) -> None:  # pyright: ignore[reportInvalidTypeForm]
    """Set the first number of some sensors to 0 in every copy."""
    copy, i = wp.tid()
    values[copy, addresses[sensors[i]]] = 0.0


def _legacy(m: types.Model, d: types.Data) -> None:
    """Advance by a time step; positions and velocities of the new state are computed too (``mj_step2; mj_step1``).

    The data have positions and velocities of the state before. Contacts are not kept from step to step, so they are
    computed first, not last; each stage runs once, as in ``mujoco_warp.step``.
    """
    integrator = mj.mjtIntegrator(m.opt.integrator)
    if _can_sleep(m):
        mujoco_warp.step(m, d)
    elif integrator == mj.mjtIntegrator.mjINT_RK4:
        mujoco_warp.forward(m, d)
        # Stages within the step also compute sensors.
        measured, d.sensordata = d.sensordata, wp.empty_like(d.sensordata)
        stages.rungekutta4(m, d)
        d.sensordata = measured
    else:
        collision_driver.collision(m, d)
        constraint.make_constraint(m, d)
        d.sensordata.zero_()  # touch sensors add to the present value
        _accelerations(m, d)
        (stages.euler if integrator == mj.mjtIntegrator.mjINT_EULER else stages.implicit)(m, d)
    saved = d.cacc, d.cfrc_int  # later stages use these arrays as scratch memory
    if _asks_for_accelerations(m):
        d.cacc, d.cfrc_int = wp.zeros_like(d.cacc), wp.zeros_like(d.cfrc_int)
    _positions_and_velocities(m, d)
    d.cacc, d.cfrc_int = saved


def _accelerations(m: types.Model, d: types.Data) -> None:
    """Compute accelerations from positions, velocities and controls."""
    stages.fwd_actuation(m, d)
    stages.fwd_acceleration(m, d, factorize=True)
    solver.solve(m, d)
    if _asks_for_accelerations(m):
        smooth.rne_postconstraint(m, d)
    sensor.sensor_acc(m, d, skip_rne_postconstraint=True)


def _positions_and_velocities(m: types.Model, d: types.Data) -> None:
    """Compute the quantities of positions and velocities; contacts only if sensors need them."""
    limits = (m.sensor_limitpos_adr, m.sensor_limitvel_adr)
    for sensors in limits:  # these are written only near a limit
        wp.launch(_clear, dim=(d.nworld, sensors.size), inputs=[sensors, m.sensor_adr], outputs=[d.sensordata])
    if m.nsensorcollision or any(s.size for s in (*limits, m.sensor_contact_pos_adr)) or _can_sleep(m):
        stages.fwd_position(m, d, factorize=False)
    else:
        stages.fwd_kinematics(m, d)
        smooth.crb(m, d)
        smooth.tendon_armature(m, d)
        smooth.transmission(m, d)
    sensor.sensor_pos(m, d)
    stages._energy_pos(m, d)
    stages.fwd_velocity(m, d)
    sensor.sensor_vel(m, d)
    stages._energy_vel(m, d)


def _can_sleep(m: types.Model) -> bool:
    return bool(m.opt.enableflags & EnableBit.SLEEP) and not bool(m.opt.disableflags & DisableBit.ISLAND)


def _asks_for_accelerations(m: types.Model) -> bool:
    """Return whether accelerations and forces of bodies are computed."""
    sensors = not m.opt.disableflags & DisableBit.SENSOR and m.sensor_rne_postconstraint
    return bool(m.opt.run_rne_postconstraint or sensors)


def _with_room(order: Order, m: types.Model, d: types.Data) -> None:
    """Run a function with room for the contacts of all copies, in memory that Warp allocates for the call."""
    saved = d.contact, d.naconmax, d.naccdmax
    d.naconmax, d.naccdmax = d.naconmax * d.nworld, d.naccdmax * d.nworld
    new = {}
    for field in dataclasses.fields(Contact):
        old = getattr(d.contact, field.name)
        unused = field.name in ("flex", "elem", "vert") and not m.nflex
        new[field.name] = wp.empty((0 if unused else d.naconmax, *old.shape[1:]), dtype=old.dtype)
    d.contact = Contact(**new)
    order(m, d)
    d.contact, d.naconmax, d.naccdmax = saved


def _function(name: str, order: Order) -> Callable[[mjx.Model, mjx.Data], mjx.Data]:
    """Return MJX's function of model and data, for ``vmap`` and ``jit``, with another function of Warp in it.

    Sizes of contacts in the data are for one copy; the arrays of contacts are empty.
    """
    room = functools.partial(_with_room, order)
    shim = getattr(generated, f"_{name}_shim").__wrapped__
    shim = ffi.format_args_for_warp(_in(shim, mjwarp=SimpleNamespace(**{name: room})))
    implementation = _in(getattr(generated, f"_{name}_jax_impl"), **{f"_{name}_shim": shim})
    call = jax.custom_batching.custom_vmap(ffi.marshal_jax_warp_callable(implementation))
    batched = ffi.marshal_custom_vmap(lambda size, is_batched, m, d: (call(m, d), is_batched[1]))
    call.def_vmap(lambda size, is_batched, m, d: batched(size, is_batched, _once(m, is_batched[0]), d))
    return call


def _once(model: mjx.Model, is_batched: mjx.Model) -> mjx.Model:
    """Return a model of many copies with a single copy of the fields that Warp takes once, despite ``vmap``."""

    def of_first(path: tuple[object, ...], leaf: jax.Array, is_many: bool) -> jax.Array:
        names = [getattr(step, "name", "") for step in path]  # '' for the parts of a common tuple of arrays
        varied = all(names) and varies(".".join(name for name in names if name != "_impl"))
        return leaf if varied or not is_many else leaf[0]

    return jax.tree_util.tree_map_with_path(of_first, model, is_batched)


def _in(source: FunctionType, **names: object) -> FunctionType:
    """Return a copy of a function with other values for some global names."""
    new = FunctionType(source.__code__, {**source.__globals__, **names}, source.__name__, source.__defaults__)
    new.__annotations__ = source.__annotations__
    return new


step = _function("step", mujoco_warp.step)
"""``mjx.step``, whose contacts Warp keeps."""
legacy_step = _function("step", _legacy)
"""A step that ends with positions and velocities of the new state; the input has those of the state before."""
forward = _function("forward", mujoco_warp.forward)
"""``mjx.forward``, whose contacts Warp keeps."""
