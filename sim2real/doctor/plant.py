"""The plant question: the logged commands replayed through the model, in short windows from where the robot was."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco as mujoco_c
import numpy as np

from sim2real.doctor.contract import Contract
from sim2real.doctor.deployed import known, matrices
from sim2real.doctor.log import Log
from sim2real.doctor.search import Candidate, Dial, Finding, Setting, explain, shortened
from sim2real.errors import UsageError

_STEP_S, _WINDOW_S, _WINDOWS = 0.0025, 0.2, 40
_LATER_S = 0.010
"""A delay that is longer by this than that of the training is a fault [s]; a training without a known delay had none,
and the first 10 ms are those of any robot."""
_LOWER = 0.75
"""A torque limit is a fault if it is below this share of the model's: drives that lag look limited a little earlier."""
_UPRIGHT = 0.8
"""Cosine of the tilt up to which a free robot stands."""
mujoco: Any = mujoco_c  # its C module has no stubs


@dataclass(frozen=True)
class Plant(Setting):
    """How drives and bodies differ from the model.

    Its numbers: ``delay_s`` from a target in the log to the motion in the log [s]; ``kp``, ``kd``: factors beside the
    contract's gains; ``friction``: dry friction beside the model's, a share of the largest torques that are asked for;
    ``armature``: inertia beside the model's, a share of it; ``payload``: mass of the loaded body beside the model's,
    a share of the robot's. Of one joint: ``kp JOINT``, and ``limit JOINT``, a share of its largest torque.
    """


@dataclass(frozen=True)
class _Part:
    """A number of the plant: what the model says, and when another value is a fault.

    It is one only if the replay without it has a clearly larger error, with all others estimated again.
    """

    dial: Dial
    usual: float
    is_off: Callable[[float], bool]


_FACTORS = np.array((0.85, 0.93, 1.07, 1.17))
_PARTS = {
    "kp": _Part(Dial("gain", "the drives are {value:.2f} times as stiff as the contract says",
                     (0.35, 0.5, 0.65, 0.8, 1.25, 1.6, 2.2), lambda f: f * _FACTORS, 0.07),
                1.0, lambda f: not 0.72 <= f <= 1.4),
    "friction": _Part(Dial("friction", "the joints have more dry friction than the model: {value:.0%} of their largest "
                           "torque", (-0.1, 0.05, 0.1, 0.2, 0.4), lambda f: f + np.array((-0.03, -0.01, 0.01, 0.03)),
                           0.2),
                      0.0, lambda share: share > 0.08),
    "armature": _Part(Dial("armature", "the joints have {value:+.0%} of their inertia beside the model's",
                           (-0.4, 0.5, 1.0, 2.0, 4.0), lambda f: f + np.array((-0.3, -0.1, 0.1, 0.3)), 0.2),
                      0.0, lambda share: abs(share) > 0.45),
    "payload": _Part(Dial("payload", "the robot carries {value:+.0%} of its mass beside the model's",
                          (-0.1, 0.1, 0.2, 0.4), lambda f: f + np.array((-0.05, -0.02, 0.02, 0.05)), 0.2),
                     0.0, lambda share: abs(share) > 0.2),
}  # fmt: skip
_DELAY = Dial("delay", "", (0.0, 0.007, 0.014, 0.021, 0.028, 0.035, 0.045, 0.06),
              lambda s: np.maximum(0.0, s + np.array((-0.005, -0.0015, 0.0015, 0.005))))  # fmt: skip
_DAMPING = Dial("", "", (1.0,), lambda f: f * np.array((0.8, 1.25)))


def _of_one(joint: str) -> _Part:
    """Return the gain of one joint."""
    text = f"{joint} is {{value:.2f}} times as stiff as the contract says"
    return replace(_PARTS["kp"], dial=replace(_PARTS["kp"].dial, text=text))


_LIMITS = (0.05, 0.08, 0.12, 0.17, 0.24, 0.33, 0.45, 0.6)
_NUISANCE = (_DELAY.move("delay_s"), _DAMPING.move("kd"))
"""Delay and damping of drives are estimated with anything else."""


