"""Joints of a model that were not recorded: some are held at a position, others move together with recorded ones."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sim2real.errors import UsageError
from sim2real.types import MjModel, MjSpec

mj: Any = mujoco

_HOME = "home"
"""The keyframe that is used if a model has several."""
_ROUNDED = 1e-3
"""Largest distance of a rounded keyframe from a joint's range [rad or m]."""
_FREE, _BALL, _SLIDE = (int(getattr(mj.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE"))


@dataclass(frozen=True)
class Held:
    """A joint that was not recorded, and is held.

    Attributes:
        joint: Its number in the file's model.
        name: Its name, or the name of its body.
        value: Position: an angle [rad], a length [m], the quaternion of a ball, or empty for a floating base.
        unit: Unit of the value.
        source: Origin of the value.
        passive: Whether no actuator of the file drives it.
    """

    joint: int
    name: str
    value: tuple[float, ...]
    unit: str
    source: str
    passive: bool

    def __str__(self) -> str:
        """Return a line that users read."""
        where = f"at {', '.join(f'{v:.4g}' for v in self.value)}{self.unit and f' {self.unit}'}, " if self.value else ""
        return f"{self.name} {where}{self.source}{'; no actuator of the model drives it' if self.passive else ''}"


@dataclass(frozen=True)
class Holding:
    """The joints that were not recorded.

    Attributes:
        held: Held joints.
        moved: Free joints: number -> the coupling that moves it.
        dropped: Couplings between held joints alone, and tendons without a force.
        key: Number of the keyframe; -1: none.
    """

    held: tuple[Held, ...]
    moved: Mapping[int, str]
    dropped: tuple[Coupling, ...]
    key: int = -1


def plan(model: MjModel, recorded: Sequence[str], hold: Sequence[str], fix_base: bool, path: Path) -> Holding:
    """Return the held joints and their positions.

    A joint that a loop, an equality or a tendon moves together with a recorded one stays free. Others are held at a
    named value, otherwise at the keyframe or at the model's zero.

    Args:
        hold: ``JOINT=VALUE`` [rad or m], or the name of a keyframe.
    """
    # Find the joints that move together with recorded ones.
    couplings = couplings_of(model)
    numbers = {model.joint(name).id for name in recorded}
    moved = _moved(model, couplings, numbers, fix_base)
    key, named = _named(model, hold, numbers, moved, path)
    _refuse_tendons(model, couplings, numbers, {*moved, *named}, path)
    # Hold all other joints; for the dynamics only the positions of joints that carry a free joint matter.
    held = []
    free = {int(model.jnt_bodyid[i]) for i in numbers | moved.keys()}
    carrying = set().union(*(upwards(model, body) for body in free))
    for i in range(model.njnt):
        if i in numbers or i in moved:
            continue
        if int(model.jnt_type[i]) == _FREE and not fix_base:
            raise UsageError(
                f"the base of {path} floats: joint {model.joint(i).name or 'without a name'!r} was not recorded",
                hint="--fix-base holds it at its position in the model, as on a stand",
            )
        body = int(model.jnt_bodyid[i])
        matters = body in carrying or bool(upwards(model, body) & free)
        held.append(_held(model, i, named.get(i), key, matters))
    # Couplings between held joints have no effect.
    _refuse_outside(model, held, path)
    at = {h.joint for h in held}
    dropped = tuple(c for c in couplings if not c.acts or not c.joints or c.joints <= at)
    return Holding(tuple(held), moved, dropped, key)


def apply(spec: MjSpec, model: MjModel, holding: Holding) -> None:
    """Hold joints of a model: their bodies get the pose at the held positions, and the joints are deleted.

    Args:
        spec: ``mujoco.MjSpec`` whose elements have the compiled model's numbers; it is changed.
    """
    # Delete elements that refer to held joints.
    held, dropped = {h.joint: h for h in holding.held}, holding.dropped
    joints = {int(j.id): j for j in spec.joints}
    equalities = {c.equality for c in dropped} | {i for i in range(model.neq) if not model.eq_active0[i]}
    if int(model.opt.disableflags) & int(mj.mjtDisableBit.mjDSBL_EQUALITY):
        equalities |= set(range(model.neq))
    tendons = {c.tendon for c in dropped}
    gone = [e for e in spec.equalities if int(e.id) in equalities]
    gone += [t for t in spec.tendons if int(t.id) in tendons]
    for element in (*spec.sensors, *spec.actuators, *spec.keys, *spec.tuples, *gone):
        spec.delete(element)
    # Move each body to the pose of its held joints.
    _pose(model, held, joints)
    # Keep the start of the joints that still move.
    if holding.moved and holding.key >= 0:
        left = [i for i in range(model.njnt) if i not in held]
        start = np.concatenate([model.key_qpos[holding.key, _address(model, i)] for i in left])
    else:
        start = None
    for number in held:
        spec.delete(joints[number])
    if start is not None:
        spec.add_key(name="start", qpos=start)


def _moved(model: MjModel, couplings: Sequence[Coupling], recorded: set[int], fix_base: bool) -> dict[int, str]:
    """Return the joints that stay free, and the coupling that moves each."""
    together = [group for group in groups(couplings) if group & recorded]
    causes: dict[int, str] = {}
    for c in couplings:
        alone = c.equality >= 0 and int(model.eq_type[c.equality]) == int(mj.mjtEq.mjEQ_JOINT) and len(c.joints) == 1
        if c.acts and (alone or any(c.joints <= group for group in together)):
            causes |= {i: c.name for i in sorted(c.joints - recorded) if i not in causes}
    bases = [i for i in causes if int(model.jnt_type[i]) == _FREE and below(model, i) & recorded]
    return {i: name for i, name in causes.items() if not (fix_base and i in bases)}


def _named(
    model: MjModel, hold: Sequence[str], recorded: set[int], moved: Mapping[int, str], path: Path
) -> tuple[int, dict[int, float]]:
    """Return the number of the named keyframe (-1: none), and the named values by joint."""
    # An entry is a keyframe, or JOINT=VALUE.
    keys = [model.key(i).name for i in range(model.nkey)]
    names = {model.joint(i).name: i for i in range(model.njnt)}
    chosen, values = None, {}
    for entry in hold:
        name, _, text = entry.rpartition("=")
        if entry in keys:
            chosen = keys.index(entry)
            continue
        if name not in names:
            raise UsageError(
                f"{path} has no {'joint' if name else 'keyframe'} {name or entry!r} to hold. "
                f"Joints: {', '.join(filter(None, names))}; keyframes: {', '.join(filter(None, keys)) or 'none'}",
                hint="write JOINT=VALUE, or the name of a keyframe",
            )
        number = names[name]
        if number in recorded or number in moved:
            cause = f"{moved[number]} moves it" if number in moved else "it was recorded"
            raise UsageError(f"joint {name!r} cannot be held: {cause}", hint=f"leave {entry!r} out")
        try:
            values[number] = float(text)
        except ValueError:
            values[number] = float("nan")
        if not np.isfinite(values[number]) or int(model.jnt_type[number]) in (_FREE, _BALL):
            raise UsageError(f"joint {name!r} cannot be held at {text!r}", hint="write a number, in rad or m")
    return _key(model, keys, chosen, recorded, {*moved, *values}, path), values


def _key(
    model: MjModel, keys: Sequence[str], chosen: int | None, recorded: set[int], others: set[int], path: Path
) -> int:
    """Return the number of the keyframe at which joints are held; -1: none."""
    if chosen is not None or len(keys) < 2:
        return len(keys) - 1 if chosen is None else chosen
    if _HOME in keys:
        return keys.index(_HOME)
    at = [_address(model, i) for i in range(model.njnt) if i not in recorded | others]
    if any(not np.allclose(model.key_qpos[:, a], model.key_qpos[0, a]) for a in at):
        raise UsageError(
            f"{path} has {len(keys)} keyframes with different values of joints that were not recorded: "
            f"{', '.join(k or 'one without a name' for k in keys)}",
            hint="name the keyframe at which they are held, or their values: --hold KEYFRAME or --hold JOINT=VALUE",
        )
    return 0


def _refuse_tendons(
    model: MjModel, couplings: Sequence[Coupling], recorded: set[int], settled: set[int], path: Path
) -> None:
    """Refuse a joint that only the actuator of a tendon moves together with a recorded one."""
    of_tendon = model.actuator_trntype == int(mj.mjtTrn.mjTRN_TENDON)
    pulled = {int(t) for t in model.actuator_trnid[of_tendon, 0]}
    for c in couplings:
        lost = sorted(c.joints - recorded - settled)
        if c.tendon in pulled and c.joints & recorded and lost:
            name = model.joint(lost[0]).name
            raise UsageError(
                f"in {path} an actuator of {c.name} moves joint {name!r} together with recorded ones, so it cannot "
                "be held",
                hint=f"record it; or, if it was blocked, give its position: --hold {name}=VALUE",
            )


def _refuse_outside(model: MjModel, held: Sequence[Held], path: Path) -> None:
    """Refuse joints that would be held outside their ranges: wrong positions change the inertia of others."""
    outside = []
    for h in held:
        low, high = model.jnt_range[h.joint]
        if h.unit and model.jnt_limited[h.joint] and not low <= h.value[0] <= high:
            outside.append((h, f"{h.name} at {h.value[0]:.4g} {h.unit} ({h.source}), outside {low:.4g} to {high:.4g}"))
    if outside:
        flags = " ".join(f"--hold {shlex.quote(h.name)}=VALUE" for h, _ in outside)
        raise UsageError(
            f"{path}: joints that were not recorded would be held outside of their ranges: "
            f"{'; '.join(line for _, line in outside)}",
            hint=f"{flags} gives the position of each, in rad or m; a keyframe 'home' of the model does, too",
        )


def _held(model: MjModel, number: int, named: float | None, key: int, matters: bool) -> Held:
    """Return where a joint is held; a joint whose position does not matter is moved into its range."""
    # A joint without an actuator is passive.
    kind, name = int(model.jnt_type[number]), model.joint(number).name
    at, low_high = _address(model, number), model.jnt_range[number]
    shown = name or f"a joint of body {model.body(int(model.jnt_bodyid[number])).name!r}"
    driven = (model.actuator_trntype == int(mj.mjtTrn.mjTRN_JOINT)) & (model.actuator_trnid[:, 0] == number)
    passive = model.nu > 0 and kind != _FREE and not driven.any()
    if kind == _FREE:
        return Held(number, shown, (), "", "its position in the model", passive)
    # The position: by name, by the keyframe, or the model's zero.
    source = "named" if named is not None else "the model's zero"
    value = np.array([named]) if named is not None else np.array(model.qpos0[at])
    if named is None and key >= 0:
        value, source = np.array(model.key_qpos[key, at]), f"keyframe {model.key(key).name!r}"
    if kind == _BALL:
        return Held(number, shown, tuple(map(float, value)), "", source, passive)
    # Move a rounded position, or one without effect, into the joint's range.
    unit = "m" if kind == _SLIDE else "rad"
    nearest = np.clip(value, *low_high) if model.jnt_limited[number] else value
    if abs(nearest - value)[0] <= _ROUNDED or not (matters or named is not None):
        source += "" if nearest[0] == value[0] else ", moved into its range"
        value = nearest
    return Held(number, shown, (float(value[0]),), unit, source, passive)


def _address(model: MjModel, number: int) -> slice:
    begin = int(model.jnt_qposadr[number])
    return slice(begin, begin + {_FREE: 7, _BALL: 4}.get(int(model.jnt_type[number]), 1))


def _pose(model: MjModel, held: Mapping[int, Held], joints: Mapping[int, Any]) -> None:
    """Set the poses of bodies for the held joints' values, and anchors and axes of their free joints.

    Free joints are at their references, where they do not move a body. Their anchors and axes are transformed into the
    frame of the body, which held joints behind them turn.
    """
    data = mj.MjData(model)
    for number, h in held.items():
        if h.value:
            data.qpos[_address(model, number)] = h.value
    mj.mj_kinematics(model, data)
    for body in sorted({int(model.jnt_bodyid[number]) for number in held}):
        parent, turn = int(model.body_parentid[body]), data.xmat[body].reshape(3, 3)
        around = data.xmat[parent].reshape(3, 3)
        quat = np.zeros(4)
        mj.mju_mat2Quat(quat, (around.T @ turn).ravel())
        first = int(model.body_jntadr[body])
        # Put the body into a frame that has its pose, so that its own pose is zero.
        element = joints[first].parent
        pos = around.T @ (data.xpos[body] - data.xpos[parent])
        element.set_frame(element.parent.add_frame(pos=pos, quat=quat))
        element.pos, element.quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        element.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT
        for number in set(range(first, first + int(model.body_jntnum[body]))) - held.keys():
            joints[number].pos = turn.T @ (data.xanchor[number] - data.xpos[body])
            joints[number].axis = turn.T @ data.xaxis[number]


# -- joints that move together: in loops, by equalities (URDF's mimic becomes one), and by tendons


@dataclass(frozen=True)
class Coupling:
    """Joints that an element of the model moves together.

    Attributes:
        name: The element, such as ``equality 'crank'``.
        joints: Numbers of the joints.
        equality: Number of the equality; -1: it is a tendon.
        tendon: Number of the tendon; -1: it is an equality.
        acts: Whether the coupling exerts a force without an actuator; a tendon that only an actuator pulls does not.
    """

    name: str
    joints: frozenset[int]
    equality: int = -1
    tendon: int = -1
    acts: bool = True


def couplings_of(model: MjModel) -> list[Coupling]:
    """Return the couplings of a compiled model: its active equalities, and its tendons."""
    couplings: list[Coupling] = []
    if not int(model.opt.disableflags) & int(mj.mjtDisableBit.mjDSBL_EQUALITY):
        active = map(int, np.flatnonzero(model.eq_active0))
        couplings = [Coupling(_element("equality", model.equality(i)), _of_equality(model, i), i) for i in active]
    pulling = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_armature)
    pulled = {c.tendon for c in couplings} | _tendons_in_equalities(model)
    for t in range(model.ntendon):
        acts = bool(model.tendon_limited[t]) or t in pulled or any(np.any(values[t]) for values in pulling)
        couplings.append(Coupling(_element("tendon", model.tendon(t)), joints_of_tendon(model, t), tendon=t, acts=acts))
    return couplings


def groups(couplings: Iterable[Coupling]) -> list[frozenset[int]]:
    """Return the sets of joints that acting couplings connect, directly or through other joints."""
    merged: list[frozenset[int]] = []
    for coupling in couplings:
        if coupling.acts and coupling.joints:
            joined = [g for g in merged if g & coupling.joints]
            merged = [g for g in merged if g not in joined] + [coupling.joints.union(*joined)]
    return merged


def joints_of_tendon(model: MjModel, tendon: int) -> frozenset[int]:
    """Return the numbers of the joints that change a tendon's length."""
    joints: set[int] = set()
    bodies: list[int] = []
    begin = int(model.tendon_adr[tendon])
    # Walk along the tendon; a pulley begins a new branch.
    for i in range(begin, begin + int(model.tendon_num[tendon])):
        kind, number = int(model.wrap_type[i]), int(model.wrap_objid[i])
        if kind == int(mj.mjtWrap.mjWRAP_JOINT):
            joints.add(number)
        elif kind == int(mj.mjtWrap.mjWRAP_SITE):
            bodies.append(int(model.site_bodyid[number]))
        elif kind == int(mj.mjtWrap.mjWRAP_PULLEY):
            joints |= _between(model, bodies)
            bodies = []
        else:
            bodies.append(int(model.geom_bodyid[number]))
    return frozenset(joints | _between(model, bodies))


def below(model: MjModel, joint: int) -> set[int]:
    """Return the numbers of the joints of a joint's body and of all bodies below it."""
    top = int(model.jnt_bodyid[joint])
    return {i for i in range(model.njnt) if top in upwards(model, int(model.jnt_bodyid[i]))}


def _of_equality(model: MjModel, equality: int) -> frozenset[int]:
    kind = int(model.eq_type[equality])
    ends = [int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])]
    eq = mj.mjtEq
    if kind == int(eq.mjEQ_JOINT):
        return frozenset(i for i in ends if i >= 0)
    if kind == int(eq.mjEQ_TENDON):
        return frozenset().union(*(joints_of_tendon(model, i) for i in ends if i >= 0))
    if kind in (int(eq.mjEQ_CONNECT), int(eq.mjEQ_WELD)):
        if int(model.eq_objtype[equality]) == int(mj.mjtObj.mjOBJ_SITE):
            ends = [int(model.site_bodyid[i]) for i in ends]
        return frozenset(_between(model, ends))
    return frozenset()


def _tendons_in_equalities(model: MjModel) -> set[int]:
    rows = np.flatnonzero((model.eq_type == int(mj.mjtEq.mjEQ_TENDON)) & (model.eq_active0 != 0))
    return {int(ends[i]) for i in rows for ends in (model.eq_obj1id, model.eq_obj2id) if ends[i] >= 0}


def _between(model: MjModel, bodies: Sequence[int]) -> set[int]:
    """Return the joints that move some of the bodies, but not all of them."""
    if not bodies:
        return set()
    chains = [upwards(model, body) for body in bodies]
    moved = set().union(*chains) - set(chains[0]).intersection(*chains)
    return {i for i in range(model.njnt) if int(model.jnt_bodyid[i]) in moved}


def upwards(model: MjModel, body: int) -> set[int]:
    """Return a body and its ancestors, except the world."""
    bodies: set[int] = set()
    while body > 0:
        bodies.add(body)
        body = int(model.body_parentid[body])
    return bodies


def _element(kind: str, element: Any) -> str:
    return (
        f"{kind} {element.name!r}" if element.name else f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} without a name"
    )
