"""MuJoCo's joints in the league: mujoco.sysid plain, with a delay and more terms, and PACE's form.

All three simulate the same models with the toolbox's own residuals; parameters and optimisers differ. mujoco.sysid: its
default optimiser from a guess, then from random places until the time is over. PACE (F.
Bjelonic et al., "Towards Bridging the Gap: Systematic Sim-to-Real Transfer for Diverse Legged Robots",
leggedrobotics/pace-sim2real f8ec8b85): of each joint armature, viscous damping, friction and encoder bias, and one
delay in whole steps, by CMA-ES from the middle of the bounds with sigma 0.5; also the drive's gain, as its authors
advise if that is unknown.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

from benches.identify import sysid as rigs
from benches.identify.sysid import Recording
from benches.league.cmaes import minimise

Row = tuple[float, float, float, rigs.Put]
ITERATIONS = 40
GO2_KP, GO2_KD = 20.0, 0.5
_SERVO = (0.003, 0.0002, 0.03)
_ARMATURE = {"disk": (1e-4, 1e-6, 1e-3), "xl330": _SERVO, "sts3250": (0.01, 0.0002, 0.1), "so101": (0.01, 1e-3, 0.1)}
_TORQUE = {"xl330": (0.5, 0.1, 2.0), "sts3250": (4.0, 0.5, 15.0)}
"""Guess and bounds around the data sheet's torque at standstill [N m]."""


@dataclass(frozen=True)
class Rig:
    """Simulated parts and parameters of one rig; parameters are name -> first guess, bounds, setter.

    Attributes:
        runs: Recording -> its parts, which are simulated one after the other.
        plain: Parameters of a user of the toolbox.
        more: Our further parameters, without the delay.
        pace: PACE's parameters, without biases and the delay.
        bias: Sets an encoder's bias in the drive: the joint's number, the bias [rad]; None without a position drive.
    """

    runs: Callable[[Recording], list[Any]]
    plain: dict[str, Row]
    more: dict[str, Row]
    pace: dict[str, Row]
    bias: Callable[[mujoco.MjSpec, int, float], None] | None


class _TimeOver(Exception):  # noqa: N818
    """The budget is spent."""


class _Residual:
    """The toolbox's residuals, which keep the best candidate and end when the time is over."""

    def __init__(self, runs: Sequence[Any], transform: sysid.SignalTransform, deadline: float) -> None:
        self._function = sysid.build_residual_fn(
            models_sequences=[run.sequences(f"run{i}") for i, run in enumerate(runs)],
            modify_residual=transform.apply, resample_true=False,
        )  # fmt: skip
        self.deadline, self.evaluations, self.lowest = deadline, 0, np.inf
        self.best = self.losses = np.zeros(0)

    def __call__(self, x: np.ndarray, parameters: sysid.ParameterDict, **options: Any) -> Any:
        if self.evaluations and time.process_time() > self.deadline:
            raise _TimeOver
        residuals = self._function(x, parameters, **options)
        columns = x.reshape(len(x), -1)
        self.evaluations += columns.shape[1]
        stacked = np.nan_to_num(np.concatenate(residuals[0]), nan=1e3).reshape(-1, columns.shape[1])
        losses = np.sum(stacked**2, axis=0)
        if np.min(losses) < self.lowest:
            self.lowest, self.best = float(np.min(losses)), columns[:, int(np.argmin(losses))].copy()
        self.losses = losses
        return residuals


