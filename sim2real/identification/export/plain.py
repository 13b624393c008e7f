"""A robot as a simulation in plain MuJoCo: a model, the law of its drives with its equations, and its timing."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sim2real.types import Json, MjSpec

EQUATIONS: Mapping[str, tuple[str, ...]] = {
    "held": ("ctrl = the command's mean over the tick",),
    "setpoint": (
        "goal = the command's mean over the tick; the setpoint starts at the first goal",
        "move = clip(goal - setpoint, -profile_rad_s * timestep, profile_rad_s * timestep)",
        "ctrl = setpoint + move * (1 - 0.5 |move| / (profile_rad_s * timestep)); then setpoint += move",
        "dry friction = frictionloss * exp(-|velocity| / stribeck_rad_s), if there is a stribeck_rad_s",
    ),
    "drive": (
        "torque = clip(kp (goal - zero - angle) + kd (goal_velocity - velocity) + gain (torque + duty), limit)",
        "with torque off: torque = -released kd velocity",
        "kp and gain times 1 + voltage (volts / volts_unit - 1), if the command has volts",
        "damping = max(damping + damping_bias sign(velocity), 0) + drag |velocity| + back_emf",
        "dry friction = frictionloss + static exp(-|velocity| / stribeck_rad_s) + load |torque|",
        "applied torque = -bias - cogging_cos cos(n angle) - cogging_sin sin(n angle), n = cogging_per_turn",
        "an error of the angle within +-play has no torque",
        "the torque by the error of the angle stays within +-top_speed (kd + damping + back_emf), if top_speed < 1e6",
        "the encoder reads angle + zero + eccentric_cos cos(angle) + eccentric_sin sin(angle)",
    ),
}
"""Law of the drives -> its equations, as ``reproduce.py`` has them."""
INTEGRATORS: Mapping[str, tuple[str, ...]] = {
    "mj_step": ("each step is MuJoCo's own (mj_step)",),
    "verlet": (
        "forces, with h = timestep and per inertia, at position + h velocity / 2: push = h (drive - gravity)",
        "moving = velocity (1 - h damping / 2); velocity = rubbed(moving, push, h friction) / (1 + h damping / 2)",
        "rubbed: friction opposes the motion until it stops; then the joint sticks, or moves the other way",
        "position += h (velocity before + velocity) / 2",
    ),
}
"""Integrator -> its equations."""
TIMING = (
    "a command acts command_delay_s + lead_s after it was sent, and as its mean over each tick",
    "a measurement shows the motion measurement_delay_s before its stamp, interpolated between ticks",
    "a measured velocity is qvel + velocity_lead_s qacc",
)


@dataclass(frozen=True)
class PlainSimulation:
    """A robot for a simulation in plain MuJoCo.

    Attributes:
        mjcf: The model with the estimates.
        joints: Joint of each channel.
        tick_s: Time over which a command acts as its mean [s].
        begin: Measured positions and velocities ``(2 * channels,)`` -> ``qpos`` and ``qvel``.
        law: Law of the drives: a name in ``EQUATIONS``.
        numbers: Numbers of that law.
        integrator: A name in ``INTEGRATORS``.
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

    def document(self) -> dict[str, Json]:
        """Return the part of the document that ``reproduce.py`` simulates by; delays and fields are added."""
        numbers: dict[str, Json] = {n: np.asarray(v).tolist() for n, v in self.numbers.items()}
        return {
            "law": self.law,
            "integrator": self.integrator,
            "equations": [*EQUATIONS[self.law], *INTEGRATORS[self.integrator], *TIMING],
            "numbers": numbers,
            "joints": list(self.joints),
            "tick_s": self.tick_s,
            "lead_s": self.lead_s,
            "velocity_lead_s": self.velocity_lead_s,
        }


def converged(spec: MjSpec) -> str:
    """Return a model as MJCF whose solver iterates as often as in an identification on C MuJoCo.

    Args:
        spec: A ``mujoco.MjSpec``; it is changed.
    """
    spec.option.iterations = max(spec.option.iterations, 100)
    spec.option.ls_iterations = max(spec.option.ls_iterations, 50)
    spec.compile()
    return spec.to_xml()
