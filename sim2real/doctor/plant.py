"""The plant question: the logged commands replayed through the model, in short windows from where the robot was."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco as mujoco_c
import numpy as np

from sim2real.doctor.contract import Contract
from sim2real.doctor.deployed import known, matrices
from sim2real.doctor.log import Log
from sim2real.doctor.search import Finding, shortened
from sim2real.errors import UsageError

_STEP_S, _WINDOW_S, _WINDOWS = 0.0025, 0.2, 40
_LATER_S = 0.010
"""A delay that is longer by this than that of the training is a fault [s]; a training without a known delay had none,
and the first 10 ms are those of any robot."""
_LOWER = 0.75
"""A torque limit is a fault if it is below this share of the model's: drives that lag look limited a little earlier."""
_UPRIGHT = 0.8
"""Cosine of the tilt up to which a free robot stands."""


@dataclass(frozen=True)
class Plant:
    """How drives and bodies differ from the model.

    Attributes:
        delay_s: From a target in the log to the motion in the log [s].
        kp, kd, friction: Factors beside the contract's gains and the model.
        limits: Torque limit of each joint, a share of the largest torque that its targets ask for; empty: the model's.
        payload: Added mass of the heaviest body, as a share of the robot's.
    """

    delay_s: float = 0.0
    kp: float = 1.0
    kd: float = 1.0
    limits: tuple[float, ...] = ()
    friction: float = 1.0
    payload: float = 0.0


mujoco: Any = mujoco_c  # its C module has no stubs
GRIDS: dict[str, tuple[float, ...]] = {
    "delay_s": (0.0, 0.007, 0.014, 0.021, 0.028, 0.035, 0.045, 0.06),
    "kp": (0.35, 0.5, 0.65, 0.8, 1.25, 1.6, 2.2),
    "friction": (0.2, 3.0, 6.0, 12.0),
    "payload": (-0.1, 0.1, 0.2, 0.4),
    "limits": (0.05, 0.08, 0.12, 0.17, 0.24, 0.33, 0.45, 0.6),
}
_NOMINAL = Plant()


def driven_joints(mjcf: Path) -> list[str]:
    """Return the joints of a model that drives turn, in the order of its actuators, or of its joints without any."""
    model = read_model(mjcf)
    of_actuators = [int(model.actuator_trnid[i, 0]) for i in range(model.nu)]
    turning = [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)]
    single = [i for i in range(model.njnt) if int(model.jnt_type[i]) in turning]
    return [model.joint(i).name for i in of_actuators or single]


def read_model(mjcf: Path) -> Any:
    """Return the compiled model.

    Raises:
        UsageError: The file cannot be read.
    """
    try:
        return mujoco.MjModel.from_xml_path(str(mjcf))
    except ValueError as error:
        raise UsageError(f"the model {mjcf} cannot be read: {error}") from None


