"""The plant question: the logged commands replayed through the model, in short windows from where the robot was."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco as mujoco_c
import numpy as np

from sim2real.doctor.contract import Contract
from sim2real.doctor.log import Log
from sim2real.doctor.solve import Finding, matrices
from sim2real.errors import UsageError

_STEP_S, _WINDOW_S, _WINDOWS = 0.0025, 0.2, 40
_LATER_S = 0.010
"""A delay that is longer by this than that of the training is a fault [s]; a training without a known delay had none,
and the first 10 ms are those of any robot."""
_UPRIGHT = 0.8
"""Cosine of the tilt up to which a free robot stands."""
_GAIN_BAND = (0.72, 1.4)
_CLEAR = 1.08
"""A parameter is at fault if the replay's error grows by this factor with the model's value."""


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
}
_LIMITS = (0.05, 0.08, 0.12, 0.17, 0.24, 0.33, 0.45, 0.6)
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
        for joint, p, d in zip(contract.joints, self.kp, self.kd, strict=True):
            actuator = spec.add_actuator(name=f"doctor_{joint}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.gainprm[0] = p
            if not self.torque_driven:
                actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
                actuator.biasprm[1:3] = -p, -d
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
        self._known: dict[Plant, np.ndarray] = {}

    @cached_property
    def asked(self) -> np.ndarray:
        """The largest torques that the targets ask for ``(J,)`` [N m]."""
        q, dq, target = self.log.at_steps("q"), self.log.at_steps("dq"), self.log.target
        assert target is not None
        torque = target if self.drives.torque_driven else self.drives.kp * (target - q) - self.drives.kd * dq
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
        if plant not in self._known:
            from mujoco import rollout

            log, d = self.log, self.drives
            assert log.target is not None
            times = log.state_t[self.starts][:, None] + self.step_t[None] - plant.delay_s + 1e-6
            control = log.target[np.clip(np.searchsorted(log.t, times, side="right") - 1, 0, len(log.t) - 1)]
            model = d.with_plant(plant, self.asked)
            state, _ = rollout.rollout(model, self._threads, self.initial, control)
            angles = np.asarray(state)[:, :, 1 + d.qpos]
            error = np.nan_to_num((angles - self.measured) / self.scale, nan=9.0)
            self._known[plant] = np.where(self.used[:, :, None], error, 0.0)
        return self._known[plant]

    def error(self, plant: Plant) -> float:
        """Return the mean error of the replay as a share of the joints' motion; each counts at most 1.5."""
        return float(np.minimum(np.abs(self.residuals(plant)), 1.5).sum() / (self.used.sum() * len(self.scale)))

    def polished(self, plant: Plant, names: Sequence[str], sweeps: int = 3) -> Plant:
        """Return the best plant near one, one parameter after the other."""
        for _ in range(sweeps):
            before = plant
            for name in names:
                values = _near(name, getattr(plant, name))
                plant = min((plant, *(replace(plant, **{name: float(v)}) for v in values)), key=self.error)
            if plant == before:
                break
        return plant

    def fit(self, start: Plant, name: str = "", delays: Sequence[float] = GRIDS["delay_s"]) -> Plant:
        """Return the best plant with another delay, and with another value of one parameter, if one is named."""
        values = [getattr(start, name), *GRIDS[name]] if name else [0.0]
        grid = [replace(start, delay_s=d, **({name: float(v)} if name else {})) for d in delays for v in values]
        return self.polished(min(grid, key=self.error), ["delay_s", *([name] if name else []), "kd"])

    def fit_limits(self, start: Plant, delays: Sequence[float]) -> Plant:
        """Return the best plant with torque limits: a joint's own motion decides about its limit."""
        best = start
        each = lambda plant: np.minimum(np.abs(self.residuals(plant)), 1.5).mean((0, 1))  # noqa: E731
        for delay_s in delays:
            free = replace(start, delay_s=delay_s, limits=())
            tried = np.array([each(replace(free, limits=(f,) * len(self.scale))) for f in _LIMITS])
            found = np.where(tried.min(0) < 0.9 * each(free), np.array(_LIMITS)[tried.argmin(0)], np.inf)
            if np.isfinite(found).any():
                best = min(best, replace(free, limits=tuple(found)), key=self.error)
        for factor in (0.87, 1.15, 0.93, 1.07) if best.limits else ():
            moved = replace(best, limits=tuple(factor * v for v in best.limits))
            better = each(moved) < each(best)
            mixed = replace(best, limits=tuple(np.where(better, moved.limits, best.limits)))
            best = min(best, mixed, key=self.error)
        return self.polished(best, ["delay_s", "kd"])

    def fit_all(self) -> Plant:
        """Return the plant with as few changes as explain the motion."""
        plant = self.fit(_NOMINAL)
        # Soft or limited drives look late at first, so their own fit looks at shorter delays too.
        near = sorted({0.004, 0.011, 0.018, plant.delay_s, 0.6 * plant.delay_s})
        softer, limited = self.fit(_NOMINAL, "kp", near), self.fit_limits(_NOMINAL, near)
        best = min(softer, limited, key=self.error)
        if self.error(best) > 0.93 * self.error(plant):
            best = plant
        else:
            more = self.fit_limits(best, near) if best.kp != 1.0 else self.fit(best, "kp", near)
            best = more if self.error(more) < 0.85 * self.error(best) else best
        for name in ("friction", "payload"):
            more = min((replace(best, **{name: v}) for v in GRIDS[name]), key=self.error)
            if self.error(more) < 0.9 * self.error(best):
                more = self.polished(more, [name, "delay_s", *(["kp"] if best.kp != 1.0 else [])], 2)
                best = more if self.error(more) < 0.85 * self.error(best) else best
        return best


