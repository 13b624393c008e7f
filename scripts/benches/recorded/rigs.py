"""MuJoCo's joints: fitted by Google's ``mujoco.sysid``, plain or with our terms and a delay, and in PACE's form.

A rig is one hinge with a point mass, an armature, viscous damping and dry friction (``frictionloss``), or a robot from
its MJCF. All fits simulate free runs over whole recordings with the toolbox's own residuals; parameters and optimisers
differ. mujoco.sysid: its default optimiser (Gauss-Newton on finite differences, scaled by the Jacobian) from a guess,
then from random places until the time is over. PACE (F. Bjelonic et al., "Towards Bridging the Gap: Systematic
Sim-to-Real Transfer for Diverse Legged Robots", leggedrobotics/pace-sim2real f8ec8b85): of each joint armature, viscous
damping, friction and encoder bias, and one delay in whole steps, by CMA-ES from the middle of the bounds with sigma
0.5; also the drive's gain, as its authors advise if that is unknown. The toolbox is used unchanged, with these choices:

- Commands are held between samples. The toolbox resamples them linearly, which smears a held command by half a sample,
  so they are expanded to physics steps beforehand and its resampling is switched off.
- The delay is the toolbox's sensor delay (``SignalTransform.delay``), constant, within [0, 60] ms. Its roll-outs stamp
  a sensor reading at the end of the physics step at whose start it was taken: predictions come one step late, and
  MuJoCo's Euler step responds half a step early, so the delay that it reports is about half a physics step
  (``PHYSICS_S``) shorter than the loop's. Neither is corrected here.
- Residuals are plain position errors [rad], not divided by the norm of each recording.
- An actuator cannot be switched off during a roll-out: a recording whose torque is disabled on the way is fitted in two
  parts. The second has no drive and no back-EMF, and starts at the position and velocity measured there.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

from benches.recorded.search import minimise
from benches.recorded.sets import Recording

Put = Callable[[mujoco.MjSpec, float], None]
Row = tuple[float, float, float, Put]
"""First guess, bounds, and setter of a parameter."""
PHYSICS_S = {"disk": 0.005, "xl330": 0.002, "sts3250": 0.002, "so101": 0.005}
DELAY_S = (0.0, 0.06)
ITERATIONS = 40
JOINT, DRIVE = "hinge", "drive"
PWM_LIMIT, PULSES_PER_RAD = 885.0, 4096 / (2 * np.pi)
GO2_KP, GO2_KD = 20.0, 0.5
_SERVO = (0.003, 0.0002, 0.03)
_ARMATURE = {"disk": (1e-4, 1e-6, 1e-3), "xl330": _SERVO, "sts3250": (0.01, 0.0002, 0.1), "so101": (0.01, 1e-3, 0.1)}
_TORQUE = {"xl330": (0.5, 0.1, 2.0), "sts3250": (4.0, 0.5, 15.0)}
"""Guess and bounds around the data sheet's torque at standstill [N m]."""


@dataclass(frozen=True)
class Run:
    """A recording, or a part of one, beside the model that simulates it."""

    recording: Recording
    spec: mujoco.MjSpec

    @property
    def control(self) -> sysid.TimeSeries:
        """The command at each physics step, held; the last one is never applied (the toolbox drops it)."""
        dt, t = self.spec.option.timestep, self.recording.t - self.recording.t[0]
        grid = np.arange(int(np.ceil(t[-1] / dt)) + 2) * dt
        held = np.searchsorted(t, grid + dt / 2, side="right") - 1
        return sysid.TimeSeries(grid, self.recording.command[held])

    def sequences(self, name: str) -> sysid.ModelSequences:
        """Return the toolbox's form of the recording."""
        recording, model = self.recording, self.spec.compile()
        sensors = [s.name for s in self.spec.sensors]
        measured = sysid.TimeSeries.from_names(recording.t - recording.t[0], recording.position, model, sensors)
        state = sysid.create_initial_state(model, *recording.start.T)
        return sysid.ModelSequences(name, self.spec, name, state, self.control, measured)


@dataclass(frozen=True)
class Rig:
    """Simulated parts and parameters of one rig.

    Attributes:
        runs: Recording -> its parts, which are simulated one after the other.
        plain: Parameters of a user of the toolbox.
        more: Our further parameters, without the delay.
        pace: PACE's parameters, without biases and the delay.
        biased: Whether an encoder's bias acts on the drive, which feeds the position back.
    """

    runs: Callable[[Recording], list[Run]]
    plain: dict[str, Row]
    more: dict[str, Row]
    pace: dict[str, Row]
    biased: bool = True


