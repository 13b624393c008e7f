"""The yardstick of identification: Google's ``mujoco.sysid`` on the recordings and splits of our own.

Every rig is one hinge (or six that do not touch each other) with a point mass, an armature, viscous damping and dry
friction (``frictionloss``), fitted by the toolbox's default optimiser (Gauss-Newton on finite differences, scaled by
the Jacobian) to free runs over whole recordings. The toolbox is used unchanged, with these choices:

- Commands are held between samples. The toolbox resamples them linearly, which smears a held command by half a sample,
  so they are expanded to physics steps beforehand and its resampling is switched off.
- The delay is the toolbox's sensor delay (``SignalTransform.delay``), constant, within [0, 60] ms. Its roll-outs stamp
  a sensor reading at the end of the physics step at whose start it was taken: predictions come one step late, and
  MuJoCo's Euler step responds half a step early, so the delay that it reports is about half a physics step
  (``PHYSICS_S``) shorter than the loop's. Neither is corrected here.
- Residuals are plain position errors [rad], not divided by the norm of each recording.
- Intervals are ``calculate_intervals`` at the last Jacobian of the optimiser, 95 %, linearised.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

from benches.identify.recordings import ITERATIONS

PHYSICS_S = {"disk": 0.005, "xl330": 0.002, "so101": 0.005}
DELAY_S = (0.0, 0.06)
DISK_SAMPLES = 6000
SO101_SPAN_S = 60.0
SO101_JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
SENSOR, JOINT, DRIVE = "position", "hinge", "drive"
PWM_LIMIT, PULSES_PER_RAD = 885.0, 4096 / (2 * np.pi)

Put = Callable[[mujoco.MjSpec, float], None]


@dataclass(frozen=True)
class Recording:
    """One recording of a rig.

    Attributes:
        t: stamps [s], shape (N,).
        command: command at each stamp, held until the next, shape (N, k).
        position: measured joint positions [rad], shape (N, joints).
        start: position and velocity at the first stamp, shape (joints, 2).
        constants: constants of this recording; for the XL330 ``kp``, the register of the position gain, ``mass``
            [kg] and ``length`` [m] of the load, and ``torque_enable``, shape (N,).
    """

    t: np.ndarray
    command: np.ndarray
    position: np.ndarray
    start: np.ndarray
    constants: dict[str, Any] = field(default_factory=dict)

    def part(self, begin: int, end: int, start: np.ndarray | None = None) -> Recording:
        """Return the samples from ``begin`` up to ``end``."""
        cut = slice(begin, end)
        start = self.start if start is None else start
        return Recording(self.t[cut], self.command[cut], self.position[cut], start, self.constants)

    def joint(self, index: int) -> Recording:
        """Return one joint and its command."""
        one = slice(index, index + 1)
        return Recording(self.t, self.command[:, one], self.position[:, one], self.start[one], self.constants)


@dataclass(frozen=True)
class SysidResult:
    """The result of ``mujoco.sysid``.

    Attributes:
        predictions: free runs over the test recordings at the measured stamps, shape (N, joints) each.
        seconds: wall-clock time of the optimisation.
        evaluations: roll-outs of all fitted recordings, those of finite differences too.
        physics_steps_per_evaluation: number of physics steps of one of them.
    """

    values: dict[str, float]
    interval95: dict[str, tuple[float, float]]
    predictions: list[np.ndarray]
    seconds: float
    evaluations: int
    evaluations_per_s: float
    physics_steps_per_evaluation: int


@dataclass(frozen=True)
class _Run:
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
        measured = sysid.TimeSeries.from_names(recording.t - recording.t[0], recording.position, model, [SENSOR])
        position, velocity = recording.start.T
        state = sysid.create_initial_state(model, position, velocity)
        return sysid.ModelSequences(name, self.spec, name, state, self.control, measured)


def _spec(timestep: float, mass: float, length: float, armature: float, **numbers: float) -> mujoco.MjSpec:
    """Return a hinge that hangs down at zero, driven by one actuator; ``numbers`` travel with it for the modifiers."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    body = spec.worldbody.add_body(name="load")
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, [0, 0, -length], [1e-9, 1e-9, 1e-9]
    body.add_joint(name=JOINT, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], armature=armature)
    drive = spec.add_actuator(name=DRIVE, target=JOINT, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    drive.gaintype, drive.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    spec.add_sensor(
        name=SENSOR, type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=JOINT
    )
    for name, number in numbers.items():
        spec.add_numeric(name=name, data=[number], size=1)
    return spec


def _modifier(put: Put) -> Callable[[mujoco.MjSpec, sysid.Parameter], None]:
    return lambda spec, parameter: put(spec, float(parameter.value[0]))


def _parameters(
    rows: dict[str, tuple[float, float, float, Put]], delay: bool
) -> tuple[sysid.ParameterDict, sysid.SignalTransform]:
    """Return parameters (first guess, bounds, setter), and the transform that delays the sensor."""
    parameters, transform = sysid.ParameterDict(), sysid.SignalTransform(normalize=False)
    for name, (guess, low, high, put) in rows.items():
        parameters.add(sysid.Parameter(name, guess, low, high, modifier=_modifier(put)))
    if delay:
        parameters.add(sysid.Parameter("delay", 0.01, *DELAY_S))
        transform.delay(SENSOR, parameters["delay"])
    return parameters, transform


class _Counted:
    """The toolbox's residual function, with a counter of evaluations."""

    def __init__(self, runs: Sequence[_Run], transform: sysid.SignalTransform) -> None:
        sequences = [run.sequences(f"run{i}") for i, run in enumerate(runs)]
        self.function = sysid.build_residual_fn(
            models_sequences=sequences, modify_residual=transform.apply, resample_true=False
        )
        self.evaluations = 0
        self.steps = sum(len(sequence.control[0]) - 1 for sequence in sequences)

    def __call__(self, x: np.ndarray, parameters: sysid.ParameterDict, **options: Any) -> Any:
        self.evaluations += x.shape[1] if x.ndim > 1 else 1
        return self.function(x, parameters, **options)


def _fit(
    runs: Sequence[_Run], parameters: sysid.ParameterDict, transform: sysid.SignalTransform, iterations: int
) -> tuple[sysid.ParameterDict, SysidResult]:
    """Optimise; the result holds no predictions yet."""
    residual = _Counted(runs, transform)
    begin = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()):
        best, optimum = sysid.optimize(parameters, residual, verbose=False, max_iters=iterations, x_scale="jac")
    seconds, evaluations = time.perf_counter() - begin, residual.evaluations
    _, half = sysid.calculate_intervals(residual(optimum.x, best)[0], optimum.jac)
    values = {name: float(best[name].value[0]) for name in best.keys()}  # noqa: SIM118
    interval = {name: (v - float(h), v + float(h)) for (name, v), h in zip(values.items(), half, strict=True)}
    return best, SysidResult(values, interval, [], seconds, evaluations, evaluations / seconds, residual.steps)


