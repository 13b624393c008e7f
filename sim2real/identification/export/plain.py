"""A robot as a simulation in plain MuJoCo: a model, the law of its drives, and its timing."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sim2real.types import MjSpec


@dataclass(frozen=True)
class PlainSimulation:
    """A robot for a simulation in plain MuJoCo.

    Attributes:
        mjcf: The model with the estimates.
        joints: Joint of each channel.
        tick_s: Time over which a command acts as its mean [s].
        begin: Measured positions and velocities ``(2 * channels,)`` -> ``qpos`` and ``qvel``.
        law: Law of the drives, a function in ``reproduce.py``.
        numbers: Numbers of that law.
        integrator: MuJoCo's own, or the function ``verlet`` in ``reproduce.py``.
        lead_s: Time that is added to the delay of commands, as MuJoCo moves joints half a step early [s].
        velocity_lead_s: Time over which velocities are extrapolated [s].
    """

    mjcf: str
    joints: tuple[str, ...]
    tick_s: float
    begin: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    law: Literal["held", "setpoint", "drive"] = "held"
    numbers: Mapping[str, np.ndarray] = field(default_factory=dict)
    integrator: Literal["mj_step", "verlet"] = "mj_step"
    lead_s: float = 0.0
    velocity_lead_s: float = 0.0


def converged(spec: MjSpec) -> str:
    """Return a model as MJCF whose solver iterates as often as in an identification on C MuJoCo.

    Args:
        spec: A ``mujoco.MjSpec``; it is changed.
    """
    spec.option.iterations = max(spec.option.iterations, 100)
    spec.option.ls_iterations = max(spec.option.ls_iterations, 50)
    spec.compile()
    return spec.to_xml()