class Drives:
    """A model whose joints have the contract's drives.

    Raises:
        UsageError: The model lacks a joint, or neither it nor the contract has gains.
    """

    def __init__(self, mjcf: Path, contract: Contract) -> None:
        given = read_model(mjcf)
        spec = mujoco.MjSpec.from_file(str(mjcf))
        names = [given.joint(i).name for i in range(given.njnt)]
        if missing := [j for j in contract.joints if j not in names]:
            raise UsageError(f"{mjcf} has no joint {', '.join(missing)}", hint=f"it has {', '.join(names)}")
        ids = [names.index(j) for j in contract.joints]
        own = {int(given.actuator_trnid[i, 0]): i for i in range(given.nu)}
        kp, kd = (contract.per_joint(n) if getattr(contract, n) not in ((), {}) else None for n in ("kp", "kd"))
        if contract.drive == "torque":
            kp, kd = np.ones(len(ids)), np.zeros(len(ids))
        elif kp is None:
            gains = [given.actuator_gainprm[own[i], 0] if i in own else 0.0 for i in ids]
            biases = [-given.actuator_biasprm[own[i], 2] if i in own else 0.0 for i in ids]
            if min(gains) <= 0.0:
                raise UsageError("neither the contract nor the model has gains of the drives",
                                 hint="add kp and kd to the contract")  # fmt: skip
            kp, kd = np.array(gains), np.array(biases) if kd is None else kd
        self.kp, self.kd = kp, np.zeros(len(ids)) if kd is None else kd
        self.torque_driven = contract.drive == "torque"
        limits = []
        for i in ids:
            high = given.jnt_actfrcrange[i, 1] if given.jnt_actfrclimited[i] else 0.0
            if i in own and given.actuator_forcelimited[own[i]]:
                high = given.actuator_forcerange[own[i], 1]
            limits.append(float(high) if high > 0 else 1e6)
        self.limit = np.array(limits)
        for element in (*spec.actuators, *spec.keys, *spec.sensors):
            spec.delete(element)
        for joint in contract.joints:  # their gains and limits are those of ``with_plant``
            actuator = spec.add_actuator(name=f"doctor_{joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            if not self.torque_driven:
                actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.forcelimited, actuator.forcerange = True, [-1e6, 1e6]
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.timestep = min(_STEP_S, spec.option.timestep)
        self.model = spec.compile()
        self.qpos = np.array([self.model.joint(j).qposadr[0] for j in contract.joints])
        self.dof = np.array([self.model.joint(j).dofadr[0] for j in contract.joints])
        self.free = self.model.njnt > 0 and int(self.model.jnt_type[0]) == int(mujoco.mjtJoint.mjJNT_FREE)
        # The body that a payload adds to: the heaviest of a free robot, the outermost of a fixed one.
        moved = self.model.jnt_bodyid[[self.model.joint(j).id for j in contract.joints]]
        self.loaded = int(np.argmax(self.model.body_mass)) if self.free else int(moved[-1])

    def torque(self, target: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torques that targets ask for [N m]."""
        return target if self.torque_driven else self.kp * (target - q) - self.kd * dq

    def with_plant(self, plant: Plant, asked: np.ndarray) -> Any:
        """Return a copy of the model with other drives; ``asked``: the largest torques of the targets ``(J,)``."""
        model = copy.copy(self.model)
        model.actuator_gainprm[:, 0] = self.kp * plant.kp
        if not self.torque_driven:
            model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -self.kp * plant.kp, -self.kd * plant.kd
        limit = np.minimum(self.limit, asked * plant.limits if plant.limits else np.inf)
        model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1] = -limit, limit
        model.dof_frictionloss[self.dof] *= plant.friction
        if plant.payload:
            model.body_mass[self.loaded] += plant.payload * float(self.model.body_mass.sum())
        return model


class Replay:
    """The log's commands through the model.

    Raises:
        UsageError: The log has no targets.
    """

    def __init__(self, drives: Drives, log: Log) -> None:
        if log.target is None:
            raise UsageError("the plant needs the targets that were sent to the drives, and the log has none")
        self.drives, self.log = drives, log
        # Windows that are spread over the log; the first second has the start's motion.
        count = round(_WINDOW_S / drives.model.opt.timestep)
        begin, end = log.state_t[0] + 0.3, min(log.state_t[-1], log.t[-1]) - _WINDOW_S - 0.01
        moved = np.linspace(begin, max(begin, end), _WINDOWS)
        first = np.unique(np.clip(np.searchsorted(log.state_t, moved), 1, len(log.state_t) - 2))
        self.starts = first[log.state_t[first] + _WINDOW_S <= log.state_t[-1] + 1e-9]
        if drives.free and log.quat is not None:  # a robot that lies touches the ground with what the model may lack
            self.starts = self.starts[matrices(log.quat[self.starts])[:, 2, 2] > _UPRIGHT]
        if len(self.starts) < 3:
            raise UsageError("the log has less than 1 s of an upright robot, too little for a replay")
        self.step_t = np.arange(count) * drives.model.opt.timestep
        self.initial = np.array([self._state(k) for k in self.starts])
        # Measurements at the ends of steps.
        after = log.state_t[self.starts][:, None] + self.step_t[None] + drives.model.opt.timestep
        self.measured = np.stack([np.interp(after, log.state_t, q) for q in log.q.T], -1)
        near = np.abs(log.state_t[np.searchsorted(log.state_t, after).clip(0, len(log.state_t) - 1)] - after)
        self.used = near < 0.6 * drives.model.opt.timestep
        self.used = self.used if self.used.any(1).all() else np.ones_like(self.used)
        travel = np.sqrt(np.mean((self.measured - log.q[self.starts][:, None]) ** 2, (0, 1)))
        self.scale = np.maximum(travel, 0.3 * np.median(travel) + 1e-4)
        self._threads = [mujoco.MjData(drives.model) for _ in range(min(2, os.cpu_count() or 1))]
        self._errors: dict[Plant, np.ndarray] = {}

    @cached_property
    def asked(self) -> np.ndarray:
        """The largest torques that the targets ask for ``(J,)`` [N m]."""
        torque = self.drives.torque(known(self.log.target), self.log.at_steps("q"), self.log.at_steps("dq"))
        return np.quantile(np.abs(torque), 0.99, axis=0) + 1e-6

    def _state(self, k: int) -> np.ndarray:
        """Return MuJoCo's full physics state at a measurement; a free base stands on its lowest points."""
        d, log = self.drives, self.log
        data = mujoco.MjData(d.model)
        data.qpos[d.qpos], data.qvel[d.dof] = log.q[k], log.dq[k]
        if d.free:
            data.qpos[:3] = 0.0
            if log.quat is not None:
                data.qpos[3:7] = log.quat[k] / np.linalg.norm(log.quat[k])
            if log.gyro is not None:
                data.qvel[3:6] = log.gyro[k]
            mujoco.mj_kinematics(d.model, data)
            mujoco.mj_comPos(d.model, data)
            points = lowest_points(d.model, data)
            heights = np.array([p[2] for _, p in points])
            data.qpos[2] = -heights.min() - 0.001
            touching = [(body, p) for (body, p) in points if p[2] < heights.min() + 0.01]
            jacobian, speeds = np.zeros((3, d.model.nv)), []
            for body, point in touching:
                mujoco.mj_jac(d.model, data, jacobian, None, point, body)
                speeds.append(jacobian @ data.qvel)
            data.qvel[:3] = -np.mean(speeds, 0)
            if log.lin_vel is not None and log.quat is not None:
                data.qvel[:3] = matrices(log.quat[k : k + 1])[0] @ log.lin_vel[k]
        state = np.empty(mujoco.mj_stateSize(d.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(d.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return state

    def residuals(self, plant: Plant) -> np.ndarray:
        """Return the simulated angles less the measured ones, as a share of the motion ``(W, T, J)``."""
        from mujoco import rollout

        log, d = self.log, self.drives
        times = log.state_t[self.starts][:, None] + self.step_t[None] - plant.delay_s + 1e-6
        control = known(log.target)[np.clip(np.searchsorted(log.t, times, side="right") - 1, 0, len(log.t) - 1)]
        state, _ = rollout.rollout(d.with_plant(plant, self.asked), self._threads, self.initial, control)
        error = (np.asarray(state)[:, :, 1 + d.qpos] - self.measured) / self.scale
        return np.where(self.used[:, :, None], np.nan_to_num(error, nan=9.0), 0.0)

    def error(self, plant: Plant) -> float:
        """Return the mean error of the replay as a share of the joints' motion; each counts at most 1.5."""
        return float(self.errors(plant).sum() / (self.used.sum() * len(self.scale)))

    def errors(self, plant: Plant) -> np.ndarray:
        """Return the errors of windows and joints ``(W, J)``, summed over their used rows."""
        if plant not in self._errors:
            self._errors[plant] = np.minimum(np.abs(self.residuals(plant)), 1.5).sum(1)
        return self._errors[plant]

    def mixed(self, plants: Sequence[Plant]) -> Plant:
        """Return the first plant, in which each joint has the limit under which it moves best.

        A joint has one only if that explains a tenth of its error.
        """
        limits = np.array([p.limits or (np.inf,) * len(self.scale) for p in plants])
        errors = np.array([self.errors(p).sum(0) for p in plants]) * np.where(np.isinf(limits), 0.9, 1.0)
        chosen = np.take_along_axis(limits, errors.argmin(0)[None], 0)[0]
        return replace(plants[0], limits=tuple(chosen.tolist()) if np.isfinite(chosen).any() else ())

    def _near(self, plant: Plant, name: str) -> list[Plant]:
        value = getattr(plant, name)
        if name == "limits":
            moved = [replace(plant, limits=tuple(f * v for v in value)) for f in (0.87, 0.93, 1.07, 1.15)]
            return [self.mixed([plant, *moved])]
        values = value * np.array([0.85, 0.93, 1.07, 1.17])
        if name == "payload":
            values = value + np.array([-0.05, 0.05])
        if name == "delay_s":
            values = np.maximum(0.0, value + np.array([-0.006, -0.002, -0.001, 0.001, 0.002, 0.006]))
        return [replace(plant, **{name: float(v)}) for v in values]

    def polished(self, plant: Plant, names: Sequence[str], sweeps: int = 3) -> Plant:
        """Return the best plant near one, one parameter after the other."""
        for _ in range(sweeps):
            before = plant
            for name in names:
                plant = min((plant, *self._near(plant, name)), key=self.error)
            if plant == before:
                break
        return plant

    def fit(self, start: Plant, name: str = "", delays: Sequence[float] = GRIDS["delay_s"]) -> Plant:
        """Return the best plant with another delay and damping, and another value of one parameter, if it is named."""
        tried = [replace(start, delay_s=d) for d in delays]
        if name == "limits":
            # Other gains of one joint, which are no fault, look like its limit.
            gains = [{"kp": p * start.kp, "kd": d * start.kd} for p in (0.85, 1.0, 1.18) for d in (0.7, 1.0, 1.4)]
            changes = [{"limits": (f,) * len(self.scale)} for f in GRIDS["limits"]] + gains
            tried = [self.mixed([s, *(replace(s, **change) for change in changes)]) for s in tried]
        elif name:
            tried = [replace(s, **{name: v}) for s in tried for v in (getattr(s, name), *GRIDS[name])]
        best = min(tried, key=self.error)
        if name not in ("friction", "payload"):
            return self.polished(best, ["delay_s", *([name] if name else []), "kd"])
        if self.error(best) > 0.9 * self.error(start):
            return start
        return self.polished(best, [name, "delay_s", *(["kp"] if start.kp != 1.0 else [])], 2)

    def fit_all(self) -> Plant:
        """Return the plant with as few changes as explain the motion."""
        best = self.fit(_NOMINAL)
        for names, clear in ((["kp", "limits"], 0.93), (["friction"], 0.85), (["payload"], 0.85)):
            while names:
                # Soft or limited drives look late and damped at first.
                start, delays = best, [best.delay_s]
                if names[0] in ("kp", "limits"):
                    start, delays = replace(best, kd=1.0), [0.004, 0.011, 0.018, best.delay_s, 0.6 * best.delay_s]
                tried = {name: self.fit(start, name, delays) for name in names}
                name = min(names, key=lambda n: self.error(tried[n]))
                if self.error(tried[name]) > clear * self.error(best):
                    break
                best, clear = tried[name], 0.85
                names.remove(name)
        return best


def lowest_points(model: Any, data: Any) -> list[tuple[int, np.ndarray]]:
    """Return body and lowest point of each geom that can touch the ground."""
    points = []
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    for i in range(model.ngeom):
        body = int(model.geom_bodyid[i])
        if body == 0 or not (model.geom_contype[i] or model.geom_conaffinity[i]):
            continue
        if int(model.geom_type[i]) == int(mujoco.mjtGeom.mjGEOM_SPHERE):
            points.append((body, data.geom_xpos[i] - [0, 0, model.geom_size[i, 0]]))
            continue
        box = model.geom_aabb[i, :3] + corners * model.geom_aabb[i, 3:]
        world = data.geom_xpos[i] + box @ data.geom_xmat[i].reshape(3, 3).T
        points.append((body, world[np.argmin(world[:, 2])]))
    return points


@dataclass(frozen=True)
class _Part:
    """A parameter of the plant: the fault that it may be, and how clearly the replay must speak for it."""

    fault: str
    text: str
    off: Callable[[Any], bool]
    clear: float = 1.08


_PARTS = {
    "kp": _Part("gain", "the drives are {kp:.2f} times as stiff as the contract says",
                lambda kp: not 0.72 <= kp <= 1.4),
    "limits": _Part("torque limit", "torque is clipped: {clipped}", bool, 1.2),
    "delay_s": _Part("delay", "motion follows a target after {ms:.0f} ms; the training had {trained}",
                     lambda later_s: later_s > _LATER_S),
    "friction": _Part("friction", "the joints have {friction:.1f} times the model's friction", lambda f: f > 3.0, 1.25),
    "payload": _Part("payload", "the robot carries {payload:+.0%} of its mass beside the model's",
                     lambda share: abs(share) > 0.12, 1.25),
}  # fmt: skip
"""Parameter -> its fault; it is one if ``off`` says so (of a delay: of what is more than in training), and the
replay's error grows by the factor ``clear`` with the model's value."""


def solve_plant(
    drives: Drives, log: Log, contract: Contract, trained_delay_s: float | None = None
) -> tuple[list[Finding], dict[str, Any]]:
    """Return what is wrong with the plant, and figures of the replay.

    Args:
        trained_delay_s: Delay of the training; default: the contract's.
    """
    replay = Replay(drives, log)
    fitted = replay.fit_all()
    trained = contract.delay_s if trained_delay_s is None else trained_delay_s
    base, best = replay.error(replace(_NOMINAL, delay_s=trained or 0.0)), replay.error(fitted)
    age_s = 0.0 if log.rows_are_steps or log.age_s is None else float(np.median(log.age_s))
    delay_s = fitted.delay_s + age_s
    limits = np.array(fitted.limits or [np.inf] * len(contract.joints))
    torques = limits * replay.asked
    low = torques < _LOWER * drives.limit
    limited = [f"{contract.joints[i]} at {torques[i]:.3g} N m" for i in np.flatnonzero(low)]
    known_ms = "none that is known" if trained is None else f"{1e3 * trained:.0f} ms"
    findings = []
    for name, part in _PARTS.items():
        value, usual = getattr(fitted, name), getattr(_NOMINAL, name)
        differs = value
        if name == "limits":
            usual, differs = tuple(np.where(low, np.inf, limits).tolist()), limited
        elif name == "delay_s":
            usual, differs = max(0.0, (trained or 0.0) - age_s), delay_s - (0.010 if trained is None else trained)
        if not part.off(differs):
            continue
        others = [n for n in ("kp", "delay_s", "kd") if n != name and getattr(fitted, n) != 1.0]
        without = replay.error(replay.polished(replace(fitted, **{name: usual}), others, 2))
        if without < part.clear * best:
            continue
        text = part.text.format(ms=1e3 * delay_s, trained=known_ms, clipped=shortened(limited), **vars(fitted))
        share = float(np.clip((without - best) / max(base, best, 1e-9), 0.0, 1.0))
        question, number = "timing" if name == "delay_s" else "plant", torques.min() if name == "limits" else value
        findings.append(Finding(part.fault, question, text, share, {name: float(number)}))
    nominal = replace(_NOMINAL, delay_s=fitted.delay_s)
    per_joint = [np.abs(replay.residuals(p)).mean((0, 1)) for p in (nominal, fitted)]
    figures = {
        "error": base, "error_fitted": best, "delay_s": delay_s,
        **{n: getattr(fitted, n) for n in ("kp", "kd", "friction", "payload")},
        "joints": {j: [float(a), float(b)] for j, a, b in zip(contract.joints, *per_joint, strict=True)},
        "parting": parting(replay, fitted, contract.joints),
    }  # fmt: skip
    return findings, figures


def parting(replay: Replay, plant: Plant, joints: Sequence[str]) -> dict[str, Any]:
    """Return the first window in which the fitted model leaves the robot, its worst joint, and both ways."""
    error = np.abs(replay.residuals(plant)).mean(1)
    limit = max(4.0 * float(np.median(error)), 0.3)
    worse = np.flatnonzero(error.max(1) > limit)
    first = int(worse[0]) if len(worse) else int(np.argmax(error.max(1)))
    joint = int(np.argmax(error[first]))
    k, d = replay.starts[first], replay.drives
    simulated = replay.residuals(plant)[first, :, joint] * replay.scale[joint] + replay.measured[first, :, joint]
    return {
        "time_s": float(replay.log.state_t[k]), "joint": joints[joint], "apart": bool(len(worse)),
        "error": float(error[first, joint]), "t": (replay.step_t + d.model.opt.timestep).tolist(),
        "measured": replay.measured[first, :, joint].tolist(),
        "simulated": [float(v) if ok else None for v, ok in zip(simulated, replay.used[first], strict=True)],
    }  # fmt: skip