def fit_sysid(
    rig: Rig, fitted: Sequence[Recording], ours: bool, budget_s: float, seed: int
) -> tuple[Callable[[Sequence[Recording]], list[np.ndarray]], str]:
    """Fit with the toolbox's optimiser within a budget, from several places; return the predictor and a summary."""
    parameters, transform = _parameters({**rig.plain, **(rig.more if ours else {})}, ours)
    runs = [run for r in fitted for run in rig.runs(r)]
    residual, starts = _Residual(runs, transform, time.process_time() + budget_s), 0
    rng = np.random.default_rng(seed)
    with contextlib.suppress(_TimeOver), contextlib.redirect_stdout(io.StringIO()):
        while True:
            starts += 1
            with contextlib.suppress(np.linalg.LinAlgError, mujoco.FatalError):
                sysid.optimize(parameters, residual, verbose=False, max_iters=ITERATIONS, x_scale="jac")
            if time.process_time() > residual.deadline:
                break
            parameters.randomize(rng)
    parameters.update_from_vector(residual.best)
    summary = f"{residual.evaluations} evaluations, {starts} starts"
    return lambda recordings: [predict(rig, parameters, r) for r in recordings], summary


def fit_pace(
    rig: Rig, fitted: Sequence[Recording], budget_s: float, seed: int
) -> tuple[Callable[[Sequence[Recording]], list[np.ndarray]], str]:
    """Fit PACE's parameters with CMA-ES within a budget; return the predictor and a summary."""
    parameters, count = pace_parameters(rig, fitted, budget_s, seed)
    return lambda recordings: [predict(rig, parameters, r) for r in recordings], f"{count} evaluations"


def pace_parameters(
    rig: Rig, fitted: Sequence[Recording], budget_s: float, seed: int
) -> tuple[sysid.ParameterDict, int]:
    """Return PACE's parameters after CMA-ES within a budget, and the number of evaluations."""
    joints = fitted[0].position.shape[1]
    biases = {f"bias{j}": (0.0, -0.1, 0.1, _bias(rig, j)) for j in range(joints)}
    parameters, transform = _parameters({**rig.pace, **biases}, True)
    runs = [run for r in fitted for run in rig.runs(r)]
    for j, sensor in enumerate(runs[0].spec.sensors):
        transform.bias(sensor.name, parameters[f"bias{j}"], "predicted")
    deadline, step_s = time.process_time() + budget_s, runs[0].spec.option.timestep
    residual = _Residual(runs, transform, np.inf)
    low, high = parameters.get_bounds()

    def values(u: np.ndarray) -> np.ndarray:
        x = low + (high - low) * u
        x[..., -1 - joints] = np.round(x[..., -1 - joints] / step_s) * step_s  # the delay, before the biases
        return x

    def losses(candidates: np.ndarray) -> np.ndarray:
        residual(values(candidates).T, parameters)
        return residual.losses

    order = list(parameters.keys())
    if order.index("delay") != len(order) - 1 - joints:
        raise ValueError("the delay does not stand before the biases")
    u, _, count = minimise(losses, np.full(len(low), 0.5), deadline, seed, sigma=0.5)
    parameters.update_from_vector(values(u))
    return parameters, count


def predict(rig: Rig, parameters: sysid.ParameterDict, recording: Recording) -> np.ndarray:
    """Return positions at the recording's stamps, from its first state ``(N, joints)`` [rad]."""
    free_run = rigs._free_run(parameters, rig.runs(recording))
    biases = [
        float(parameters[f"bias{j}"].value[0]) if f"bias{j}" in parameters else 0.0 for j in range(free_run.shape[1])
    ]
    return free_run + np.array(biases)


def _parameters(rows: dict[str, Row], delay: bool) -> tuple[sysid.ParameterDict, sysid.SignalTransform]:
    """Return parameters, the delay before the biases, and the transform that delays all sensors."""
    parameters, transform = sysid.ParameterDict(), sysid.SignalTransform(normalize=False)
    for name, (guess, low, high, put) in rows.items():
        if name.startswith("bias") and delay and "delay" not in parameters:
            _add_delay(parameters, transform)
        parameters.add(sysid.Parameter(name, guess, low, high, modifier=rigs._modifier(put)))
    if delay and "delay" not in parameters:
        _add_delay(parameters, transform)
    return parameters, transform


def _add_delay(parameters: sysid.ParameterDict, transform: sysid.SignalTransform) -> None:
    parameters.add(sysid.Parameter("delay", 0.01, *rigs.DELAY_S))
    transform.delay("*", parameters["delay"])


