"""Parameters of a robot's model by pattern: for all joints, for a group, or for each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import distrax
import jax.numpy as jnp
import numpy as np

from sim2real.arrays import beside_damping
from sim2real.errors import UsageError
from sim2real.identify.parameters import Parameter, Transform
from sim2real.robots.from_model.joints.joint_patterns import require_quick
from sim2real.robots.from_model.joints.quantities import (
    ABOUT,
    ALIKE,
    BOTH_WAYS,
    EXCITE,
    FACTORS,
    FALLBACK,
    FIXED,
    LAWS,
    LIMITS,
    OF_MODEL,
    ON_DOF,
    ON_DRIVE,
    ONLY_NAMED,
    OPTIONAL,
    TILT,
    VANISHING,
    WHOLE,
    WIDE,
    ParameterPattern,
    letters,
)
from sim2real.robots.from_model.joints.sharing import sharing
from sim2real.robots.from_model.mjcf import force_of, gains_of, limit_of, slides_of, unit_for
from sim2real.types import Array, MjModel, PyTree, Scalar
from sim2real.worlds.drive_terms import NO_LIMIT
from sim2real.worlds.driven import PAYLOAD


@dataclass(frozen=True)
class Placed:
    """A parameter, and where its value belongs.

    Attributes:
        parameter: The parameter.
        what: The quantity.
        at: Numbers of the joints in the robot's order; of ``payload``, of the model's bodies.
    """

    parameter: Parameter
    what: str
    at: tuple[int, ...]

    @property
    def among_limits(self) -> bool:
        """Whether it is a limit that no pattern names: the file's own limits hold, too."""
        return self.what in LIMITS and bool(self.parameter.term) and not self.parameter.free


def expand(
    terms: Sequence[ParameterPattern], joints: Sequence[str], model: MjModel, file_model: MjModel
) -> list[Placed]:
    """Return the parameters of a model."""
    placed: list[Placed] = []
    # Without a damping of the drive, the joint's damping includes that of the file's servo.
    quantities = {term.what for term in terms}
    whole_damping = "kp" in quantities and "kd" not in quantities
    for term in terms:
        # The joints or bodies that match the pattern.
        names = [model.body(i).name for i in range(1, model.nbody)] if term.what == "payload" else list(joints)
        offset = 1 if term.what == "payload" else 0
        require_quick(term.joints, names)
        at = [i for i, name in enumerate(names) if name != PAYLOAD and re.fullmatch(term.joints, name, re.DOTALL)]
        if not at:
            raise UsageError(
                f"{term.what!r}: {term.joints!r} matches none of {', '.join(names)}",
                hint="a pattern matches whole names: .*_hip_joint",
            )
        # Joints with one value form a group.
        sliding = set() if term.what == "payload" else set(slides_of(file_model, names))
        if term.each:
            groups = [([i], f"{term.name or term.what}_{letters(names[i])}") for i in at]
        else:
            groups = [(part, term.label() + suffix) for part, suffix in _by_unit(term.what, at, names, sliding)]
        for group, name in groups:
            nominal = _nominal(term, [names[i] for i in group], file_model, whole_damping)
            unit = unit_for(ABOUT[term.what][0], term.what not in WHOLE and names[group[0]] in sliding)
            p = replace(_parameter(term, name, nominal, _size(term, [names[i] for i in group], file_model)), unit=unit)
            placed.append(Placed(p, term.what, tuple(i + offset for i in group)))
    return placed


def _by_unit(what: str, at: list[int], names: Sequence[str], sliding: set[str]) -> list[tuple[list[int], str]]:
    """Return the groups of joints that may share a value, and the suffix of its name: slides have other units."""
    slides = [i for i in at if names[i] in sliding]
    hinges = [i for i in at if names[i] not in sliding]
    if what in WHOLE or unit_for(ABOUT[what][0], True) == ABOUT[what][0] or not (slides and hinges):
        return [(at, "")]
    return [(hinges, ""), (slides, "_slide")]


