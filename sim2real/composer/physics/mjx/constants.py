"""Computes the constants that MuJoCo derives from a model (``mj_setConst``) inside a program."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from sim2real.arrays import multiply_quaternions, rotate
from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics.mjx.import_mjx import held_links
from sim2real.composer.physics.mjx.stepping import is_warp, varies
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjModel
    from sim2real.types import PyTree

_WIDTHS = {
    int(mj.mjtJoint.mjJNT_FREE): (3, 3),
    int(mj.mjtJoint.mjJNT_BALL): (3,),
    int(mj.mjtJoint.mjJNT_SLIDE): (1,),
    int(mj.mjtJoint.mjJNT_HINGE): (1,),
}
"""Sizes of groups of a joint's degrees of freedom that share a mean inverse inertia."""
_ONLY_SLIDES = 2
"""``body_simple`` of bodies that only slide along axes of the world; MuJoCo takes their mass for their inertia."""
_IS_DERIVED = 11
"""Index of the number in a weld's data that tells whether its pose is the one at the reference position."""


def derived(host: MjModel, model: mjx.Model) -> frozenset[str]:
    """Return the names of the fields that ``derive`` computes, without tracing it, which takes seconds.

    Raises:
        UsageError: As ``derive`` does.
    """
    if is_warp(model):
        return frozenset(n for n in (*derived(host, _twin(host, model)), "geom_aabb") if varies(n))
    names = ["body_subtreemass", "geom_rbound"]
    if host.nv:
        names += ["dof_M0", "dof_invweight0", "body_invweight0"]
        names += ["actuator_acc0"] * (host.nu > 0) + ["tendon_invweight0"] * (host.ntendon > 0)
    if host.ntendon:
        names += ["tendon_length0"]
    if np.any(_derived_equalities(host)):
        names += ["eq_data"]
    return frozenset([*names, "cam_pos0", "cam_poscom0", "cam_mat0"] if host.ncam else names)


def derive(host: MjModel, model: mjx.Model) -> dict[str, jax.Array]:
    """Return the constants of an ``mjx.Model`` whose masses, inertias, lengths or poses were changed: path -> array.

    Raises:
        UsageError: On Warp, if MJX in JAX does not support the model.
    """
    if is_warp(model):
        constants = derive(host, _twin(host, model)) | {"geom_aabb": _boxes(host, model)}
        return {name: value for name, value in constants.items() if varies(name)}
    data = _at_reference(model, mjx.make_data(host, impl="jax"))
    constants = {"body_subtreemass": _subtree_masses(host, model), "geom_rbound": _radii(host, model)}
    if host.nv:
        constants |= _inverse_weights(host, model, data)
    if host.ntendon:
        constants["tendon_length0"] = data.ten_length
    if np.any(_derived_equalities(host)):
        constants["eq_data"] = _equalities(host, model, data)
    return constants | _cameras(host, model, data) if host.ncam else constants


@jax.jit
def _at_reference(model: mjx.Model, data: PyTree) -> mjx.Data:
    """Return the data at the reference position; traced once for all programs with a model of this form."""
    with held_links():
        data = mjx.com_pos(model, mjx.kinematics(model, data.replace(qpos=model.qpos0)))
    return mjx.transmission(model, mjx.crb(model, mjx.tendon(model, mjx.camlight(model, data))))


def _twin(host: MjModel, model: mjx.Model) -> mjx.Model:
    """Convert a model of Warp to one of MJX in JAX, which computes the constants."""
    try:
        twin: PyTree = mjx.put_model(host, impl="jax")
    except NotImplementedError as error:
        raise UsageError(
            f"MJX in JAX computes constants of masses and lengths, and refuses this model: {error}",
            hint="set them in initialize_episode_mjcf",
        ) from error
    names = [name for name in twin.__dataclass_fields__ if varies(name)]
    both = {n: (getattr(model, n), getattr(twin, n)) for n in names}
    return twin.tree_replace({n: a.astype(b.dtype) for n, (a, b) in both.items() if jnp.shape(a) == jnp.shape(b)})


def _subtree_masses(host: MjModel, model: mjx.Model) -> jax.Array:
    below = np.eye(host.nbody)  # below[i, j]: body j is in the subtree of body i
    for body in range(host.nbody - 1, 0, -1):
        below[host.body_parentid[body]] += below[body]
    return jnp.asarray(below, model.body_mass.dtype) @ model.body_mass


def _inverse_weights(host: MjModel, model: mjx.Model, data: mjx.Data) -> dict[str, jax.Array]:
    """Return the inverse inertias of bodies, degrees of freedom and tendons for constraints: ``A M^-1 A^T``."""
    impl: PyTree = data._impl
    # Invert the matrix of inertia.
    M, J = _inertia_and_jacobians(model, data)
    factor = jax.scipy.linalg.cho_factor(M)
    inverse = jax.scipy.linalg.cho_solve(factor, jnp.eye(host.nv, dtype=M.dtype))
    diagonal = jnp.diag(inverse)
    # Average over the degrees of freedom of a joint, and over the axes of a body.
    dofs = []
    for kind in host.jnt_type:
        for width in _WIDTHS[int(kind)]:
            start = len(dofs)
            dofs += [jnp.mean(diagonal[start : start + width])] * width
    spatial = jnp.einsum("bvi,vw,bwi->bi", J, inverse, J)
    weights = jnp.where((host.body_weldid != 0)[:, None], spatial.reshape(-1, 2, 3).mean(axis=-1), 0.0)
    # For bodies that only slide, the mass replaces the inertia.
    simple, mass = np.asarray(host.body_simple) == _ONLY_SLIDES, jnp.maximum(model.body_mass, mj.mjMINVAL)
    constants = {
        "dof_M0": jnp.diag(M),
        "dof_invweight0": jnp.where(simple[host.dof_bodyid], 1.0 / mass[host.dof_bodyid], jnp.stack(dofs)),
        "body_invweight0": jnp.where(simple[:, None], jnp.stack([1.0 / mass, 0.0 * mass], axis=1), weights),
    }
    if host.nu:
        constants["actuator_acc0"] = jnp.linalg.norm(impl.actuator_moment @ inverse, axis=1)
    if host.ntendon:
        constants["tendon_invweight0"] = jnp.einsum("ti,ij,tj->t", impl.ten_J, inverse, impl.ten_J)
    return constants