_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def driven_joints(mjcf: Path) -> list[str]:
    """Return the joints of a model that drives turn, in the order of its actuators, or of its joints without any."""
    model = read_model(mjcf)
    of_actuators = [int(model.actuator_trnid[i, 0]) for i in range(model.nu)]
    single = [i for i in range(model.njnt) if int(model.jnt_type[i]) in _TURNING]
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
        self.joints, ids = contract.joints, [names.index(j) for j in contract.joints]
        own = {int(given.actuator_trnid[i, 0]): i for i in range(given.nu)}
        kp, kd = (contract.per_joint(n) if getattr(contract, n) not in ((), {}) else None for n in ("kp", "kd"))
        if contract.drive == "torque":
            kp, kd = np.ones(len(ids)), np.zeros(len(ids))
        elif kp is None:
            gains = [-given.actuator_biasprm[own[i], 1] if i in own else 0.0 for i in ids]  # 0 for a motor
            biases = [-given.actuator_biasprm[own[i], 2] if i in own else 0.0 for i in ids]
            if min(gains) <= 0.0:
                raise UsageError("neither the contract nor the model has gains of the drives",
                                 hint='add kp and kd to the contract, or drive = "torque"')  # fmt: skip
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
        self.inertia = self.model.dof_M0[self.dof]
        # Other joints, such as the arms of a walking robot, have controllers of their own.
        others = [i for i in range(given.njnt) if int(given.jnt_type[i]) in _TURNING and i not in ids]
        self.still = [names[i] or f"number {i}" for i in others]
        dofs = given.jnt_dofadr[others]
        self.model.dof_damping[dofs] = 1e4 * self.model.dof_M0[dofs]
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
        per_joint = lambda name, usual: np.array([plant.number(f"{name} {j}", usual) for j in self.joints])  # noqa: E731
        kp = self.kp * plant.number("kp") * per_joint("kp", 1.0)
        model.actuator_gainprm[:, 0] = kp
        if not self.torque_driven:
            model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -kp, -self.kd * plant.number("kd")
        limit = np.minimum(self.limit, asked * per_joint("limit", np.inf))
        model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1] = -limit, limit
        friction = model.dof_frictionloss[self.dof] + plant.number("friction", 0.0) * asked
        model.dof_frictionloss[self.dof] = np.maximum(0.0, friction)
        model.dof_armature[self.dof] += np.maximum(-model.dof_armature[self.dof],
                                                   plant.number("armature", 0.0) * self.inertia)  # fmt: skip
        model.body_mass[self.loaded] += plant.number("payload", 0.0) * float(self.model.body_mass.sum())
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
        begin, end = max(log.state_t[0], log.t[0]) + 0.3, min(log.state_t[-1], log.t[-1]) - _WINDOW_S - 0.01
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

    def rolled(self, plant: Plant) -> np.ndarray:
        """Return the simulated states of the windows ``(W, T, 1 + nq + nv)``."""
        from mujoco import rollout

        log, target, h = self.log, known(self.log.target), self.drives.model.opt.timestep
        # The mean of the targets over each step of the simulation, so that a delay acts below its step.
        times = log.state_t[self.starts][:, None] + self.step_t[None] - plant.number("delay_s", 0.0)
        knots = np.concatenate([log.t[:1] - 1.0, log.t, log.t[-1:] + 1.0])
        held = np.concatenate([target[:1], target])
        area = np.concatenate([np.zeros((1, len(self.scale))), np.cumsum(held * np.diff(knots)[:, None], axis=0)])
        until = lambda at: np.stack([np.interp(at, knots, column) for column in area.T], -1)  # noqa: E731
        control = (until(times + h) - until(times)) / h
        model = self.drives.with_plant(plant, self.asked)
        return np.asarray(rollout.rollout(model, self._threads, self.initial, control)[0])

    def residuals(self, plant: Plant) -> np.ndarray:
        """Return the simulated angles less the measured ones, as a share of the motion ``(W, T, J)``."""
        error = (self.rolled(plant)[:, :, 1 + self.drives.qpos] - self.measured) / self.scale
        return np.where(self.used[:, :, None], np.nan_to_num(error, nan=9.0), 0.0)

    def error(self, plant: Plant) -> float:
        """Return the mean error of the replay as a share of the joints' motion; each counts at most 1.5."""
        return float(self.errors(plant).mean())

    def errors(self, plant: Plant) -> np.ndarray:
        """Return the mean errors of the joints ``(J,)``."""
        if plant not in self._errors:
            error = np.minimum(np.abs(self.residuals(plant)), 1.5)
            self._errors[plant] = error.sum((0, 1)) / self.used.sum()
        return self._errors[plant]

    def sag(self, plant: Plant) -> np.ndarray:
        """Return how far the joints of the robot are from the model's at the ends of the windows, with sign [rad]."""
        last = self.used.shape[1] - 1 - np.argmax(self.used[:, ::-1], axis=1)
        return -np.median(self.residuals(plant)[np.arange(len(last)), last], axis=0) * self.scale

    def candidates(self, plant: Plant) -> Iterator[Candidate[Plant]]:
        """Return what may be wrong beside what is known already."""
        delay_s, there = plant.number("delay_s", 0.0), dict(plant.numbers)
        # Soft or limited drives look late and damped at first.
        starts = [plant, *(plant.having("kd", 1.0).having("delay_s", d) for d in (delay_s, 0.011, 0.6 * delay_s))]
        for name, part in _PARTS.items():
            if name in there or (name == "kp" and self.drives.torque_driven):
                continue
            for start in starts if name == "kp" else starts[:1]:
                yield from part.dial.candidates(start, name, _NUISANCE)
            if name == "kp" and len(self.scale) > 1:
                # The joint that moves better with drives of another stiffness may be weak alone.
                of_all = [self.errors(plant.having("kp", f * plant.number("kp"))) for f in part.dial.grid]
                better = self.errors(plant) - np.min(of_all, axis=0)
                joint = self.drives.joints[int(np.argmax(better))]
                if better.max() > 0.0 and f"kp {joint}" not in there:
                    yield from _of_one(joint).dial.candidates(plant, f"kp {joint}", _NUISANCE)
        if any(name.startswith("limit") for name in there):
            return
        text = lambda at: f"torque is clipped: {shortened(list(self.limited(at).values()))}"  # noqa: E731
        for start in starts:
            # Other gains of one joint, which are no fault, look like its limit.
            gains = [start.having("kp", p * start.number("kp")).having("kd", d * start.number("kd"))
                     for p, d in ((0.85, 1.0), (1.18, 1.0), (1.0, 0.7), (1.0, 1.4))]  # fmt: skip
            limits = [self._all_limited(start, (f,) * len(self.scale)) for f in _LIMITS]
            yield Candidate(
                "torque limit", self._mixed([start, *limits, *gains]), text, [self._near_limits, *_NUISANCE]
            )

    def _limits(self, plant: Plant) -> np.ndarray:
        return np.array([plant.number(f"limit {joint}", np.inf) for joint in self.drives.joints])

    def _all_limited(self, plant: Plant, limits: Sequence[float]) -> Plant:
        for joint, limit in zip(self.drives.joints, limits, strict=True):
            plant = plant.having(f"limit {joint}", float(limit)) if np.isfinite(limit) else plant
        return plant

    def _mixed(self, plants: Sequence[Plant]) -> Plant:
        """Return the first plant, in which each joint has the limit under which it moves best.

        A joint has one only if that explains a tenth of its error.
        """
        limits = np.array([self._limits(p) for p in plants])
        errors = np.array([self.errors(p) for p in plants]) * np.where(np.isinf(limits), 0.9, 1.0)
        return self._all_limited(plants[0], np.take_along_axis(limits, errors.argmin(0)[None], 0)[0].tolist())

    def _near_limits(self, plant: Plant) -> list[Plant]:
        moved = [self._all_limited(plant, (f * self._limits(plant)).tolist()) for f in (0.87, 0.93, 1.07, 1.15)]
        return [self._mixed([plant, *moved])]

    def limited(self, plant: Plant) -> dict[str, str]:
        """Return the joints whose torque limit is well below the model's, with the limit in words."""
        torques = zip(self.drives.joints, self._limits(plant) * self.asked, self.drives.limit, strict=True)
        return {joint: f"{joint} at {nm:.3g} N m" for joint, nm, of_model in torques if nm < _LOWER * of_model}


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