def optional(
    terms: Sequence[ParameterPattern], wanted: str = "all", joints: Sequence[str] = ()
) -> tuple[ParameterPattern, ...]:
    """Return the patterns, and one for all joints for each further quantity of the optional terms.

    These quantities are 0 unless ``--terms`` chooses their terms.

    Args:
        wanted: ``auto``, ``all``, or names separated by commas, in addition to those of ``auto``. A quantity that a
            pattern names is available without the others of its term.
    """
    # Choose the optional terms.
    quantities_named, names = {term.what for term in terms}, {n.strip() for n in wanted.split(",")}
    if "cogging" in names and "cogging_per_turn" not in quantities_named:
        raise UsageError("cogging needs its number of repeats in a turn", hint="add --parameter cogging_per_turn=N")
    available = {name for name in OPTIONAL if name not in ONLY_NAMED or name in names}
    if wanted == "all":
        available |= set(ONLY_NAMED) - (set() if "cogging_per_turn" in quantities_named else {"cogging"})
    # Give each pattern its term, and add patterns for the other quantities of the terms.
    return (
        *(replace(term, term=name) if (name := _term_of(term.what)) else term for term in terms),
        *(
            ParameterPattern(what, free=False, term=name)
            for name, quantities in OPTIONAL.items()
            if name in available
            for what in quantities
            if what not in quantities_named
        ),
        *sharing(terms, joints, wanted),
    )


def _term_of(what: str) -> str:
    return next((name for name, quantities in OPTIONAL.items() if what in quantities), "")


def place(
    placed: Sequence[Placed], values: Mapping[str, Scalar], base: PyTree, joints: np.ndarray, dofs: np.ndarray
) -> PyTree:
    """Return the world's parameters with values in their places.

    Args:
        base: ``DriveParams`` with nominal values.
        joints: Shape ``(joints,)``: their numbers in the model.
        dofs: Shape ``(joints,)``: index of each joint in the model's arrays.
    """
    # Collect the new values of each field.
    drive: dict[str, PyTree] = {}
    model: dict[str, PyTree] = {}
    terms: PyTree = base.terms
    # A speed without load is the torque limit divided by the damping, so set the limit first.
    for p in sorted(placed, key=lambda p: p.what == "speed"):
        if p.what in TILT:
            continue
        if p.what == "gravcomp":
            carried = base.model.body_gravcomp
            model["body_gravcomp"] = jnp.where(carried > 0.0, values[p.parameter.name], carried)
            continue
        if p.what in FACTORS:
            continue
        value, at = of_each(p, placed, values), np.array(p.at)
        if p.what in ON_DRIVE:
            drive[p.what] = drive.get(p.what, getattr(base, p.what)).at[at].set(value)
        elif p.what in LAWS:
            terms = terms.replace(**{p.what: getattr(terms, p.what).at[at].set(value)})
        elif p.what in ("torque", "speed"):
            limits = model.get("jnt_actfrcrange", jnp.asarray(base.model.jnt_actfrcrange))
            if p.what == "torque":
                of_file = limits[joints[at], 1]
                most = jnp.minimum(of_file, value) if p.among_limits else value
                model["jnt_actfrcrange"] = limits.at[joints[at]].set(most[:, None] * jnp.array([-1.0, 1.0]))
            else:
                damping = model.get("dof_damping", base.model.dof_damping)
                model["dof_damping"] = damping.at[dofs[at]].set(limits[joints[at], 1] / value)
        elif p.what == "payload":
            model["body_mass"] = model.get("body_mass", base.model.body_mass).at[at].add(value)
        else:
            field = ON_DOF[p.what]
            model[field] = model.get(field, getattr(base.model, field)).at[dofs[at]].set(value)

    if model.keys() & {"dof_armature", "dof_damping"}:
        armature, damping = (model.get(f, getattr(base.model, f)) for f in ("dof_armature", "dof_damping"))
        rotor = beside_damping(armature[dofs], damping[dofs], base.model.opt.timestep)
        model["dof_armature"] = armature.at[dofs].set(rotor)

    # Replace the fields.
    if any(p.what in TILT for p in placed):
        model["opt.gravity"] = tilted(placed, values, base.model.opt.gravity)
    return base.replace(model=base.model.tree_replace(model), terms=terms, **drive)


def of_each(p: Placed, placed: Sequence[Placed], values: Mapping[str, Scalar]) -> Array:
    """Return the value of a parameter at each of its joints, ``(joints,)``, times the factors that they have."""
    value = jnp.full(len(p.at), jnp.asarray(values[p.parameter.name], float))
    for factor in placed:
        if factor.what == f"{p.what}_factor":
            times = jnp.asarray(values[factor.parameter.name], float)
            value = jnp.where(np.isin(p.at, factor.at), times * value, value)
    return value


