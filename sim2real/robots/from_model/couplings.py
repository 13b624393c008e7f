"""Which joints of a model move together: in loops, by equalities, which URDF's mimic becomes, and by tendons."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from sim2real.types import MjModel

mj: Any = mujoco


@dataclass(frozen=True)
class Coupling:
    """Joints that an element of the model moves together.

    Attributes:
        name: The element, such as ``equality 'crank'``.
        joints: Numbers of the joints.
        equality: Number of the equality; -1: it is a tendon.
        tendon: Number of the tendon; -1: it is an equality.
        acts: Whether the coupling exerts a force of its own; a tendon that only an actuator pulls does not.
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
        couplings = [Coupling(_named("equality", model.equality(i)), _of_equality(model, i), i) for i in active]
    pulling = (model.tendon_stiffness, model.tendon_damping, model.tendon_frictionloss, model.tendon_armature)
    pulled = {c.tendon for c in couplings} | _tendons_in_equalities(model)
    for t in range(model.ntendon):
        acts = bool(model.tendon_limited[t]) or t in pulled or any(np.any(values[t]) for values in pulling)
        couplings.append(Coupling(_named("tendon", model.tendon(t)), joints_of_tendon(model, t), tendon=t, acts=acts))
    return couplings


def groups(couplings: Iterable[Coupling]) -> list[frozenset[int]]:
    """Return the sets of joints that couplings which act join, directly or through other joints."""
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
    """Return the numbers of the joints of a joint's body and of the bodies that hang on it."""
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
    """Return a body and its ancestors without the world."""
    bodies: set[int] = set()
    while body > 0:
        bodies.add(body)
        body = int(model.body_parentid[body])
    return bodies


def _named(kind: str, element: Any) -> str:
    return (
        f"{kind} {element.name!r}" if element.name else f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} without a name"
    )