@jax.jit
def _inertia_and_jacobians(model: mjx.Model, data: mjx.Data) -> tuple[jax.Array, jax.Array]:
    """Return the matrix of inertia ``(nv, nv)``, and the bodies' Jacobians at their centres ``(nbody, nv, 6)``."""
    bodies = jnp.arange(data.xipos.shape[0])
    jacobians = jax.vmap(lambda point, body: mjx.jac(model, data, point, body))(data.xipos, bodies)
    return mjx.full_m(model, data), jnp.concatenate(jacobians, axis=-1)


def _radii(host: MjModel, model: mjx.Model) -> jax.Array:
    """Return the radii of spheres around the geoms; for geoms such as meshes, the compiled radius."""
    size, kind, types = model.geom_size, np.asarray(host.geom_type), mj.mjtGeom
    radii = {
        types.mjGEOM_SPHERE: size[:, 0],
        types.mjGEOM_CAPSULE: size[:, 0] + size[:, 1],
        types.mjGEOM_ELLIPSOID: size.max(axis=1),
        types.mjGEOM_CYLINDER: jnp.linalg.norm(size[:, :2], axis=1),
        types.mjGEOM_BOX: jnp.linalg.norm(size, axis=1),
    }
    bounds = model.geom_rbound
    for geom, radius in radii.items():
        bounds = jnp.where(kind == int(geom), radius, bounds)
    return bounds


def _boxes(host: MjModel, model: mjx.Model) -> jax.Array:
    """Return centres and half sizes of boxes around the geoms, shape ``(ngeom, 2, 3)``, for Warp's first test."""
    x, y, z = model.geom_size.T
    kind, types = np.asarray(host.geom_type)[:, None], mj.mjtGeom
    halves = {
        types.mjGEOM_SPHERE: (x, x, x),
        types.mjGEOM_CAPSULE: (x, x, x + y),
        types.mjGEOM_ELLIPSOID: (x, y, z),
        types.mjGEOM_CYLINDER: (x, x, y),
        types.mjGEOM_BOX: (x, y, z),
    }
    sizes = model.geom_aabb[:, 1]
    for geom, half in halves.items():
        sizes = jnp.where(kind == int(geom), jnp.stack(half, axis=1), sizes)
    return model.geom_aabb.at[:, 1].set(sizes)


def _derived_equalities(host: MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return masks of the connects, and of the welds, that take their poses from the reference position."""
    bodies = np.asarray(host.eq_objtype) == int(mj.mjtObj.mjOBJ_BODY)
    connects = bodies & (np.asarray(host.eq_type) == int(mj.mjtEq.mjEQ_CONNECT))
    welds = bodies & (np.asarray(host.eq_type) == int(mj.mjtEq.mjEQ_WELD))
    return connects, welds & (host.eq_data[:, _IS_DERIVED] == 1)


def _equalities(host: MjModel, model: mjx.Model, data: mjx.Data) -> jax.Array:
    """Return the data of equalities, with anchors and poses of bodies at the reference position."""
    connects, welds = (jnp.asarray(rows)[:, None] for rows in _derived_equalities(host))
    anchor, one, two = model.eq_data[:, :3], host.eq_obj1id, host.eq_obj2id

    def in_other(here: np.ndarray, there: np.ndarray) -> jax.Array:  # the anchor in one body, in the axes of the other
        place = data.xpos[here] + jnp.einsum("eij,ej->ei", data.xmat[here], anchor)
        return jnp.einsum("eji,ej->ei", data.xmat[there], place - data.xpos[there])

    turn = jax.vmap(multiply_quaternions)(data.xquat[one] * np.array([1.0, -1, -1, -1]), data.xquat[two])
    connected = model.eq_data.at[:, 3:6].set(in_other(one, two))
    welded = model.eq_data.at[:, 3:6].set(in_other(two, one)).at[:, 6:10].set(turn)
    return jnp.where(connects, connected, jnp.where(welds, welded, model.eq_data))


def _cameras(host: MjModel, model: mjx.Model, data: mjx.Data) -> dict[str, jax.Array]:
    """Return the poses of cameras relative to their bodies at the reference position, as if all were fixed to them."""
    body = host.cam_bodyid
    offset = jnp.einsum("cij,cj->ci", data.xmat[body], model.cam_pos)
    target = np.where(host.cam_targetbodyid >= 0, host.cam_targetbodyid, body)
    axes = jax.vmap(lambda q: jax.vmap(lambda v: rotate(v, q))(jnp.eye(3, dtype=q.dtype)).T)(model.cam_quat)
    poses = {"cam_pos0": offset, "cam_poscom0": data.xpos[body] + offset - data.subtree_com[target]}
    return {**poses, "cam_mat0": data.xmat[body] @ axes}
