"""Checks the plant: replays the logged commands through the model, in short windows that start at measured states."""

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
from sim2real.doctor.search import Candidate, Finding, Setting, Suspect, explain, shortened
from sim2real.errors import UsageError

_STEP_S, _WINDOW_S, _WINDOWS = 0.0025, 0.2, 40
_FASTEST = 0.25
"""Share of the windows that begin where the commanded torque is largest: torque limits hardly act elsewhere."""
_LATER_S = 0.010
"""A delay that is longer than the training's by this is a fault [s]. An unknown delay of the training counts as 0, and
any robot has up to 10 ms.
"""
_UPRIGHT = 0.8
"""Cosine of the largest tilt at which a robot with a free base counts as standing."""
_FILM_S, _FRAMES = 1.0, 40
mujoco: Any = mujoco_c  # its C module has no stubs


@dataclass(frozen=True, kw_only=True)
class _Part(Suspect):
    """A number in which a plant may differ from the model; in its text ``who`` is a joint, or the drives.

    It is a fault if its value is off, and the replay without it, with all others estimated again, has a clearly larger
    error.

    Attributes:
        usual: The model's value.
        is_off: Whether a value may be a fault.
        drop: By which share it must lower the error to be a fault.
        of: Whether the number belongs to ``all`` joints, to ``one`` joint, to all or ``one too``, to ``each``, or to
            all and is estimated ``with the rest``.
    """

    usual: float = 0.0
    is_off: Callable[[float], bool]
    least: float = 0.2
    drop: float = 0.2
    of: str = "all"

    def of_joint(self, joint: str) -> _Part:
        """Return the same number for one joint; an empty name: for all."""
        text = str(self.text).replace("{who}", joint or "the drives")
        return replace(self, names=(f"{self.names[0]} {joint}".strip(),), text=text)


_PARTS = {part.names[0]: part for part in (
    _Part("gain", ("kp",), "{who}: {value:.2f} times the contract's stiffness", (0.35, 0.5, 0.65, 0.8, 1.25, 1.6, 2.2),
          lambda f: f * np.array((0.85, 0.93, 1.07, 1.17)), usual=1.0, is_off=lambda f: not 0.72 <= f <= 1.4,
          least=0.07, drop=0.07, of="one too"),
    _Part("friction", ("friction",), "{who}: more dry friction than the model's, by {value:.0%} of the largest torque",
          (-0.1, 0.05, 0.1, 0.2, 0.4), lambda f: f + np.array((-0.03, -0.01, 0.01, 0.03)), is_off=lambda f: f > 0.08,
          of="one too"),
    _Part("armature", ("armature",), "{who}: {value:+.0%} of the inertia beside the model's",
          (-0.4, 0.5, 1.0, 2.0, 4.0), lambda f: f + np.array((-0.3, -0.1, 0.1, 0.3)), is_off=lambda f: abs(f) > 0.45),
    _Part("payload", ("payload",), "the robot carries {value:+.0%} of its mass beside the model's",
          (-0.1, 0.1, 0.2, 0.4), lambda f: f + np.array((-0.05, -0.02, 0.02, 0.05)), is_off=lambda f: abs(f) > 0.2),
    _Part("zero offset", ("zero",), "{who}: it is driven as if its angle were another by {value:+.3f} rad",
          (-0.25, -0.12, -0.05, 0.05, 0.12, 0.25), lambda a: a + np.array((-0.05, -0.015, 0.015, 0.05)),
          is_off=lambda a: abs(a) > 0.06, of="one"),
    _Part("battery", ("fade",), "{who}: stiffness and largest torque fall by {value:.0%} from the log's start on",
          (0.2, 0.4, 0.6), lambda f: np.minimum(f + np.array((-0.1, -0.03, 0.03, 0.1)), 0.95),
          is_off=lambda f: f > 0.2),
    # A limit above three quarters of the model's is no fault: lagging drives seem to be limited a little earlier.
    _Part("torque limit", ("limit",), "torque is clipped: {value}", (0.05, 0.08, 0.12, 0.17, 0.24, 0.33, 0.45, 0.6),
          lambda f: np.outer((0.87, 0.93, 1.07, 1.15), f), usual=np.inf, is_off=lambda f: f < 0.75, least=0.12,
          drop=0.17, of="each"),
    _Part("damping", ("kd",), "{who}: {value:.2f} times the contract's damping", (1.0, 0.2, 0.4, 2.5),
          lambda f: f * np.array((0.8, 1.25)), usual=1.0, is_off=lambda f: not 0.5 <= f <= 2.0, of="with the rest"),
)}  # fmt: skip
"""Name in a setting -> number: factors on the contract's gains, shares of the largest commanded torque (friction,
limit), of the joint's inertia (armature) and of the robot's mass (payload), an angle [rad], and a share of the gains
(fade). ``NAME JOINT`` belongs to one joint; a limit has a number for each joint. ``kd``, and ``delay_s`` from a target
in the log to the motion [s], are estimated together with any other number.
"""
_DELAY = Suspect("delay", ("delay_s",), "", (0.0, 0.007, 0.014, 0.021, 0.028, 0.035, 0.045, 0.06),
                 lambda s: np.maximum(0.0, s + np.array((-0.005, -0.0015, 0.0015, 0.005))))  # fmt: skip