@dataclass(frozen=True)
class Fit:
    """A fitted rig."""

    rig: Rig
    parameters: sysid.ParameterDict
    evaluations: int
    starts: int = 1

    def value(self, name: str) -> float:
        """Return a parameter."""
        return float(self.parameters[name].value[0])

    def predict(self, recordings: Sequence[Recording]) -> list[np.ndarray]:
        """Return positions at the stamps of each recording, from its first state, ``(N, joints)`` [rad]."""
        return [_free_run(self.parameters, self.rig.runs(r)) + self._biases(r.position.shape[1]) for r in recordings]

    def _biases(self, joints: int) -> np.ndarray:
        names = [f"bias{j}" for j in range(joints)]
        return np.array([self.value(n) if n in self.parameters else 0.0 for n in names])


class _TimeOver(Exception):  # noqa: N818
    """The budget is spent."""


class _Residual:
    """The toolbox's residuals, which keep the best candidate and end when the time is over."""

    def __init__(self, runs: Sequence[Run], transform: sysid.SignalTransform, deadline: float) -> None:
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
        self.losses = np.sum(stacked**2, axis=0)
        if np.min(self.losses) < self.lowest:
            self.lowest, self.best = float(np.min(self.losses)), columns[:, int(np.argmin(self.losses))].copy()
        return residuals


def fit_sysid(rig: Rig, fitted: Sequence[Recording], ours: bool, budget_s: float, seed: int) -> Fit:
    """Fit with the toolbox's optimiser within a budget, from several places.

    Args:
        ours: Whether to fit our further terms and a delay.
    """
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
    return Fit(rig, parameters, residual.evaluations, starts)


def fit_pace(rig: Rig, fitted: Sequence[Recording], budget_s: float, seed: int) -> Fit:
    """Fit PACE's parameters with CMA-ES within a budget."""
    joints = fitted[0].position.shape[1]
    put = lambda j: lambda spec, value: _feed_back(spec, j, value) if rig.biased else None  # noqa: E731
    biases: dict[str, Row] = {f"bias{j}": (0.0, -0.1, 0.1, put(j)) for j in range(joints)}
    parameters, transform = _parameters(rig.pace, True, biases)
    runs = [run for r in fitted for run in rig.runs(r)]
    for j, sensor in enumerate(runs[0].spec.sensors):
        transform.bias(sensor.name, parameters[f"bias{j}"], "predicted")
    deadline, step_s = time.process_time() + budget_s, runs[0].spec.option.timestep
    residual = _Residual(runs, transform, np.inf)
    low, high = parameters.get_bounds()
    delay = list(parameters.keys()).index("delay")

    def values(u: np.ndarray) -> np.ndarray:
        x = low + (high - low) * u
        x[..., delay] = np.round(x[..., delay] / step_s) * step_s
        return x

    def losses(candidates: np.ndarray) -> np.ndarray:
        residual(values(candidates).T, parameters)
        return residual.losses

    u, _, count = minimise(losses, np.full(len(low), 0.5), deadline, seed, sigma=0.5)
    parameters.update_from_vector(values(u))
    return Fit(rig, parameters, count)


def _parameters(
    rows: dict[str, Row], delay: bool, biases: dict[str, Row] | None = None
) -> tuple[sysid.ParameterDict, sysid.SignalTransform]:
    """Return parameters, the delay before the biases, and the transform that delays all sensors."""
    parameters, transform = sysid.ParameterDict(), sysid.SignalTransform(normalize=False)

    def add(rows: dict[str, Row]) -> None:
        for name, (guess, low, high, put) in rows.items():
            modifier = lambda spec, parameter, put=put: put(spec, float(parameter.value[0]))  # noqa: E731
            parameters.add(sysid.Parameter(name, guess, low, high, modifier=modifier))

    add(rows)
    if delay:
        parameters.add(sysid.Parameter("delay", 0.01, *DELAY_S))
        transform.delay("*", parameters["delay"])
    add(biases or {})
    return parameters, transform


def _free_run(parameters: sysid.ParameterDict, runs: Sequence[Run]) -> np.ndarray:
    """Simulate the parts of one recording, each from where the one before ended, from the given initial state."""
    state, times, readings, stamps = None, [], [], []
    for run, following in zip(runs, [*runs[1:], None], strict=True):
        model, t = sysid.apply_param_modifiers(parameters, run.spec), run.recording.t
        state = run.sequences("test").initial_state[0] if state is None else state
        (predicted,) = sysid.sysid_rollout(model, mujoco.MjData(model), run.control, state)
        steps = len(predicted.state)
        if following is not None:  # it begins at this part's last sample
            steps, t = round((following.recording.t[0] - t[0]) / run.spec.option.timestep), t[:-1]
        state = predicted.state.data[steps - 1]
        times.append(predicted.sensordata.times[:steps])
        readings.append(predicted.sensordata.data[:steps])
        stamps.append(t)
    delay = float(parameters["delay"].value[0]) if "delay" in parameters else 0.0
    t = np.concatenate(stamps)
    return sysid.TimeSeries(np.concatenate(times), np.concatenate(readings)).interpolate(t - t[0] - delay)


