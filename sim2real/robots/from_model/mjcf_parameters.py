"""Parameters of a robot's model by pattern: for all joints, for a group, or for each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.identify.parameters import Parameter, Transform
from sim2real.robots.from_model.joint_patterns import require_quick
from sim2real.robots.from_model.mjcf import gains_of, limit_of, slides_of, unit_for
from sim2real.types import Array, MjModel, PyTree, Scalar

What = Literal[
    "kp", "kd", "gain", "torque", "speed", "released", "damping", "armature", "frictionloss", "zero", "payload",
    "load", "static", "stribeck_rad_s", "drag", "bias", "back_emf", "play", "tilt_x", "tilt_y", "gravcomp",
    "eccentric_cos", "eccentric_sin", "cogging_cos", "cogging_sin", "cogging_per_turn",
]  # fmt: skip
ALL = ".*"
_WIDE = {"kp": (10, 10), "kd": (30, 30), "gain": (20, 20), "torque": (5, 5), "speed": (5, 5), "damping": (30, 30),
         "armature": (30, 30), "frictionloss": (50, 20), "stribeck_rad_s": (10, 20)}  # fmt: skip
"""Factors of the lower bound below, and of the upper bound above the nominal value."""
FALLBACK = {"kp": 20.0, "kd": 0.5, "gain": 1.0, "torque": 10.0, "speed": 20.0, "damping": 0.1, "armature": 0.01,
             "frictionloss": 0.1, "stribeck_rad_s": 0.1}  # fmt: skip
"""Nominal values where the model has none."""
_ABOUT = {
    "kp": ("N m/rad", "stiffness of the drive"),
    "kd": ("N m s/rad", "damping of the drive"),
    "gain": ("N m", "torque for each unit of the command"),
    "torque": ("N m", "largest torque of the drive"),
    "speed": ("rad/s", "speed without load under the largest torque: the damping is that torque over it"),
    "released": ("1", "share of the drive's damping with torque off"),
    "damping": ("N m s/rad", "viscous friction"),
    "armature": ("kg m^2", "rotor behind the gears"),
    "frictionloss": ("N m", "dry friction"),
    "zero": ("rad", "encoder at the model's zero"),
    "payload": ("kg", "mass added at the body's centre of mass"),
    "load": ("1", "dry friction of gears, as a share of the drive's torque"),
    "static": ("N m", "dry friction at rest beyond that in motion"),
    "stribeck_rad_s": ("rad/s", "speed at which 1/e of that is left"),
    "drag": ("N m s^2/rad^2", "friction by the square of the speed"),
    "bias": ("N m", "dry friction upwards beyond the mean of both directions"),
    "back_emf": ("N m s/rad", "damping by the motor's voltage, with torque on, beyond its limit"),
    "play": ("rad", "error of the angle that the drive leaves alone: dead zone, play of gears"),
    "tilt_x": ("rad", "turn of the direction of gravity about the model's x axis"),
    "tilt_y": ("rad", "turn of the direction of gravity about the model's y axis"),
    "gravcomp": ("1", "share of the bodies' weight that the robot's own controller carries"),
    "eccentric_cos": ("rad", "reading of an encoder off its axis beyond the angle, by the angle's cosine"),
    "eccentric_sin": ("rad", "reading of an encoder off its axis beyond the angle, by the angle's sine"),
    "cogging_cos": ("N m", "torque that repeats with the angle, by the cosine"),
    "cogging_sin": ("N m", "torque that repeats with the angle, by the sine"),
    "cogging_per_turn": ("1", "how often that torque repeats in a turn"),
}
_EXCITE = {
    "kp": "goals that change while the joint bears a load",
    "kd": "motion with torque off (`enabled`) besides that with torque on, to separate the joint's damping from it",
    "gain": "torques or duties that change",
    "torque": "commands that the drive cannot follow, so that it is at its limit",
    "speed": "commands that the drive cannot follow, so that it is at its limit",
    "released": "motion with torque off (`enabled`)",
    "damping": "fast motion of each joint, at several speeds",
    "armature": "fast changes of the command, up to a few hertz",
    "frictionloss": "slow motion of each joint, with reversals",
    "zero": "motion of each joint against gravity, up and down",
    "payload": "motion of each joint against gravity, up and down",
    "load": "the same motion with and without a load",
    "static": "slow motion of each joint, with reversals",
    "stribeck_rad_s": "motion of each joint at many speeds, from slow to fast, with reversals",
    "drag": "fast motion of each joint, at several speeds",
    "bias": "slow motion of each joint, with reversals",
    "back_emf": "commands that the drive cannot follow, so that it is at its limit",
    "play": "slow motion of each joint, with reversals, and goals that change little",
    "tilt_x": "motion of joints whose axes are not upright, against gravity, up and down",
    "tilt_y": "motion of joints whose axes are not upright, against gravity, up and down",
    "gravcomp": "motion of each joint against gravity, up and down, over a wide range of angles",
    "eccentric_cos": "motion of each joint over most of a turn",
    "eccentric_sin": "motion of each joint over most of a turn",
    "cogging_cos": "slow motion of each joint over many of its repeats, both ways",
    "cogging_sin": "slow motion of each joint over many of its repeats, both ways",
    "cogging_per_turn": "slow motion of each joint over many of its repeats, both ways",
}
"""Motion that determines each quantity."""
_VANISHING = ("kd", "damping", "armature", "frictionloss")
"""Quantities that may be 0."""
_FIXED = {"zero": (0.0, -0.15, 0.15), "released": (0.5, 0.0, 1.0), "payload": (0.0, 0.0, 5.0),
          "load": (0.0, 0.0, 1.0), "play": (0.0, 0.0, 0.1), "tilt_x": (0.0, -0.3, 0.3), "tilt_y": (0.0, -0.3, 0.3),
          "gravcomp": (0.0, 0.0, 1.5),          "eccentric_cos": (0.0, -0.1, 0.1), "eccentric_sin": (0.0, -0.1, 0.1),
          "cogging_per_turn": (1.0, 0.0, 10_000.0)}  # fmt: skip
_OF_MODEL = {
    "static": ("frictionloss", 5.0),
    "bias": ("frictionloss", 5.0),
    "drag": ("damping", 5.0),
    "back_emf": ("damping", 30.0),
    "cogging_cos": ("frictionloss", 5.0),
    "cogging_sin": ("frictionloss", 5.0),
}
"""Terms without a usual size: their bound is a factor times another quantity of the model."""
_BOTH_WAYS = ("bias", "cogging_cos", "cogging_sin")
"""Those that may be negative."""
OPTIONAL = {
    "load": ("load",),
    "stribeck": ("static", "stribeck_rad_s"),
    "drag": ("drag",),
    "direction": ("bias",),
    "back_emf": ("back_emf",),
    "play": ("play",),
    "gravcomp": ("gravcomp",),
    "tilt": ("tilt_x", "tilt_y"),
    "eccentricity": ("eccentric_cos", "eccentric_sin"),
    "cogging": ("cogging_cos", "cogging_sin"),
}
"""Optional terms, and the quantities that each has."""
TILT = OPTIONAL["tilt"]
WHOLE = (*TILT, *OPTIONAL["gravcomp"])
"""Quantities of the whole robot, without effect in a model without gravity."""
ONLY_NAMED = ("tilt", "eccentricity", "cogging")
"""Terms that ``auto`` omits unless a parameter names them: in few robots they differ from a zero or a stiffness."""
LAWS = (*(q for term in OPTIONAL.values() for q in term if q not in WHOLE), "cogging_per_turn")
"""Quantities that are set before every step."""
_ON_DRIVE = ("kp", "kd", "gain", "released", "zero")
ON_DOF = {"damping": "dof_damping", "armature": "dof_armature", "frictionloss": "dof_frictionloss"}


@dataclass(frozen=True)
class ParameterPattern:
    """One quantity of some joints, identified as one value or as one for each.

    Attributes:
        what: The quantity; ``payload`` is of a body.
        joints: Regular expression that a whole name must match.
        each: Whether each joint has a value of its own.
        nominal: The value to start from; None: the model's own, or a usual one.
        low: Lower bound; None: a factor below the nominal value.
        high: Upper bound; None: a factor above.
        name: Name of the parameter; default: the quantity, for a group with the letters of its pattern.
        free: Whether it is identified; otherwise it is held at ``nominal``.
        term: Optional term of the model that it belongs to; "": none.
    """

    what: What
    joints: str = ALL
    each: bool = False
    nominal: float | None = None
    low: float | None = None
    high: float | None = None
    name: str = ""
    free: bool = True
    term: str = ""

    def __post_init__(self) -> None:
        """Check what can be checked without a model."""
        if self.what not in _ABOUT:
            raise UsageError(f"unknown parameter {self.what!r} of a joint. Available: {', '.join(_ABOUT)}")
        try:
            re.compile(self.joints)
        except re.error as error:
            raise UsageError(
                f"{self.joints!r} is no pattern for joints: {error}", hint="such as .*_hip_joint"
            ) from None
        require_quick(self.joints, ())
        if self.what == "cogging_per_turn" and self.free:
            raise UsageError(
                "cogging_per_turn is counted, not identified",
                hint="write cogging_per_turn=N: of a motor the least common multiple of poles and slots, times gears",
            )
        if self.what in WHOLE and (self.each or self.joints != ALL):
            raise UsageError(f"{self.what} is the whole robot's", hint=f"write {self.what}")

    @staticmethod
    def parse(text: str) -> ParameterPattern:
        """Return the term of ``WHAT[:each][@PATTERN][=VALUE]``, e.g. ``frictionloss:each`` or ``kp@.*_calf_joint``."""
        match = re.fullmatch(r"(\w+)(:each)?(?:@([^=]+))?(?:=([-+.\deE]+))?", text)
        if not match:
            raise UsageError(f"{text!r} is no parameter", hint="write WHAT, WHAT:each, WHAT@PATTERN or WHAT=VALUE")
        what = cast(What, match[1])
        value = float(match[4]) if match[4] else None
        return ParameterPattern(what, match[3] or ALL, bool(match[2]), value, free=value is None)

    def label(self) -> str:
        """Return the name of a value that several joints share."""
        return self.name or (self.what if self.joints == ALL else f"{self.what}_{_letters(self.joints)}")


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
        at = [i for i, name in enumerate(names) if re.fullmatch(term.joints, name, re.DOTALL)]
        if not at:
            raise UsageError(
                f"{term.what!r}: {term.joints!r} matches none of {', '.join(names)}",
                hint="a pattern matches whole names: .*_hip_joint",
            )
        # Joints with one value form a group.
        sliding = set() if term.what == "payload" else set(slides_of(file_model, names))
        if term.each:
            groups = [([i], f"{term.name or term.what}_{_letters(names[i])}") for i in at]
        else:
            groups = [(part, term.label() + suffix) for part, suffix in _by_unit(term.what, at, names, sliding)]
        for group, name in groups:
            nominal = _nominal(term, [names[i] for i in group], file_model, whole_damping)
            unit = unit_for(_ABOUT[term.what][0], term.what not in WHOLE and names[group[0]] in sliding)
            p = replace(_parameter(term, name, nominal, _size(term, [names[i] for i in group], file_model)), unit=unit)
            placed.append(Placed(p, term.what, tuple(i + offset for i in group)))
    return placed


def _by_unit(what: str, at: list[int], names: Sequence[str], sliding: set[str]) -> list[tuple[list[int], str]]:
    """Return the groups of joints that may share a value, and the suffix of its name: slides have other units."""
    slides = [i for i in at if names[i] in sliding]
    hinges = [i for i in at if names[i] not in sliding]
    if what in WHOLE or unit_for(_ABOUT[what][0], True) == _ABOUT[what][0] or not (slides and hinges):
        return [(at, "")]
    return [(hinges, ""), (slides, "_slide")]


def optional(terms: Sequence[ParameterPattern], wanted: str = "all") -> tuple[ParameterPattern, ...]:
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
        value, at = jnp.asarray(values[p.parameter.name], float), np.array(p.at)
        if p.what in _ON_DRIVE:
            drive[p.what] = drive.get(p.what, getattr(base, p.what)).at[at].set(value)
        elif p.what in LAWS:
            terms = terms.replace(**{p.what: getattr(terms, p.what).at[at].set(value)})
        elif p.what in ("torque", "speed"):
            limits = model.get("jnt_actfrcrange", jnp.asarray(base.model.jnt_actfrcrange))
            if p.what == "torque":
                model["jnt_actfrcrange"] = limits.at[joints[at]].set(value * jnp.array([-1.0, 1.0]))
            else:
                damping = model.get("dof_damping", base.model.dof_damping)
                model["dof_damping"] = damping.at[dofs[at]].set(limits[joints[at], 1] / value)
        elif p.what == "payload":
            model["body_mass"] = model.get("body_mass", base.model.body_mass).at[at].add(value)
        else:
            field = ON_DOF[p.what]
            model[field] = model.get(field, getattr(base.model, field)).at[dofs[at]].set(value)

    # Replace the fields.
    if any(p.what in TILT for p in placed):
        model["opt.gravity"] = tilted(placed, values, base.model.opt.gravity)
    return base.replace(model=base.model.tree_replace(model), terms=terms, **drive)


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
    unit, about = _ABOUT[term.what]
    transform: Transform = "log"
    kind = "measurement" if term.what == "zero" else "dynamics"
    if term.what in _FIXED:
        _, low, high = _FIXED[term.what]
        transform = "linear"
    elif term.what in _OF_MODEL:
        low, high, transform = -own_size if term.what in _BOTH_WAYS else 0.0, own_size, "linear"
    else:
        below, above = _WIDE[term.what]
        low, high = nominal / below, nominal * above
    low, high = (bound if bound is not None else usual for bound, usual in ((term.low, low), (term.high, high)))
    return Parameter(name, unit, nominal, low, high, transform, kind, about, free=term.free, excite=_EXCITE[term.what],
        vanishes=term.what in _VANISHING, limits=term.what == "torque", term=term.term,
        off=nominal if term.term and not term.free else None,
    )  # fmt: skip


def _nominal(term: ParameterPattern, names: Sequence[str], file_model: MjModel, whole_damping: bool = False) -> float:
    """Return the nominal value: the median of the joints' values in the file.

    Args:
        whole_damping: Whether a joint's damping includes that of the file's servo.
    """
    if term.nominal is not None:
        return term.nominal
    if term.what == "gravcomp" and np.any(file_model.body_gravcomp > 0.0):
        return float(np.median(file_model.body_gravcomp[file_model.body_gravcomp > 0.0]))
    if term.what in _FIXED:
        return _FIXED[term.what][0]
    if term.what in _OF_MODEL:
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
        elif term.what == "torque" and (limit := limit_of(file_model, name)):
            values.append(limit)
    positive = [v for v in values if v > 0]
    return float(np.median(positive)) if positive else FALLBACK[term.what]


def _size(term: ParameterPattern, names: Sequence[str], file_model: MjModel) -> float:
    """Return the bound of a term without a usual size; 0 for other terms."""
    if term.what not in _OF_MODEL:
        return 0.0
    quantity, factor = _OF_MODEL[term.what]
    return factor * _nominal(replace(term, what=quantity, nominal=None), names, file_model)


def _letters(pattern: str) -> str:
    """Return the letters and digits of a name or a pattern, words apart."""
    return re.sub(r"\W+", "_", pattern.replace(".*", "")).strip("_") or "all"