def _free_run(parameters: sysid.ParameterDict, runs: Sequence[_Run]) -> np.ndarray:
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


def _gain(spec: mujoco.MjSpec, value: float) -> None:
    spec.actuator(DRIVE).gainprm[0] = value


def _bias(spec: mujoco.MjSpec, value: float) -> None:
    spec.actuator(DRIVE).biasprm[0] = value


def _mass(spec: mujoco.MjSpec, value: float) -> None:
    spec.body("load").mass = value


def _damping(spec: mujoco.MjSpec, value: float) -> None:
    spec.joint(JOINT).damping[0] = value


def _friction(spec: mujoco.MjSpec, value: float) -> None:
    spec.joint(JOINT).frictionloss = value


def _armature(spec: mujoco.MjSpec, value: float) -> None:
    spec.joint(JOINT).armature = value


def _disk_problem(delay: bool) -> tuple[mujoco.MjSpec, sysid.ParameterDict, sysid.SignalTransform]:
    """Return the disk: armature and the distance of its mass are fixed, else only ratios would be identifiable."""
    rows = {
        "mass": (0.1, 0.01, 1.0, _mass),
        "gain": (0.005, 0.0005, 0.1, _gain),
        "damping": (0.0005, 0.0, 0.01, _damping),
        "frictionloss": (0.0005, 0.0, 0.02, _friction),
        "bias": (0.0, -0.01, 0.01, _bias),
    }
    return _spec(PHYSICS_S["disk"], 0.1, 0.041, 1e-4), *_parameters(rows, delay)


def disk(fit: Recording, test: list[Recording], delay: bool) -> SysidResult:
    """Identify the unbalanced disk: mass, motor gain, damping, dry friction, constant torque, perhaps the delay.

    Of a longer recording the first 6000 samples are fitted, as in the figures published with the data: 150 s in one
    free run, 30000 physics steps. At most 40 iterations. The first guess is of the size of the rig's published
    constants; one with 1.6 times the gain, 0.6 times the mass and damping and 4 times the friction ended in a local
    minimum, for so long a free run has many.
    """
    spec, parameters, transform = _disk_problem(delay)
    best, result = _fit([_Run(fit.part(0, DISK_SAMPLES), spec)], parameters, transform, ITERATIONS["disk"])
    return replace(result, predictions=[_free_run(best, [_Run(r, spec)]) for r in test])


def _torque(spec: mujoco.MjSpec, value: float) -> None:
    """Set the torque at full duty [N m]: the register's gain, in duty per radian, saturates there."""
    drive, kp = spec.actuator(DRIVE), spec.numeric("kp").data[0]
    gain = value * kp / 256 * PULSES_PER_RAD / PWM_LIMIT
    drive.gainprm[0], drive.biasprm[1] = gain, -gain
    drive.forcelimited, drive.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-value, value]


