"""Friction of motors and gears, each term a few lines; a term without a coefficient is not there, and costs nothing.

Which terms a robot has is a matter of data: those whose coefficients are numbers.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct

from sim2real.graph.base import Base


@struct.dataclass
class FrictionParams(Base):
    """Coefficients, per unit of inertia: accelerations for a joint in [rad]; None leaves a term out.

    Attributes:
        viscous: Proportional to speed [1/s].
        drag: Proportional to the square of speed [1/rad].
        coulomb: Independent of speed and load [rad/s^2].
        static: What breaking loose takes on top of ``coulomb`` (Stribeck, in Tustin's form) [rad/s^2].
        stribeck_rad_s: Speed at which a share 1/e of that is left [rad/s].
        load: Share of the load that rubs: of gears and bearings [1].
    """

    viscous: Any = None
    drag: Any = None
    coulomb: Any = None
    static: Any = None
    stribeck_rad_s: Any = 0.1
    load: Any = None


def damping(p: FrictionParams, velocity: Any) -> Any:
    """Return the friction proportional to speed, per speed [1/s]: viscous and drag."""
    terms = [] if p.viscous is None else [p.viscous]
    terms += [] if p.drag is None else [p.drag * jnp.abs(velocity)]
    return sum(terms, start=0.0)


def dry(p: FrictionParams, velocity: Any, load: Any = 0.0) -> Any:
    """Return the largest dry friction [rad/s^2]: Coulomb, Stribeck and load-dependent.

    Args:
        p: Coefficients.
        velocity: [rad/s].
        load: What presses the rubbing faces together [rad/s^2]; its sign does not matter.
    """
    terms = [] if p.coulomb is None else [p.coulomb]
    terms += [] if p.static is None else [p.static * jnp.exp(-jnp.abs(velocity) / p.stribeck_rad_s)]
    terms += [] if p.load is None else [p.load * jnp.abs(load)]
    return sum(terms, start=0.0)


def smooth(velocity: Any, width_rad_s: float) -> Any:
    """Return a differentiable sign of the velocity: it creeps where real friction sticks, see ``stopped``."""
    return jnp.tanh(velocity / width_rad_s)


def stopped(velocity: Any, most: Any) -> Any:
    """Return the velocity after dry friction took up to ``most`` of it away, in either direction; it sticks at 0.

    Exact for a friction that is constant over the step, at any step: nothing chatters, and nothing creeps.
    """
    return jnp.sign(velocity) * jnp.maximum(jnp.abs(velocity) - most, 0.0)