# One hinge.


def hinge(timestep: float, mass: float, length: float, armature: float, **numbers: float) -> mujoco.MjSpec:
    """Return a hinge that hangs down at zero, driven by one actuator; ``numbers`` travel with it for the setters."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    body = spec.worldbody.add_body(name="load")
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, [0, 0, -length], [1e-9, 1e-9, 1e-9]
    body.add_joint(name=JOINT, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], armature=armature)
    _add_drive_and_sensor(spec, JOINT, DRIVE)
    for name, number in numbers.items():
        spec.add_numeric(name=name, data=[number], size=1)
    return spec


def _add_drive_and_sensor(spec: mujoco.MjSpec, joint: str, name: str) -> Any:
    drive = spec.add_actuator(name=name, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    drive.gaintype, drive.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    kind, on = mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT
    spec.add_sensor(name=f"{joint}_position", type=kind, objtype=on, objname=joint)
    return drive


def of_joint(name: str, j: int = 0) -> Put:
    """Return the setter of a joint's ``damping``, ``frictionloss`` or ``armature``."""
    return lambda spec, value: _set_joint(spec.joints[j], name, value)


def put_gain(spec: mujoco.MjSpec, value: float) -> None:
    """Set the gain of a motor."""
    spec.actuators[0].gainprm[0] = value


def put_torque_offset(spec: mujoco.MjSpec, value: float) -> None:
    """Set a constant torque."""
    spec.actuators[0].biasprm[0] = value


def put_mass(spec: mujoco.MjSpec, value: float) -> None:
    """Set the mass of the load."""
    spec.body("load").mass = value


def put_torque(spec: mujoco.MjSpec, value: float) -> None:
    """Set the torque at full duty [N m]: the register's gain, in duty per radian, saturates there."""
    drive, kp = spec.actuator(DRIVE), spec.numeric("kp").data[0]
    gain = value * kp / 256 * PULSES_PER_RAD / PWM_LIMIT
    drive.gainprm[0], drive.biasprm[1] = gain, -gain
    drive.forcelimited, drive.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-value, value]


def put_back_emf(spec: mujoco.MjSpec, value: float) -> None:
    """Brake the joint while torque is enabled, on top of its damping, which is set before."""
    if spec.numeric("kp").data[0] > 0:
        spec.joint(JOINT).damping[0] += value


def put_kp(spec: mujoco.MjSpec, value: float) -> None:
    """Set the stiffness of a position drive."""
    spec.actuator(DRIVE).gainprm[0], spec.actuator(DRIVE).biasprm[1] = value, -value


def put_offset(spec: mujoco.MjSpec, value: float) -> None:
    """Move the target; the gain is set before."""
    spec.actuator(DRIVE).biasprm[0] = value * spec.actuator(DRIVE).gainprm[0]


def _feed_back(spec: mujoco.MjSpec, joint: int, value: float) -> None:
    """Set the encoder's bias in a position drive whose gain is set before; the toolbox keeps one spec for all calls."""
    drive = spec.actuators[joint]
    drive.biasprm[0] = drive.biasprm[1] * value


def servo_runs(recording: Recording) -> list[Run]:
    """Return the part with torque on, and the part after it without drive (gain 0), where there is one.

    The position loop runs inside the simulation: the register's gain is that which makes the recording's duty.
    """
    constants = recording.constants
    enabled = np.asarray(constants["torque_enable"], bool)
    off = len(enabled) if enabled.all() else int(np.argmin(enabled))
    load = PHYSICS_S["xl330"], constants["mass"], constants["length"], 0.002
    kp = constants["duty_per_rad"] * 256 * PWM_LIMIT / PULSES_PER_RAD
    parts = [Run(recording.part(0, off + 1), hinge(*load, kp=kp))]
    if off + 1 < len(enabled):
        near = slice(max(off - 4, 0), off + 5)
        slope, offset = np.polyfit(recording.t[near] - recording.t[off], recording.position[near, 0], 1)
        parts.append(Run(recording.part(off, len(enabled), np.array([[offset, slope]])), hinge(*load, kp=0.0)))
    return parts