def tilted(placed: Sequence[Placed], values: Mapping[str, Scalar], gravity: Array) -> PyTree:
    """Return gravity ``(3,)`` [m/s^2] turned about the model's x axis, then about its y axis.

    Args:
        gravity: As the model has it, ``(3,)`` [m/s^2].
    """
    angle = {p.what: values[p.parameter.name] for p in placed if p.what in TILT}
    if not angle:
        return gravity
    x, y = (jnp.asarray(angle.get(what, 0.0), float) for what in TILT)
    g = jnp.asarray(gravity, float)
    g = jnp.array([g[0], jnp.cos(x) * g[1] - jnp.sin(x) * g[2], jnp.sin(x) * g[1] + jnp.cos(x) * g[2]])
    return jnp.array([jnp.cos(y) * g[0] + jnp.sin(y) * g[2], g[1], jnp.cos(y) * g[2] - jnp.sin(y) * g[0]])


def _parameter(term: ParameterPattern, name: str, nominal: float, own_size: float) -> Parameter:
    # Bounds: fixed ones, a factor of another quantity, or factors of the nominal value.
    unit, about = ABOUT[term.what]
    transform: Transform = "log"
    kind = "measurement" if term.what == "zero" else "dynamics"
    absent = NO_LIMIT if term.what in LIMITS else nominal
    if term.what in LIMITS and not term.free:
        low, high = NO_LIMIT / 1e9, NO_LIMIT
    elif term.what in FACTORS:
        low, high = 0.2, 5.0
    elif term.what in FIXED:
        _, low, high = FIXED[term.what]
        transform = "linear"
    elif term.what in OF_MODEL:
        low, high, transform = -own_size if term.what in BOTH_WAYS else 0.0, own_size, "linear"
    else:
        below, above = WIDE[term.what]
        low, high = nominal / below, nominal * above
        if term.what == "gain":  # a log may hold the force at the joint although the file's motor has a gear
            low, high = min(nominal, 1.0) / below, max(nominal, 1.0) * above
    low, high = (bound if bound is not None else usual for bound, usual in ((term.low, low), (term.high, high)))
    return Parameter(name, unit, nominal, low, high, transform, kind, about, free=term.free, excite=EXCITE[term.what],
        vanishes=term.what in VANISHING, limits=term.what in LIMITS, term=term.term,
        prior=distrax.Normal(1.0, ALIKE) if term.what in FACTORS else None,
        off=absent if term.term and (not term.free or term.what in LIMITS) else None,
    )  # fmt: skip


def _nominal(term: ParameterPattern, names: Sequence[str], file_model: MjModel, whole_damping: bool = False) -> float:
    """Return the nominal value: the median of the joints' values in the file.

    Args:
        whole_damping: Whether a joint's damping includes that of the file's servo.
    """
    if term.nominal is not None:
        return term.nominal
    if term.what in LIMITS and term.term and not term.free:
        return NO_LIMIT
    if term.what == "gravcomp" and np.any(file_model.body_gravcomp > 0.0):
        return float(np.median(file_model.body_gravcomp[file_model.body_gravcomp > 0.0]))
    if term.what in FACTORS:
        return 1.0
    if term.what in FIXED:
        return FIXED[term.what][0]
    if term.what in OF_MODEL:
        return 0.0
    # The file's values, of joints that have one.
    values: list[float] = []
    for name in names:
        if term.what in ON_DOF:
            value = float(getattr(file_model, ON_DOF[term.what])[file_model.joint(name).dofadr[0]])
            gains = gains_of(file_model, name) if whole_damping and term.what == "damping" else None
            values.append(value + (gains[1] if gains else 0.0))
        elif term.what in ("kp", "kd") and (gains := gains_of(file_model, name)):
            values.append(gains[term.what == "kd"])
        elif term.what == "gain" and (force := force_of(file_model, name)):
            values.append(force)
        elif term.what == "torque" and (limit := limit_of(file_model, name)):
            values.append(limit)
    positive = [v for v in values if v > 0]
    return float(np.median(positive)) if positive else FALLBACK[term.what]


def _size(term: ParameterPattern, names: Sequence[str], file_model: MjModel) -> float:
    """Return the bound of a term without a usual size; 0 for other terms."""
    if term.what not in OF_MODEL:
        return 0.0
    quantity, factor = OF_MODEL[term.what]
    return factor * _nominal(replace(term, what=quantity, nominal=None), names, file_model)