def _bias(rig: Rig, joint: int) -> rigs.Put:
    return lambda spec, value: rig.bias(spec, joint, value) if rig.bias else None


def _feed_back(spec: mujoco.MjSpec, joint: int, value: float) -> None:
    """Set the encoder's bias in a position drive whose gain is set before; the toolbox keeps one spec for all calls."""
    drive = spec.actuators[joint]
    drive.biasprm[0] = drive.biasprm[1] * value


def one_joint(kind: str) -> Rig:
    """Return a rig of one hinge: the disk, a servo that lifts a mass, or ``so101``, one joint of the arm."""
    armature = {"armature": (*_ARMATURE[kind], rigs._armature)}
    if kind == "disk":
        spec = rigs._spec(rigs.PHYSICS_S["disk"], 0.1, 0.041, 1e-4)
        joint = {"damping": (0.0005, 0.0, 0.01, rigs._damping), "frictionloss": (0.0005, 0.0, 0.02, rigs._friction)}
        drive = {"mass": (0.1, 0.01, 1.0, rigs._mass), "gain": (0.005, 0.0005, 0.1, rigs._gain)}
        bias = {"torque": (0.0, -0.01, 0.01, rigs._bias)}
        motor = {"gain": drive["gain"]}  # its load is given
        runs = lambda r: [rigs._Run(r, spec)]  # noqa: E731
        return Rig(runs, {**drive, **joint}, bias, {**motor, **joint, **armature}, None)
    if kind in _TORQUE:
        joint = {"damping": (0.01, 0.0, 0.5, rigs._damping), "frictionloss": (0.03, 0.0, 0.3, rigs._friction)}
        drive = {"torque": (*_TORQUE[kind], rigs._torque)}
        more = {"back_emf": (0.03, 0.0, 1.0, rigs._back_emf)}
        plain = {**drive, **joint, **armature}
        return Rig(_servo_runs, plain, more, plain, _feed_back)
    spec = rigs._spec(rigs.PHYSICS_S["so101"], 1e-9, 0.1, 0.01)
    joint = {"damping": (0.5, 0.0, 10.0, rigs._damping), "frictionloss": (0.02, 0.0, 2.0, rigs._friction)}
    drive = {"kp": (10.0, 0.5, 200.0, rigs._kp)}
    more = {"offset": (0.0, -0.3, 0.3, rigs._offset)}
    runs = lambda r: [rigs._Run(r, spec)]  # noqa: E731
    return Rig(runs, {**drive, **joint}, more, {**drive, **joint, **armature}, _feed_back)


def _servo_runs(recording: Recording) -> list[Any]:
    """Return the parts with torque on and off; the register's gain is that which makes the recording's duty."""
    kp = recording.constants["duty_per_rad"] * 256 * rigs.PWM_LIMIT / rigs.PULSES_PER_RAD
    return rigs._xl330_runs(replace(recording, constants={**recording.constants, "kp": kp}))


def legs(recording: Recording) -> Rig:
    """Return a robot from its MJCF, all joints of it with position drives as the Go2's."""
    spec = _legs_spec(recording.constants["mjcf"])
    count = len(spec.joints)

    def every(put: Callable[[Any], None]) -> None:
        for element in range(count):
            put(element)

    def field(name: str) -> rigs.Put:
        return lambda s, v: every(lambda j: _set_joint(s.joints[j], name, v))

    def gain(s: mujoco.MjSpec, v: float) -> None:
        every(lambda j: _set_drive(s.actuators[j], v, None))

    def brake(s: mujoco.MjSpec, v: float) -> None:
        every(lambda j: _set_drive(s.actuators[j], None, v))

    def single(name: str, j: int) -> rigs.Put:
        return lambda s, v: _set_joint(s.joints[j], name, v)

    friction = {f"frictionloss{j}": (0.2, 0.0, 2.0, single("frictionloss", j)) for j in range(count)}
    shared = {"damping": (0.6, 0.0, 5.0, field("damping")), "armature": (0.01, 0.001, 0.1, field("armature"))}
    drive = {"kp": (GO2_KP, 5.0, 60.0, gain)}
    each = {
        f"{name}{j}": (guess, low, high, single(name, j))
        for name, (guess, low, high) in {"armature": (0.01, 1e-5, 0.1), "damping": (0.6, 0.0, 7.0)}.items()
        for j in range(count)
    }
    runs = lambda r: [_LegsRun(r, spec)]  # noqa: E731
    return Rig(
        runs, {**shared, **friction}, {**drive, "kd": (GO2_KD, 0.0, 5.0, brake)}, {**each, **friction}, _feed_back
    )