def solve_plant(
    drives: Drives, log: Log, contract: Contract, trained_delay_s: float | None = None
) -> tuple[list[Finding], dict[str, Any]]:
    """Return what is wrong with the plant, and figures of the replay.

    Args:
        trained_delay_s: Delay of the training; default: the contract's.
    """
    replay = Replay(drives, log)
    start = min(_DELAY.candidates(Plant(), "delay_s", _NUISANCE), key=lambda c: replay.error(c.setting))
    start = start.descended(replay.error)
    chosen = [start, *explain(start.setting, replay.error, replay.candidates, 0.0, dear=True)]
    fitted = chosen[-1].setting
    trained = contract.delay_s if trained_delay_s is None else trained_delay_s
    age_s = 0.0 if log.rows_are_steps or log.age_s is None else float(np.median(log.age_s))
    nominal = Plant().having("delay_s", max(0.0, (trained or 0.0) - age_s))
    delay_s, base, best = fitted.number("delay_s", 0.0) + age_s, replay.error(nominal), replay.error(fitted)
    numbers, low = dict(fitted.numbers), replay.limited(fitted)
    # What may be a fault: its name, sentence, numbers, value, and share of the error without it.
    suspects = [
        (part.dial.fault, part.dial.says(name)(fitted), [name], numbers[name], 0.07 if name == "kp" else 0.2)
        for name, part in {**_PARTS, **{f"kp {j}": _of_one(j) for j in drives.joints}}.items()
        if name in numbers and part.is_off(numbers[name])
    ]
    if low:
        text, names = f"torque is clipped: {shortened(list(low.values()))}", [f"limit {j}" for j in low]
        suspects.append(("torque limit", text, names, min(numbers[n] for n in names), 0.17))
    if delay_s - (0.010 if trained is None else trained) > _LATER_S:
        of_training = "none that is known" if trained is None else f"{1e3 * trained:.0f} ms"
        text = f"motion follows a target after {1e3 * delay_s:.0f} ms; the training had {of_training}"
        suspects.append(("delay", text, ["delay_s"], delay_s, 0.07))
    findings = []
    for fault, text, names, value, least in suspects:
        # The others are estimated again without it.
        rest = Plant(tuple((n, v) for n, v in fitted.numbers if n not in names))
        moves = [_NUISANCE[1], *([_PARTS["kp"].dial.move("kp")] if "kp" in dict(rest.numbers) else [])]
        if names == ["delay_s"]:
            rest = rest.having("delay_s", nominal.number("delay_s", 0.0))
        else:
            moves.append(_NUISANCE[0])
        gap = replay.error(rest) - best
        rest = replace(start, setting=rest, moves=moves).descended(replay.error).setting
        joints = [i for i, j in enumerate(drives.joints) if f"kp {j}" in names] or list(range(len(drives.joints)))
        without, with_it = (float(replay.errors(p)[joints].mean()) for p in (rest, fitted))
        if with_it <= (1.0 - least) * without:
            share = float(np.clip(gap / max(base - best, gap, 1e-9), 0.0, 1.0))
            question = "timing" if fault == "delay" else "plant"
            findings.append(Finding(fault, question, text, share, {names[0].split()[0]: float(value)}))
    nominal = nominal.having("delay_s", fitted.number("delay_s", 0.0))
    figures = {
        "error": base, "error_fitted": best, "delay_s": delay_s,
        **{n: fitted.number(n, part.usual) for n, part in _PARTS.items()}, "kd": fitted.number("kd"),
        "joints": {j: [float(a), float(b)] for j, a, b in
                   zip(contract.joints, replay.errors(nominal), replay.errors(fitted), strict=True)},
        "sag_rad": dict(zip(contract.joints, replay.sag(nominal).tolist(), strict=True)),
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
    d, used = replay.drives, replay.used[first]
    state = replay.rolled(plant)[first]
    simulated, measured = state[:, 1 + d.qpos], replay.measured[first]
    poses = []
    for row in np.flatnonzero(used)[np.linspace(0, used.sum() - 1, 5).astype(int)]:
        qpos = state[row, 1 : 1 + d.model.nq]
        robot = qpos.copy()
        robot[d.qpos] = measured[row]
        poses.append([drawn(d.model, robot), drawn(d.model, qpos)])
    return {
        "time_s": float(replay.log.state_t[replay.starts[first]]), "joint": joints[joint], "apart": bool(len(worse)),
        "error": float(error[first, joint]), "t": (replay.step_t[used] + d.model.opt.timestep).tolist(),
        "measured": measured[used, joint].tolist(), "simulated": simulated[used, joint].tolist(), "poses": poses,
    }  # fmt: skip


def drawn(model: Any, qpos: np.ndarray) -> list[list[list[float]]]:
    """Return a line of points (x, y, z) for each body: from its parent's origin to its own, and to its centre."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    parents = np.where(model.body_parentid == 0, np.arange(model.nbody), model.body_parentid)
    return np.round(np.stack([data.xpos[parents], data.xpos, data.xipos], 1)[1:], 4).tolist()
