"""Friction of motors and gears as a sum of terms.

A term whose coefficient is None is absent and is not computed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real import pytree
from sim2real.graph.base import Base
from sim2real.later import jnp

if TYPE_CHECKING:
    import jax

    from sim2real.graph.base import Value


@pytree.dataclass
class FrictionParams(Base):
    """Coefficients of friction, divided by the joint's inertia; None leaves a term out.

    Attributes:
        viscous: Friction proportional to the speed [1/s].
        drag: Friction proportional to the square of the speed [1/rad].
        coulomb: Friction independent of speed and load [rad/s^2].
        static: Friction at standstill in excess of ``coulomb`` (Stribeck effect, Tustin's form) [rad/s^2].
        stribeck_rad_s: Speed at which the excess has dropped to 1/e of ``static`` [rad/s].
        load: Friction of gears and bearings, as a fraction of the load on them [1].
    """

    viscous: Value | None = None
    drag: Value | None = None
    coulomb: Value | None = None
    static: Value | None = None
    stribeck_rad_s: Value = 0.1
    load: Value | None = None


def damping(p: FrictionParams, velocity: Value) -> Value:
    """Return the friction of the viscous and drag terms divided by the speed [1/s].

    Args:
        velocity: [rad/s].
    """
    terms = [] if p.viscous is None else [p.viscous]
    terms += [] if p.drag is None else [p.drag * jnp.abs(velocity)]
    return sum(terms, start=0.0)


def dry(p: FrictionParams, velocity: Value, load: Value = 0.0) -> Value:
    """Return the largest dry friction: the Coulomb, Stribeck and load-dependent terms [rad/s^2].

    Args:
        velocity: [rad/s].
        load: Load on gears and bearings [rad/s^2]; its sign does not matter.
    """
    terms = [] if p.coulomb is None else [p.coulomb]
    terms += [] if p.static is None else [p.static * jnp.exp(-jnp.abs(velocity) / p.stribeck_rad_s)]
    terms += [] if p.load is None else [p.load * jnp.abs(load)]
    return sum(terms, start=0.0)


def stopped(velocity: Value, most: Value) -> jax.Array:
    """Return the velocity after dry friction: its magnitude is reduced by ``most`` [rad/s], but not below 0.

    Exact for a friction that is constant during the step, for every length of step: the joint sticks without
    chattering or creeping.
    """
    return jnp.sign(velocity) * jnp.maximum(jnp.abs(velocity) - most, 0.0)


def rubbed(velocity: Value, push: Value, most: Value) -> jax.Array:
    """Return the velocity after a step with dry friction [rad/s].

    Exact for forces that are constant during the step: friction opposes the motion until the joint stops; for the rest
    of the step the joint sticks, or moves the other way. If friction opposed the final motion during the whole step,
    each reversal would be late by up to a step.

    Args:
        velocity: Velocity before the step [rad/s].
        push: Change of velocity in the step by the other forces [rad/s].
        most: Largest change of velocity in the step by friction [rad/s].
    """
    moving = velocity != 0.0
    slowed = velocity + push - jnp.sign(velocity) * most
    reverses = moving & (jnp.sign(velocity) * slowed < 0.0)  # compare signs: a product of small speeds would be 0
    rest = jnp.where(reverses, slowed / jnp.where(reverses, slowed - velocity, 1.0), 1.0)  # share of the step
    return jnp.where(moving & ~reverses, slowed, rest * stopped(push, most))