def described(recording: Recording) -> Rig | None:
    """Return a robot from its MJCF, whose values are the guesses; None if its joints are not those recorded."""
    spec, force = _legs_spec(recording.constants["mjcf"]), recording.constants.get("command", "goal") != "goal"
    model, count = spec.compile(), recording.position.shape[1]
    if not model.njnt == model.nv == count:
        return None

    def each(name: str, j: int) -> rigs.Put:
        return lambda s, v: _set_joint(s.joints[j], name, v)

    def drives(put: Callable[[Any, float], None]) -> rigs.Put:
        return lambda s, v: [put(actuator, v) for actuator in s.actuators] and None

    def factor(drive: Any, v: float) -> None:
        drive.gainprm[0] = v

    def constant(drive: Any, v: float) -> None:
        drive.biasprm[0] = v

    rows: dict[str, Row] = {}
    for name, least in {"damping": 0.1, "frictionloss": 0.05, "armature": 0.01}.items():
        for j, value in enumerate(getattr(model, f"dof_{name}")):
            guess = float(np.squeeze(value)) or least
            rows[f"{name}{j}"] = (guess, 1e-6, 10 * guess, each(name, j))
    more: dict[str, Row] = {}
    if force:
        for actuator in spec.actuators:
            actuator.biasprm[:3] = 0.0
        drive = {"gain": (1.0, 0.1, 10.0, drives(factor))}
        most = 0.2 * float(np.abs(recording.command).max())
        more = {"constant": (0.0, -most, most, drives(constant))}
    else:
        drive = {"kp": (GO2_KP, 1.0, 500.0, drives(lambda a, v: _set_drive(a, v, None)))}
        drive["kd"] = (GO2_KD, 0.0, 20.0, drives(lambda a, v: _set_drive(a, None, v)))
    runs = lambda r: [_LegsRun(r, spec)]  # noqa: E731
    return Rig(runs, {**drive, **rows}, more, {**drive, **rows}, None if force else _feed_back)


class _LegsRun(rigs._Run):
    """A recording of all joints."""

    def sequences(self, name: str) -> sysid.ModelSequences:
        recording, model = self.recording, self.spec.compile()
        sensors = [s.name for s in self.spec.sensors]
        measured = sysid.TimeSeries.from_names(recording.t - recording.t[0], recording.position, model, sensors)
        state = sysid.create_initial_state(model, *recording.start.T)
        return sysid.ModelSequences(name, self.spec, name, state, self.control, measured)


def _legs_spec(path: str) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_file(path)
    spec.option.timestep, spec.option.integrator = 0.0025, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    for element in [*spec.actuators, *spec.sensors]:
        spec.delete(element)
    for joint in spec.joints:
        drive = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        drive.gaintype, drive.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        _set_drive(drive, GO2_KP, GO2_KD)
        spec.add_sensor(
            name=f"{joint.name}_position",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint.name,
        )
    return spec


def _set_joint(joint: Any, name: str, value: float) -> None:
    if name == "damping":
        joint.damping[0] = value
    else:
        setattr(joint, name, value)


def _set_drive(drive: Any, kp: float | None, kd: float | None) -> None:
    if kp is not None:
        drive.gainprm[0], drive.biasprm[1] = kp, -kp
    if kd is not None:
        drive.biasprm[2] = -kd
