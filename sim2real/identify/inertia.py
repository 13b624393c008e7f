"""Inertial parameters of a body as an unbounded vector: the log-Cholesky factor of its pseudo-inertia.

Every vector is a physically consistent body, with positive mass and density everywhere (Rucker and Wensing, "Smooth
Parameterization of Rigid-Body Inertia", RA-L 2022).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.identify.parameters import Parameter
from sim2real.types import PyTree

THETA = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")
"""Names of the ten entries, in order."""
_APART = 1e-4
"""Smallest difference between principal moments, as a share of the inertia."""


def from_log_cholesky(theta: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return mass [kg], centre of mass ``(3,)`` [m] and inertia about it ``(3, 3)`` [kg m^2].

    Args:
        theta: Shape ``(10,)``: see ``THETA``.
    """
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = theta
    zero, one = jnp.zeros_like(alpha), jnp.ones_like(alpha)
    # Build the upper triangular factor U of the pseudo-inertia J = U U'.
    rows = [
        [jnp.exp(d1), s12, s13, t1],
        [zero, jnp.exp(d2), s23, t2],
        [zero, zero, jnp.exp(d3), t3],
        [zero, zero, zero, one],
    ]
    U = jnp.exp(alpha) * jnp.stack([jnp.stack(r) for r in rows])
    J = U @ U.T
    # Read mass, first moment and second moments off J.
    mass, moment, sigma = J[3, 3], J[:3, 3], J[:3, :3]
    com = moment / mass
    about_origin = jnp.trace(sigma) * jnp.eye(3) - sigma
    return mass, com, about_origin - mass * (com @ com * jnp.eye(3) - jnp.outer(com, com))


def to_log_cholesky(mass: float, com: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return the vector ``(10,)`` of a body: the inverse of ``from_log_cholesky``.

    Args:
        mass: [kg].
        com: Centre of mass, ``(3,)`` [m].
        inertia: About the centre of mass, ``(3, 3)`` [kg m^2].

    Raises:
        UsageError: When no body has this inertia: one principal moment is at least the sum of the two others.
    """
    # Build the pseudo-inertia J.
    com, inertia = np.asarray(com, np.float64), np.asarray(inertia, np.float64)
    about_origin = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))
    sigma = 0.5 * np.trace(about_origin) * np.eye(3) - about_origin
    J = np.block([[sigma, mass * com[:, None]], [mass * com[None], np.array([[mass]])]])
    # The factor is upper triangular: a Cholesky factor of the matrix turned round, turned back.
    try:
        U = np.linalg.cholesky(J[::-1, ::-1])[::-1, ::-1]
    except np.linalg.LinAlgError:
        moments = ", ".join(f"{m:.4g}" for m in np.linalg.eigvalsh(inertia))
        raise UsageError(
            f"no body of {mass:.4g} kg has the principal moments {moments} kg m^2",
            hint="mass must be positive, and each moment smaller than the sum of the two others",
        ) from None
    alpha = np.log(U[3, 3])
    U = U / U[3, 3]
    d = np.log(np.diag(U)[:3])
    return np.array([alpha, *d, U[0, 1], U[1, 2], U[0, 2], *U[:3, 3]])


def inertia_parameters(body: str, mass: float, com: np.ndarray, inertia: np.ndarray, reach: float) -> list[Parameter]:
    """Return the ten parameters of a body, named ``BODY_alpha`` and so on, around its nominal inertia.

    Args:
        mass: [kg].
        com: Centre of mass, ``(3,)`` [m].
        inertia: About the centre of mass, ``(3, 3)`` [kg m^2].
        reach: Largest change of each entry; 0.7 is a factor of about two in size and four in mass.
    """
    theta = to_log_cholesky(mass, com, inertia)
    return [
        Parameter(f"{body}_{name}", "1", float(t), float(t) - reach, float(t) + reach, "linear", about="log-Cholesky")
        for name, t in zip(THETA, theta, strict=True)
    ]


def set_inertia(model: PyTree, body: int, theta: jax.Array) -> PyTree:
    """Return an ``mjx.Model`` in which one body has another inertia, along its principal axes.

    ``invweight0``, which MuJoCo's compiler derives from inertias for its constraints, does not change.

    Args:
        theta: Shape ``(10,)``: see ``THETA``.
    """
    mass, com, inertia = from_log_cholesky(theta)
    # Equal moments, as of a cylinder, leave the axes undefined, and without a derivative.
    apart = _APART * jnp.trace(inertia) / 3.0 * jnp.diag(jnp.array([-1.0, 0.0, 1.0]))
    moments, axes = jnp.linalg.eigh(inertia + apart)
    axes = axes * jnp.where(jnp.linalg.det(axes) < 0, -1.0, 1.0)  # a rotation
    return model.replace(
        body_mass=model.body_mass.at[body].set(mass),
        body_ipos=model.body_ipos.at[body].set(com),
        body_inertia=model.body_inertia.at[body].set(moments),
        body_iquat=model.body_iquat.at[body].set(_quaternion(axes)),
    )


def _quaternion(R: jax.Array) -> jax.Array:
    """Return the unit quaternion (w, x, y, z) of a rotation: the largest of the four forms, so none divides by zero."""
    m = R
    forms = jnp.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    q = forms[jnp.argmax(jnp.diagonal(forms))]
    return q / jnp.linalg.norm(q)