_NUISANCE = (_DELAY.move, _PARTS["kd"].move)


_TURNING = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def driven_joints(mjcf: Path) -> list[str]:
    """Return the driven joints of a model, in the order of its actuators; without actuators, all joints."""
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
        for joint in contract.joints:  # ``with_plant`` sets gains and limits
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
        # Other joints, such as the arms of a walking robot, have other controllers.
        others = [i for i in range(given.njnt) if int(given.jnt_type[i]) in _TURNING and i not in ids]
        self.still = [names[i] or f"number {i}" for i in others]
        dofs = given.jnt_dofadr[others]
        self.model.dof_damping[dofs] = 1e4 * self.model.dof_M0[dofs]
        self.free = self.model.njnt > 0 and int(self.model.jnt_type[0]) == int(mujoco.mjtJoint.mjJNT_FREE)
        # The body that carries a payload: the heaviest of a free robot, the outermost of a fixed robot.
        moved = self.model.jnt_bodyid[[self.model.joint(j).id for j in contract.joints]]
        self.loaded = int(np.argmax(self.model.body_mass)) if self.free else int(moved[-1])

    def torque(self, target: np.ndarray, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the drives' torques for targets [N m]."""
        return target if self.torque_driven else self.kp * (target - q) - self.kd * dq

    def with_plant(self, plant: Setting, asked: np.ndarray, at: float = 0.0) -> Any:
        """Return a copy of the model with the setting's drives.

        Args:
            asked: The largest commanded torques ``(J,)`` [N m].
            at: Time as a share of the log.
        """
        model = copy.copy(self.model)
        each = lambda name, usual: np.array([plant.get(f"{name} {j}", usual) for j in self.joints])  # noqa: E731
        left = 1.0 - at * plant.get("fade", 0.0)
        kp = self.kp * plant.get("kp") * each("kp", 1.0) * left
        model.actuator_gainprm[:, 0] = kp
        if not self.torque_driven:
            model.actuator_biasprm[:, 0] = -kp * each("zero", 0.0)
            model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -kp, -self.kd * plant.get("kd")
        limit = np.minimum(self.limit, asked * np.array(plant.get("limit", np.inf)) * left)
        model.actuator_forcerange[:, 0], model.actuator_forcerange[:, 1] = -limit, limit
        friction = (plant.get("friction", 0.0) + each("friction", 0.0)) * asked
        model.dof_frictionloss[self.dof] = np.maximum(0.0, model.dof_frictionloss[self.dof] + friction)
        armature = np.maximum(-model.dof_armature[self.dof], plant.get("armature", 0.0) * self.inertia)
        model.dof_armature[self.dof] += armature
        model.body_mass[self.loaded] += plant.get("payload", 0.0) * float(self.model.body_mass.sum())
        return model


class Replay:
    """Replays the log's commands through the model.

    Raises:
        UsageError: The log has no targets, or the robot stands for too short a time.
    """

    def __init__(self, drives: Drives, log: Log) -> None:
        if log.target is None:
            raise UsageError(
                "the check of the plant needs the targets that were sent to the drives, but the log has none"
            )
        self.drives, self.log = drives, log
        count = round(_WINDOW_S / drives.model.opt.timestep)
        self.step_t = np.arange(count) * drives.model.opt.timestep
        self.starts = self._windows()
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
        self._errors: dict[Setting, np.ndarray] = {}

    def _windows(self) -> np.ndarray:
        """Return the measurements at which windows begin: spread over the log, and where the torque is largest."""
        log, free = self.log, self.drives.free
        # Skip the begin: a free robot first falls on its feet, and the first targets have not arrived.
        begin, end = max(log.state_t[0], log.t[0]) + (0.3 if free else 0.04), min(log.state_t[-1], log.t[-1] + 0.02)
        rows = np.flatnonzero((log.state_t >= begin) & (log.state_t + _WINDOW_S <= end))
        quat = log.quat if free else None
        if quat is not None:  # a lying robot may touch the ground with parts that the model lacks
            lying = np.cumsum(matrices(quat)[:, 2, 2] < _UPRIGHT)
            last = np.searchsorted(log.state_t, log.state_t[rows] + _WINDOW_S).clip(0, len(lying) - 1)
            rows = rows[lying[last] == lying[rows - 1]]
        if len(rows) < 3 or np.ptp(log.state_t[rows]) < 0.3:
            raise UsageError("the robot stands for less than half a second in the log, too short for a replay")
        fastest = list[int]()
        share = np.abs(self._torque / self.asked).max(1) * (not free)
        for step in np.argsort(-share):
            row = int(rows[np.searchsorted(log.state_t[rows], log.t[step] - 1e-6).clip(0, len(rows) - 1)])
            if len(fastest) == round(_FASTEST * _WINDOWS) or share[step] == 0.0:
                break
            if min((abs(log.state_t[row] - log.state_t[k]) for k in fastest), default=1.0) > 0.5 * _WINDOW_S:
                fastest.append(row)
        spread = rows[np.linspace(0, len(rows) - 1, _WINDOWS - len(fastest)).astype(int)]
        return np.unique([*fastest, *spread])

    @cached_property
    def _torque(self) -> np.ndarray:
        """The drives' torques for the targets at the policy's steps ``(N, J)`` [N m]."""
        return self.drives.torque(known(self.log.target), self.log.at_steps("q"), self.log.at_steps("dq"))

    @cached_property
    def asked(self) -> np.ndarray:
        """The largest torques for the targets ``(J,)`` [N m]."""
        return np.quantile(np.abs(self._torque), 0.99, axis=0) + 1e-6

    def _state(self, k: int) -> np.ndarray:
        """Return MuJoCo's full physics state at a measurement; a robot with a free base stands on its lowest points."""
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

    def rolled(self, plant: Setting, initial: np.ndarray | None = None, times: np.ndarray | None = None) -> np.ndarray:
        """Return simulated states ``(W, T, 1 + nq + nv)``.

        Args:
            initial: Physics states ``(W, S)``; default: of the windows.
            times: Times of the simulation's steps ``(W, T)`` [s]; default: of the windows.
        """
        from mujoco import rollout

        log, target, h = self.log, known(self.log.target), self.drives.model.opt.timestep
        initial = self.initial if initial is None else initial
        times = log.state_t[self.starts][:, None] + self.step_t[None] if times is None else times
        # Use the mean of the targets over each simulation step, so that the error is smooth in the delay.
        wanted = times - plant.get("delay_s", 0.0)
        knots = np.concatenate([log.t[:1] - 1.0, log.t, log.t[-1:] + 1.0])
        held = np.concatenate([target[:1], target])
        area = np.concatenate([np.zeros((1, len(self.scale))), np.cumsum(held * np.diff(knots)[:, None], axis=0)])
        until = lambda at: np.stack([np.interp(at, knots, column) for column in area.T], -1)  # noqa: E731
        control = (until(wanted + h) - until(wanted)) / h
        ats = (times[:, 0] - log.t[0]) / (log.t[-1] - log.t[0]) if "fade" in plant else [0.0]
        models = [self.drives.with_plant(plant, self.asked, float(at)) for at in ats]
        return np.asarray(rollout.rollout(models if len(models) > 1 else models[0], self._threads, initial, control)[0])

    def residuals(self, plant: Setting) -> np.ndarray:
        """Return simulated minus measured angles ``(W, T, J)``, as a share of the motion."""
        error = (self.rolled(plant)[:, :, 1 + self.drives.qpos] - self.measured) / self.scale
        return np.where(self.used[:, :, None], np.nan_to_num(error, nan=9.0), 0.0)

    def error(self, plant: Setting) -> float:
        """Return the mean error of the replay, as a share of the joints' motion; each error counts at most 1.5."""
        return float(self.errors(plant).mean())

    def errors(self, plant: Setting) -> np.ndarray:
        """Return the mean errors of the joints ``(J,)``."""
        if plant not in self._errors:
            error = np.minimum(np.abs(self.residuals(plant)), 1.5)
            self._errors[plant] = error.sum((0, 1)) / self.used.sum()
        return self._errors[plant]

    def sag(self, plant: Setting) -> np.ndarray:
        """Return the signed differences between robot and model at the ends of the windows ``(J,)`` [rad]."""
        last = self.used.shape[1] - 1 - np.argmax(self.used[:, ::-1], axis=1)
        return -np.median(self.residuals(plant)[np.arange(len(last)), last], axis=0) * self.scale

    def candidates(self, plant: Setting) -> Iterator[Candidate]:
        """Return what may be wrong beside what is known already."""
        delay_s = plant.get("delay_s", 0.0)
        # At first, soft or limited drives look like late and damped ones.
        starts = [plant, *(plant.with_values({"kd": 1.0, "delay_s": d}) for d in (delay_s, 0.011, 0.6 * delay_s))]
        for name, part in _PARTS.items():
            if self.drives.torque_driven and name in ("kp", "kd", "zero"):
                continue
            for start in starts if name in ("kp", "kd", "zero", "limit") else starts[:1]:
                if part.of == "with the rest" or (part.of in ("all", "one too") and name not in plant):
                    yield from part.of_joint("").candidates(start, *_NUISANCE)
                if part.of == "one" or (part.of == "one too" and len(self.scale) > 1 and start is plant):
                    yield from self._of_one(name, start)
                if part.of == "each" and name not in plant:
                    yield self._of_each(part, start)

    def _of_each(self, part: _Part, start: Setting) -> Candidate:
        """Return a part with a number for each joint that thereby loses at least a tenth of its error."""
        name = part.names[0]
        of = lambda plant: np.broadcast_to(plant.get(name, part.usual), len(self.scale))  # noqa: E731

        def mixed(plants: Sequence[Setting]) -> Setting:
            """Return the first plant, with each joint's number from the plant in which it moves best."""
            numbers = np.array([of(p) for p in plants])
            errors = np.array([self.errors(p) for p in plants]) * np.where(numbers == part.usual, 0.9, 1.0)
            best = np.take_along_axis(numbers, errors.argmin(0)[None], 0)[0]
            return plants[0].with_values({name: tuple(best.tolist())} if (best != part.usual).any() else {})

        # Other gains of one joint, which are no fault, look like a limit.
        others = [start.with_values({"kp": p * start.get("kp"), "kd": d * start.get("kd")})
                  for p, d in ((0.85, 1.0), (1.18, 1.0), (1.0, 0.7), (1.0, 1.4))]  # fmt: skip
        tried = [start, *(start.with_values({name: (v,) * len(self.scale)}) for v in part.grid), *others]
        near = lambda at: [mixed([at, *(at.with_values({name: tuple(v)}) for v in part.near(of(at)))])]  # noqa: E731
        return Candidate(part.fault, mixed(tried), lambda _: "", (near, *_NUISANCE), part.least)

    def _of_one(self, name: str, plant: Setting) -> Iterator[Candidate]:
        """Return a part for the joint whose error falls most if all joints have it."""
        part, joints = _PARTS[name], self.drives.joints
        if part.of == "one":
            tried = [plant.with_values({f"{name} {j}": v for j in joints}) for v in part.grid]
        else:
            tried = [plant.with_values({name: v * plant.get(name) if name == "kp" else v}) for v in part.grid]
        better = self.errors(plant) - np.min([self.errors(p) for p in tried], axis=0)
        joint = joints[int(np.argmax(better))]
        if better.max() > 0.0 and f"{name} {joint}" not in plant:
            yield from part.of_joint(joint).candidates(plant, *_NUISANCE)

    def limited(self, plant: Setting) -> dict[str, float]:
        """Return joint -> torque limit, for limits well below the model's [N m]."""
        limits = np.array(plant.get("limit", np.inf)) * self.asked
        low = np.array([_PARTS["limit"].is_off(share) for share in limits / self.drives.limit])
        return {j: float(nm) for j, nm, is_low in zip(self.drives.joints, limits, low, strict=True) if is_low}


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
    """Return the faults of the plant, and figures of the replay.

    Args:
        trained_delay_s: Delay of the training; default: the contract's.
    """
    findings, replay, start = _with_signs(drives, log)
    fitted = [start, *explain(start.setting, replay.error, replay.candidates, 0.0, dear=True)][-1].setting
    trained = contract.delay_s if trained_delay_s is None else trained_delay_s
    age_s = 0.0 if log.rows_are_steps or log.age_s is None else float(np.median(log.age_s))
    nominal = Setting().with_values({"delay_s": max(0.0, (trained or 0.0) - age_s)})
    delay_s, base, best = fitted.get("delay_s", 0.0) + age_s, replay.error(nominal), replay.error(fitted)
    # Possible faults: name in the setting, fault, sentence, value, and the share by which it lowers the error.
    suspects = [
        (name, part.fault, own.says(fitted), fitted.get(name), part.drop)
        for part in _PARTS.values() if part.of != "each"
        for own in map(part.of_joint, ("", *drives.joints))
        for name in own.names if name in fitted and part.is_off(fitted.get(name))
    ]  # fmt: skip
    if low := replay.limited(fitted):
        part = _PARTS["limit"]
        text = str(part.text).format(value=shortened([f"{j} at {nm:.3g} N m" for j, nm in low.items()]))
        suspects.append(("limit", part.fault, text, min(low.values()), part.drop))
    if delay_s - (0.010 if trained is None else trained) > _LATER_S:
        of_training = "none that is known" if trained is None else f"{1e3 * trained:.0f} ms"
        text = f"motion follows a target after {1e3 * delay_s:.0f} ms; the training had {of_training}"
        suspects.append(("delay_s", "delay", text, delay_s, 0.07))
    for name, fault, text, value, least in suspects:
        # Estimate the others again without it.
        rest = Setting(tuple((n, v) for n, v in fitted.values if n != name))
        moves = [*([_PARTS["kd"].move] if name != "kd" else []), *([_PARTS["kp"].move] if "kp" in rest else [])]
        if fault == "delay":
            rest = rest.with_values({"delay_s": nominal.get("delay_s")})
        else:
            moves.append(_DELAY.move)
        gap = replay.error(rest) - best
        rest = replace(start, setting=rest, moves=moves).descended(replay.error).setting
        joints = [i for i, j in enumerate(drives.joints) if name.endswith(f" {j}")]
        without, with_it = (float(replay.errors(p)[joints or slice(None)].mean()) for p in (rest, fitted))
        if with_it <= (1.0 - least) * without:
            share = float(np.clip(gap / max(base - best, gap, 1e-9), 0.0, 1.0))
            question = "timing" if fault == "delay" else "plant"
            findings.append(Finding(fault, question, text, share, {name.split()[0]: float(value)}))
    nominal = nominal.with_values({"delay_s": fitted.get("delay_s", 0.0)})
    figures = {
        "error": base, "error_fitted": best, "delay_s": delay_s,
        **{n: fitted.get(n, part.usual) for n, part in _PARTS.items() if part.of not in ("one", "each")},
        "joints": {j: [float(a), float(b)] for j, a, b in
                   zip(contract.joints, replay.errors(nominal), replay.errors(fitted), strict=True)},
        "sag_rad": dict(zip(contract.joints, replay.sag(nominal).tolist(), strict=True)),
        "parting": parting(replay, fitted, contract.joints),
    }  # fmt: skip
    return findings, figures


def _with_signs(drives: Drives, log: Log) -> tuple[list[Finding], Replay, Candidate]:
    """Return the replay and its delay, after correcting joints with a wrong sign in the log."""

    def started(replay: Replay) -> Candidate:
        best = min(_DELAY.candidates(Setting(), *_NUISANCE), key=lambda c: replay.error(c.setting))
        return best.descended(replay.error)

    findings, replay = list[Finding](), Replay(drives, log)
    start = started(replay)
    for i in np.argsort(-replay.errors(start.setting)):
        before = replay.error(start.setting)
        if replay.errors(start.setting)[i] < 0.5:
            break
        sign = np.where(np.arange(len(drives.joints)) == i, -1.0, 1.0)
        turned = Replay(drives, replace(replay.log, q=replay.log.q * sign, dq=replay.log.dq * sign))
        if (after := turned.error(start.setting)) < 0.6 * before:
            text = f"{drives.joints[i]} is measured with the other sign than in the model"
            findings.append(Finding("sign", "plant", text, (before - after) / before))
            replay, start = turned, started(turned)
    return findings, replay, start


def parting(replay: Replay, plant: Setting, joints: Sequence[str]) -> dict[str, Any]:
    """Return the first window in which the fitted model departs from the robot, its worst joint, and both motions."""
    error = np.abs(replay.residuals(plant)).mean(1)
    limit = max(4.0 * float(np.median(error)), 0.3)
    worse = np.flatnonzero(error.max(1) > limit)
    first = int(worse[0]) if len(worse) else int(np.argmax(error.max(1)))
    joint = int(np.argmax(error[first]))
    d, log, h = replay.drives, replay.log, replay.drives.model.opt.timestep
    begin = float(log.state_t[replay.starts[first]])
    times = begin + np.arange(0.0, min(_FILM_S, log.state_t[-1] - begin - h), h)
    states = replay.rolled(plant, replay.initial[[first]], times[None])[0]
    shown = np.linspace(0, len(times) - 1, _FRAMES).astype(int)
    measured = np.stack([np.interp(times[shown] + h, log.state_t, q) for q in log.q.T], -1)
    simulated = states[shown, 1 : 1 + d.model.nq]
    robot = simulated.copy()
    robot[:, d.qpos] = measured
    if d.free:  # the position of the base is not measured
        robot[:, :3] = simulated[0, :3]
        if log.quat is not None:
            robot[:, 3:7] = log.quat[np.searchsorted(log.state_t, times[shown] + h).clip(0, len(log.quat) - 1)]
    return {
        "time_s": begin, "joint": joints[joint], "apart": bool(len(worse)), "error": float(error[first, joint]),
        "free": d.free, "t": (times[shown] + h - begin).tolist(),
        "measured": measured[:, joint].tolist(), "simulated": simulated[:, d.qpos[joint]].tolist(),
        "film": {"measured": drawn(d.model, robot), "simulated": drawn(d.model, simulated)},
    }  # fmt: skip


def drawn(model: Any, qpos: np.ndarray) -> list[Any]:
    """Return for each pose ``(T, nq)`` and body a line of points (x, y, z): parent, body, centre of the body."""
    data, frames = mujoco.MjData(model), []
    parents = np.where(model.body_parentid == 0, np.arange(model.nbody), model.body_parentid)
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        frames.append(np.round(np.stack([data.xpos[parents], data.xpos, data.xipos], 1)[1:], 4).tolist())
    return frames