def _back_emf(spec: mujoco.MjSpec, value: float) -> None:
    """Brake the joint while torque is enabled, on top of its damping, which is set before."""
    if spec.numeric("kp").data[0] > 0:
        spec.joint(JOINT).damping[0] += value


def _xl330_runs(recording: Recording) -> list[_Run]:
    """Return the part with torque enabled, and the part after, without drive (gain 0), where there is one."""
    constants = recording.constants
    enabled = np.asarray(constants["torque_enable"], bool)
    off = len(enabled) if enabled.all() else int(np.argmin(enabled))
    load = PHYSICS_S["xl330"], constants["mass"], constants["length"], 0.002
    parts = [_Run(recording.part(0, off + 1), _spec(*load, kp=constants["kp"]))]
    if off + 1 < len(enabled):
        near = slice(max(off - 4, 0), off + 5)
        slope, offset = np.polyfit(recording.t[near] - recording.t[off], recording.position[near, 0], 1)
        parts.append(_Run(recording.part(off, len(enabled), np.array([[offset, slope]])), _spec(*load, kp=0.0)))
    return parts


def xl330(fit: list[Recording], test: list[Recording], delay: bool) -> SysidResult:
    """Identify the XL330 with a load: torque at full duty, back-EMF, damping, dry friction, armature, perhaps a delay.

    The position loop runs inside the simulation with the gain of each recording (duty = kp / 256 per pulse of error,
    up to 885 of 885). An actuator cannot be switched off during a roll-out, so a recording whose torque is disabled on
    the way is fitted in two parts: the second has no drive and no back-EMF, and starts at the position and velocity
    measured there (a line through nine samples). Test recordings are simulated through, from their initial state
    alone. At most 25 iterations.
    """
    rows = {
        "torque": (0.5, 0.1, 2.0, _torque),
        "damping": (0.01, 0.0, 0.5, _damping),
        "back_emf": (0.03, 0.0, 1.0, _back_emf),
        "frictionloss": (0.03, 0.0, 0.3, _friction),
        "armature": (0.003, 0.0002, 0.03, _armature),
    }
    parameters, transform = _parameters(rows, delay)
    runs = [run for recording in fit for run in _xl330_runs(recording)]
    best, result = _fit(runs, parameters, transform, ITERATIONS["xl330"])
    return replace(result, predictions=[_free_run(best, _xl330_runs(r)) for r in test])


def _kp(spec: mujoco.MjSpec, value: float) -> None:
    spec.actuator(DRIVE).gainprm[0], spec.actuator(DRIVE).biasprm[1] = value, -value


def _offset(spec: mujoco.MjSpec, value: float) -> None:
    """Move the target; the gain is set before."""
    spec.actuator(DRIVE).biasprm[0] = value * spec.actuator(DRIVE).gainprm[0]


def so101(fit: list[Recording], test: list[Recording], delay: bool) -> SysidResult:
    """Identify six position-controlled hinges: gain, damping, dry friction, offset, perhaps a delay, of each.

    The joints do not feel each other, nor gravity beyond the offset, so each is fitted alone (a sixth of the work of
    one fit of all, and a delay of its own), on the first 60 s of each recording, at most 8 iterations each (15 change
    no test figure). An armature of 0.01 is fixed. Parameters are called ``Elbow.kp``; an evaluation is one joint's.
    """
    rows = {
        "kp": (10.0, 0.5, 200.0, _kp),
        "damping": (0.5, 0.0, 10.0, _damping),
        "frictionloss": (0.02, 0.0, 2.0, _friction),
        "offset": (0.0, -0.3, 0.3, _offset),
    }
    spec = _spec(PHYSICS_S["so101"], 1e-9, 0.1, 0.01)
    spans = [r.part(0, int(np.searchsorted(r.t, r.t[0] + SO101_SPAN_S))) for r in fit]
    results, columns = [], []
    for index in range(len(SO101_JOINTS)):
        parameters, transform = _parameters(rows, delay)
        runs = [_Run(span.joint(index), spec) for span in spans]
        best, result = _fit(runs, parameters, transform, ITERATIONS["so101"])
        results.append(result)
        columns.append([_free_run(best, [_Run(r.joint(index), spec)]) for r in test])
    seconds, evaluations = sum(r.seconds for r in results), sum(r.evaluations for r in results)
    named = list(zip(SO101_JOINTS, results, strict=True))
    return SysidResult(
        {f"{joint}.{name}": value for joint, r in named for name, value in r.values.items()},
        {f"{joint}.{name}": limits for joint, r in named for name, limits in r.interval95.items()},
        [np.hstack(joints) for joints in zip(*columns, strict=True)],
        seconds,
        evaluations,
        evaluations / seconds,
        results[0].physics_steps_per_evaluation,
    )
