"""A robot on legs in C MuJoCo, and rough ground, for the emulator and for the judgement of policies. Without JAX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from sim2real.arrays import namespace
from sim2real.errors import UsageError
from sim2real.types import Array, Scalar

FLOOR = "floor"
"""The geom of a model that rough ground replaces."""
_BELOW_M = 0.5
"""Depth of the ground below its lowest point [m]."""
_MARGIN_M = 14.0
"""Ground around all starts: how far a robot walks in an episode [m]."""


@dataclass(frozen=True)
class HeightField:
    """Heights of the ground on a grid with its middle at x = y = 0; triangles connect the grid points.

    Attributes:
        heights: Shape ``(rows, columns)``: at each y and x [m]; the lowest is 0.
        cell_m: Distance between grid points [m].
    """

    heights: np.ndarray
    cell_m: float

    @property
    def size(self) -> tuple[float, float, float, float]:
        """MuJoCo's size of a height field: half the lengths in x and y, highest point, and depth below [m]."""
        rows, columns = self.heights.shape
        return (columns - 1) * self.cell_m / 2, (rows - 1) * self.cell_m / 2, float(self.heights.max()), _BELOW_M

    def at(self, place: Array) -> Array:
        """Return the height of the ground below places ``(..., 2)`` [m], shape ``(...)``."""
        xp = namespace(place)
        heights, (rows, columns) = xp.asarray(self.heights, dtype=np.float32), self.heights.shape
        # Find the cell, and the position in it.
        grid = place / self.cell_m + xp.asarray([(columns - 1) / 2, (rows - 1) / 2], dtype=np.float32)
        cell = xp.clip(xp.floor(grid), 0, xp.asarray([columns - 2, rows - 2])).astype(np.int32)
        inside = xp.clip(grid - cell, 0.0, 1.0)
        (c, r), (u, v) = (cell[..., 0], cell[..., 1]), (inside[..., 0], inside[..., 1])
        # MuJoCo cuts a cell into two triangles, along the diagonal from its smallest to its largest x and y.
        low, high = heights[r, c], heights[r + 1, c + 1]
        side = xp.where(u > v, heights[r, c + 1], heights[r + 1, c])
        return low + xp.maximum(u, v) * (side - low) + xp.minimum(u, v) * (high - side)


@dataclass(frozen=True)
class Terrain:
    """Ground of random heights, uniform and independent at the points of a grid.

    All copies of a program share one height field. So its roughness grows along x, and the x at which an episode starts
    sets the episode's roughness.

    Attributes:
        most_m: Difference between the lowest and the highest point of the roughest ground [m].
        cell_m: Distance of the grid's points [m].
        length_m: Length over which the roughness grows from 0 to ``most_m`` [m].
    """

    most_m: float = 0.08
    cell_m: float = 0.1
    length_m: float = 40.0

    def __post_init__(self) -> None:
        if not (self.most_m > 0 and 0 < self.cell_m <= 1 and self.length_m > 0):
            raise UsageError(f"terrain needs a height and lengths above 0 and cells of at most 1 m, got {self}")

    def growing(self) -> HeightField:
        """Return the ground of a training."""
        columns, rows = (1 + round(side / self.cell_m) for side in (self.length_m + 2 * _MARGIN_M, 2 * _MARGIN_M))
        x = (np.arange(columns) - (columns - 1) / 2) * self.cell_m
        return self._field(np.random.default_rng(0), rows, np.clip(x / self.length_m + 0.5, 0.0, 1.0), self.most_m)

    def even(self, roughness_m: float, seed: int, reach_m: float) -> HeightField:
        """Return ground of one roughness, up to ``reach_m`` from the middle in x and y [m]."""
        count = 1 + 2 * round(reach_m / self.cell_m)
        return self._field(np.random.default_rng(seed), count, np.ones(count), roughness_m)

    def start_m(self, roughness_m: Scalar) -> Scalar:
        """Return the x at which the ground of a training has a roughness [m]."""
        return (roughness_m / self.most_m - 0.5) * self.length_m

    def _field(self, rng: np.random.Generator, rows: int, share: np.ndarray, most_m: float) -> HeightField:
        heights = rng.random((rows, len(share))) * share
        # MuJoCo takes heights in the range from 0 to 1.
        heights = (heights - heights.min()) / np.ptp(heights)
        return HeightField((most_m * heights).astype(np.float32), self.cell_m)