def one_joint(kind: str) -> Rig:
    """Return a rig of one hinge: the disk, a servo that lifts a mass, or ``so101``, one joint of the arm.

    The arm's joints do not feel each other, nor gravity beyond the offset; an armature of 0.01 is given.
    """
    armature = {"armature": (*_ARMATURE[kind], of_joint("armature"))}

    def losses(damping: tuple[float, float, float], friction: tuple[float, float, float]) -> dict[str, Row]:
        return {"damping": (*damping, of_joint("damping")), "frictionloss": (*friction, of_joint("frictionloss"))}

    if kind == "disk":  # armature and the distance of its mass are given, else only ratios would be identifiable
        spec = hinge(PHYSICS_S["disk"], 0.1, 0.041, 1e-4)
        joint = losses((0.0005, 0.0, 0.01), (0.0005, 0.0, 0.02))
        gain = {"gain": (0.005, 0.0005, 0.1, put_gain)}
        drive = {"mass": (0.1, 0.01, 1.0, put_mass), **gain}
        more = {"torque": (0.0, -0.01, 0.01, put_torque_offset)}
        return Rig(lambda r: [Run(r, spec)], {**drive, **joint}, more, {**gain, **joint, **armature}, biased=False)
    if kind in _TORQUE:
        joint = losses((0.01, 0.0, 0.5), (0.03, 0.0, 0.3))
        plain = {"torque": (*_TORQUE[kind], put_torque), **joint, **armature}
        return Rig(servo_runs, plain, {"back_emf": (0.03, 0.0, 1.0, put_back_emf)}, plain)
    spec = hinge(PHYSICS_S["so101"], 1e-9, 0.1, 0.01)
    joint = losses((0.5, 0.0, 10.0), (0.02, 0.0, 2.0))
    plain = {"kp": (10.0, 0.5, 200.0, put_kp), **joint}
    return Rig(lambda r: [Run(r, spec)], plain, {"offset": (0.0, -0.3, 0.3, put_offset)}, {**plain, **armature})


# Robots from their MJCF.


def robot_spec(path: str) -> mujoco.MjSpec:
    """Return a robot with a position drive and a sensor on each joint, without contacts."""
    spec = mujoco.MjSpec.from_file(path)
    spec.option.timestep, spec.option.integrator = 0.0025, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    for element in [*spec.actuators, *spec.sensors]:
        spec.delete(element)
    for joint in spec.joints:
        _set_drive(_add_drive_and_sensor(spec, joint.name, joint.name), GO2_KP, GO2_KD)
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


def _of_joints(name: str) -> Put:
    return lambda spec, value: [_set_joint(joint, name, value) for joint in spec.joints] and None


def _of_drives(put: Callable[[Any, float], None]) -> Put:
    return lambda spec, value: [put(drive, value) for drive in spec.actuators] and None


def _per_joint(count: int, rows: dict[str, tuple[float, float, float]]) -> Iterator[tuple[str, Row]]:
    for name, limits in rows.items():
        yield from ((f"{name}{j}", (*limits, of_joint(name, j))) for j in range(count))


def legs(recording: Recording) -> Rig:
    """Return the Go2 from its MJCF, all joints with drives of one gain."""
    spec = robot_spec(recording.constants["mjcf"])
    count = len(spec.joints)
    friction = dict(_per_joint(count, {"frictionloss": (0.2, 0.0, 2.0)}))
    shared = {"damping": (0.6, 0.0, 5.0), "armature": (0.01, 0.001, 0.1)}
    plain = {name: (*limits, _of_joints(name)) for name, limits in shared.items()} | friction
    more = {
        "kp": (GO2_KP, 5.0, 60.0, _of_drives(lambda a, v: _set_drive(a, v, None))),
        "kd": (GO2_KD, 0.0, 5.0, _of_drives(lambda a, v: _set_drive(a, None, v))),
    }
    each = dict(_per_joint(count, {"armature": (0.01, 1e-5, 0.1), "damping": (0.6, 0.0, 7.0)}))
    return Rig(lambda r: [Run(r, spec)], plain, more, {**each, **friction})


def axis(recording: Recording) -> Rig:
    """Return the EMPS's slide, which a force pushes; the values of its MJCF are the guesses."""
    spec = robot_spec(recording.constants["mjcf"])
    spec.actuators[0].biasprm[:3] = 0.0
    limits = {n: (v, 1e-6, 10 * v) for n, v in (("damping", 100.0), ("frictionloss", 10.0), ("armature", 0.1))}
    rows = {"gain": (1.0, 0.1, 10.0, put_gain), **dict(_per_joint(1, limits))}
    most = 0.2 * float(np.abs(recording.command).max())
    return Rig(lambda r: [Run(r, spec)], rows, {"constant": (0.0, -most, most, put_torque_offset)}, rows, biased=False)
