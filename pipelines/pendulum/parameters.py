"""What can be told from a log of the pendulum, and how it maps onto the model's parameters.

th'' = gain * V + gravity * sin(th) - damping * th' - friction * sign(th'). A log determines these four groups; J, K, R
and the rest appear only in them: the model keeps its nominal J, R and length and takes the groups through the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.robots.loop import DelayParams, delay_parameters

from .model import GRAVITY, PendulumParams, nominal_params


def groups(p: PendulumParams) -> dict[str, Any]:
    """Return the identifiable groups of a parameter set."""
    return {
        "gain": p.K / p.R / p.J,
        "gravity": p.mass * GRAVITY * p.length / p.J,
        "damping": (p.b + p.K**2 / p.R) / p.J,
        "friction": p.c / p.J,
    }


def from_groups(values: Mapping[str, Any], start: Any) -> PendulumParams:
    """Return model parameters with these groups: J, R and length stay nominal, b takes what K leaves of the damping.

    Args:
        values: ``gain`` [rad/s^2/V], ``gravity`` [rad/s^2], ``damping`` [1/s], ``friction`` [rad/s^2].
        start: Shape ``(2,)``: initial angle [rad] and velocity [rad/s].
    """
    p = nominal_params()
    K = values["gain"] * p.R * p.J
    return p.replace(
        K=K,
        mass=values["gravity"] * p.J / (GRAVITY * p.length),
        b=values["damping"] * p.J - K**2 / p.R,
        c=values["friction"] * p.J,
        start=jnp.asarray(start),
    )


def table(max_delay_s: float) -> ParameterTable:
    """Return the parameters to identify: dynamics within a factor of 4 of nominal, and delays.

    Args:
        max_delay_s: Upper bound of each delay [s].
    """
    about = {
        "gain": ("rad/s^2/V", "acceleration per volt, K / (R J)"),
        "gravity": ("rad/s^2", "m g l / J"),
        "damping": ("1/s", "viscous friction and back-EMF, (b + K^2/R) / J"),
        "friction": ("rad/s^2", "Coulomb friction, c / J"),
    }
    dynamics = [
        Parameter(name, about[name][0], float(value), float(value) / 4, float(value) * 4, about=about[name][1])
        for name, value in groups(nominal_params()).items()
    ]
    return ParameterTable([*dynamics, *delay_parameters(max_delay_s)])


def node_params(values: Mapping[str, Any], start: Any) -> dict[str, Any]:
    """Return the parameters of the model's nodes for identified values; delays are in [s]."""
    return {
        "world": from_groups(values, start),
        "sensor": DelayParams(delay=values.get("sensor_delay")),
        "actuator": DelayParams(delay=values.get("actuator_delay")),
    }