_mj: Any = mujoco
_TOUCH_M = 0.03
"""Radius around a foot's site in which contacts belong to the foot [m]; a foot has 0.022 m."""


@dataclass(frozen=True)
class HiddenTwin:
    """The hidden parameters of a body; no policy and no training reads them.

    Attributes:
        friction: Friction of feet and floor.
        load_kg: Load in the base.
        strength: Factor on the torque of each motor.
        damping, dry, armature: Damping, dry friction and armature, of each joint or of all [N m s/rad], [N m], [kg
            m^2].
        sensing_s: Time from the motion to the observation [s].
        acting_s: Time from the observation to the motors' new target: computation and transport [s].
        bias_rad: Bias of each encoder.
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


def measured_dtype(motors: int) -> np.dtype:
    """Return the layout of a body's measurement; every entry is a double.

    Its fields have the names and units of ``LowState``: ``q`` [rad], ``dq`` [rad/s] and ``tau_est`` [N m] of each
    motor, ``quaternion`` (w first), ``gyroscope`` [rad/s], ``accelerometer`` [m/s^2], and ``foot_force`` [N].
    """
    sizes = {"q": motors, "dq": motors, "tau_est": motors, "quaternion": 4, "gyroscope": 3, "accelerometer": 3}
    return np.dtype([(name, np.float64, (size,)) for name, size in {**sizes, "foot_force": 4}.items()])


class LeggedBody:
    """A robot of an MJCF file with hidden parameters; times count from its start.

    Every geom collides, with elliptic cones. The torque of a motor is ``tau + kp (q - position) + kd (dq - velocity)``,
    limited to the actuator's range, times the motor's strength. The motor reports the torque without its strength,
    which it does not know. The bias of its encoder also acts on its controller.

    Args:
        mjcf: The model: one actuator for each joint with a motor, a site ``imu``, and a free joint of the base.
        feet: Sites in the middle of the feet.
        pose: Positions of the joints at the start [rad].
        height_m: Height of the base at the start [m].
        place: ``floor``, or ``stand``: the base is fixed, and the feet are in the air.
        settle_s: Time in which the body comes to rest on the floor, without torque [s].
        ground: Rough ground instead of the model's floor; None: the floor.

    Attributes:
        motors: Number of motors.
        step_s: Time step of the physics [s].
    """

    def __init__(
        self,
        mjcf: Path,
        feet: Sequence[str],
        pose: Sequence[float],
        height_m: float,
        hidden: HiddenTwin,
        place: Literal["floor", "stand"] = "floor",
        *,
        step_s: float = 0.001,
        settle_s: float = 3.0,
        ground: HeightField | None = None,
    ) -> None:
        self.hidden, self.place, self.step_s = hidden, place, step_s
        # The model, with sensors of an IMU and the feet.
        spec = _mj.MjSpec.from_file(str(mjcf))
        option = spec.option
        option.timestep, option.cone = step_s, _mj.mjtCone.mjCONE_ELLIPTIC
        option.iterations, option.ls_iterations = 50, 20
        option.integrator = _mj.mjtIntegrator.mjINT_IMPLICITFAST  # stable with large kd
        free = next(j for j in spec.joints if j.type == _mj.mjtJoint.mjJNT_FREE)
        base = free.parent.name
        if place == "stand":
            free.parent.pos = (0.0, 0.0, 1.0)
            spec.delete(free)
        if ground is not None:
            (rows, columns), share = ground.heights.shape, ground.heights / ground.heights.max()
            spec.add_hfield(name="ground", nrow=rows, ncol=columns, size=ground.size, userdata=share.ravel())
            floor = spec.geom(FLOOR)
            floor.type, floor.hfieldname = _mj.mjtGeom.mjGEOM_HFIELD, "ground"
        for kind in (_mj.mjtSensor.mjSENS_GYRO, _mj.mjtSensor.mjSENS_ACCELEROMETER):
            spec.add_sensor(type=kind, objtype=_mj.mjtObj.mjOBJ_SITE, objname="imu")
        for name in feet:
            spec.site(name).size[0] = _TOUCH_M
            spec.add_sensor(type=_mj.mjtSensor.mjSENS_TOUCH, objtype=_mj.mjtObj.mjOBJ_SITE, objname=name)
        model = self.model = spec.compile()
        self.base, self.motors = model.body(base).id, int(model.nu)
        self._hide(model, hidden)
        # At the start, motors have no torque until the first command.
        data = self.data = _mj.MjData(model)
        self._measured = np.zeros((), measured_dtype(self.motors))
        data.qpos[-self.motors :] = pose
        self.drive(np.zeros((self.motors, 5)))
        if place == "floor":
            data.qpos[:7] = (0, 0, height_m, 1, 0, 0, 0)
            for _ in range(round(settle_s / step_s)):
                _mj.mj_step(model, data)
        _mj.mj_forward(model, data)

    def drive(self, law: np.ndarray) -> None:
        """Set the command of all motors ``(motors, 5)``: q, dq, kp, kd, tau."""
        q, dq, kp, kd, tau = np.asarray(law, np.float64).T
        model, strength = self.model, np.asarray(self.hidden.strength)
        model.actuator_gainprm[:, 0] = strength * kp
        model.actuator_biasprm[:, 0] = strength * (tau + kd * dq)
        model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -strength * kp, -strength * kd
        self.data.ctrl[:] = q - self.hidden.bias_rad

    def step(self) -> None:
        """Integrate one time step."""
        _mj.mj_step(self.model, self.data)

    def measure(self) -> np.ndarray:
        """Return a measurement without noise, of ``measured_dtype`` and shape ``()``."""
        data, measured, n = self.data, self._measured.copy(), self.motors
        measured["q"], measured["dq"] = data.qpos[-n:] + self.hidden.bias_rad, data.qvel[-n:]
        measured["tau_est"] = data.actuator_force / self.hidden.strength
        measured["quaternion"] = data.xquat[self.base]
        measured["gyroscope"] = data.sensordata[:3]
        # MuJoCo computes no acceleration of a body that is fixed to the world.
        measured["accelerometer"] = data.sensordata[3:6] if self.place == "floor" else -self.model.opt.gravity
        measured["foot_force"] = data.sensordata[6:10]
        return measured

    def state(self) -> dict[str, float]:
        """Return the true state: joints, and the base's orientation, height, and rates and velocity in its axes."""
        data, n = self.data, self.motors
        turn = data.xmat[self.base].reshape(3, 3)
        moving = data.qvel[:6] if self.place == "floor" else np.zeros(6)
        fields: Mapping[str, np.ndarray] = {
            "position": data.qpos[-n:],
            "velocity": data.qvel[-n:],
            "quaternion": data.xquat[self.base],
            "gyro": moving[3:],
            "linear": turn.T @ moving[:3],
            "base": data.xpos[self.base],
        }
        return {f"{name}[{i}]": float(x) for name, values in fields.items() for i, x in enumerate(values)}

    def truth(self) -> dict[str, object]:
        """Return the hidden parameters."""
        return {name: np.asarray(value).tolist() for name, value in asdict(self.hidden).items()}

    def _hide(self, model: Any, hidden: HiddenTwin) -> None:
        """Set the hidden parameters, and compute the constants that depend on the load."""
        before, motors, base = float(model.body_mass[self.base]), slice(model.nv - model.nu, None), self.base
        model.body_mass[base] = before + hidden.load_kg
        model.body_ipos[base] *= before / (before + hidden.load_kg)
        model.geom_friction[:, 0] = hidden.friction
        model.dof_damping[motors], model.dof_frictionloss[motors] = hidden.damping, hidden.dry
        model.dof_armature[motors] = hidden.armature
        model.actuator_forcerange *= np.asarray(hidden.strength)[:, None]
        # Friction of joints as stiff as the solver allows: with the defaults they creep.
        model.dof_solref[motors] = (4 * self.step_s, 1.0)
        model.dof_solimp[motors, :3] = (0.999, 0.999, 0.001)
        _mj.mj_setConst(model, _mj.MjData(model))