def _near(name: str, value: float) -> np.ndarray:
    if name == "delay_s":
        return np.maximum(0.0, value + np.array([-0.006, -0.002, -0.001, 0.001, 0.002, 0.006]))
    if name == "payload":
        return value + np.array([-0.05, 0.05])
    return value * np.array([0.85, 0.93, 1.07, 1.17])


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


_TEXTS = {
    "kp": ("gain", "the drives are {kp:.2f} times as stiff as the contract says"),
    "limits": ("torque limit", "torque is clipped: {clipped}"),
    "delay_s": ("delay", "motion follows a target after {ms:.0f} ms; the training had {trained}"),
    "friction": ("friction", "the joints have {friction:.1f} times the model's friction"),
    "payload": ("payload", "the robot carries {payload:+.0%} of its mass beside the model's"),
}


def solve_plant(
    drives: Drives, log: Log, contract: Contract, trained_delay_s: float | None = None
) -> tuple[list[Finding], dict[str, Any]]:
    """Return what is wrong with the plant, and figures of the replay.

    Args:
        trained_delay_s: Delay of the training; default: the contract's.
    """
    replay = Replay(drives, log)
    trained = contract.delay_s if trained_delay_s is None else trained_delay_s
    fitted = replay.fit_all()
    nominal = replace(_NOMINAL, delay_s=fitted.delay_s)
    base, best = replay.error(replace(_NOMINAL, delay_s=trained or 0.0)), replay.error(fitted)
    age_s = 0.0 if log.rows_are_steps else _age_s(log)
    findings = []
    for name, (fault, words) in _TEXTS.items():
        value = getattr(fitted, name)
        if not _is_off(name, value, fitted.delay_s + age_s, trained):
            continue
        others = [n for n in ("kp", "delay_s", "kd") if n != name and getattr(fitted, n) != 1.0]
        usual = getattr(_NOMINAL, name) if name != "delay_s" else max(0.0, (trained or 0.0) - age_s)
        without = replay.polished(replace(fitted, **{name: usual}), others, 2)
        factor = replay.error(without) / max(best, 1e-9)
        if factor < (_CLEAR if name in ("kp", "limits", "delay_s") else 1.25):
            continue
        known = f"{1e3 * trained:.0f} ms" if trained is not None else "none that is known"
        torques = replay.asked * fitted.limits if fitted.limits else replay.asked
        clipped = ", ".join(
            f"{j} at {t:.3g} N m" for j, t in zip(contract.joints, torques, strict=True) if np.isfinite(t)
        )
        text = words.format(ms=1e3 * (fitted.delay_s + age_s), trained=known, clipped=clipped, **vars(fitted))
        value = value if name != "limits" else min(value)
        share = float(np.clip((replay.error(without) - best) / max(base, best), 0.0, 1.0))
        findings.append(Finding(fault, "timing" if name == "delay_s" else "plant", text, share, {name: float(value)}))
    per_joint = [np.abs(replay.residuals(p)).mean((0, 1)) for p in (nominal, fitted)]
    figures = {
        "error": base, "error_fitted": best, "delay_s": fitted.delay_s + age_s,
        **{n: getattr(fitted, n) for n in ("kp", "kd", "friction", "payload")},
        "joints": {j: [float(a), float(b)] for j, a, b in zip(contract.joints, *per_joint, strict=True)},
        "parting": parting(replay, fitted, contract.joints),
    }  # fmt: skip
    return findings, figures


def _is_off(name: str, value: Any, delay_s: float, trained: float | None) -> bool:
    if name == "delay_s":
        return delay_s > (0.010 if trained is None else trained) + _LATER_S
    if name == "kp":
        return not _GAIN_BAND[0] <= value <= _GAIN_BAND[1]
    if name == "limits":
        return bool(value)
    return value > 3.0 if name == "friction" else abs(value) > 0.12


def _age_s(log: Log) -> float:
    rows = np.searchsorted(log.state_t, log.t + 1e-6, side="right") - 1
    return float(np.median(log.t - log.state_t[np.clip(rows, 0, len(log.state_t) - 1)]))


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
