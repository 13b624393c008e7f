"""The parameters that a simulated robot on legs hides from its policy, and its model with them. Imports no JAX."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

_mj: Any = mujoco


@dataclass(frozen=True)
class HiddenTwin:
    """What a twin differs by; no policy and no training reads it.

    Attributes:
        friction: Of feet and floor.
        load_kg: In the base.
        strength: Factor on the torque of each motor.
        damping, dry, armature: Of each joint, or of all [N m s/rad], [N m], [kg m^2].
        sensing_s: Time from the motion to the observation [s].
        acting_s: Time from the observation to the motors' new target: computation and transport [s].
        bias_rad: Of each encoder.
    """

    friction: float = 0.8
    load_kg: float = 0.0
    strength: np.ndarray = field(default_factory=lambda: np.ones(12))
    damping: float | np.ndarray = 0.1
    dry: float | np.ndarray = 0.2
    sensing_s: float = 0.008
    acting_s: float = 0.011
    bias_rad: np.ndarray = field(default_factory=lambda: np.zeros(12))
    armature: float | np.ndarray = 0.01

    @staticmethod
    def draw(rng: np.random.Generator, joints: int) -> HiddenTwin:
        """Draw a twin from ranges wider than those of training."""
        return HiddenTwin(
            friction=float(rng.uniform(0.4, 1.3)),
            load_kg=float(rng.uniform(-1.0, 3.0)),
            strength=rng.uniform(0.8, 1.2, joints),
            damping=float(rng.uniform(0.02, 0.5)),
            dry=float(rng.uniform(0.05, 0.4)),
            sensing_s=float(rng.uniform(0.004, 0.012)),
            acting_s=float(rng.uniform(0.004, 0.022)),
            bias_rad=rng.uniform(-0.02, 0.02, joints),
            armature=float(rng.uniform(0.006, 0.016)),
        )


def hidden_spec(mjcf: Path, step_s: float) -> Any:
    """Return the editable model of a judge: every geom collides, with elliptic cones and more iterations."""
    spec = _mj.MjSpec.from_file(str(mjcf))
    spec.option.timestep, spec.option.cone = step_s, _mj.mjtCone.mjCONE_ELLIPTIC
    spec.option.iterations, spec.option.ls_iterations = 50, 20
    return spec


def hide(model: Any, base: int, hidden: HiddenTwin) -> None:
    """Set the hidden parameters in a model, and let MuJoCo compute the constants of the load.

    Args:
        base: Number of the body that carries the load; its joints other than the motors' are free, or it has none.
    """
    before, motors = float(model.body_mass[base]), slice(model.nv - model.nu, None)
    model.body_mass[base] = before + hidden.load_kg
    model.body_ipos[base] *= before / (before + hidden.load_kg)
    model.geom_friction[:, 0] = hidden.friction
    model.actuator_gainprm[:, 0] *= hidden.strength
    model.actuator_biasprm[:, 1:3] *= hidden.strength[:, None]
    model.dof_damping[motors], model.dof_frictionloss[motors] = hidden.damping, hidden.dry
    model.dof_armature[motors] = hidden.armature
    _mj.mj_setConst(model, _mj.MjData(model))
