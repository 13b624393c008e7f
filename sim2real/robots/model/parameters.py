"""Identifiable quantities of an MJCF with drives, as one table, and the parameters that patterns select."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from sim2real.arrays import beside_damping
from sim2real.errors import UsageError
from sim2real.identification.parameters import Parameter
from sim2real.robots.model.drives import force_of, gains_of, limit_of, slides_of, unit_for
from sim2real.types import Array, MjModel, PyTree, Scalar
from sim2real.worlds.drive_terms import NO_LIMIT
from sim2real.worlds.driven import PAYLOAD

ALL = ".*"
ALIKE = 0.3
"""Standard deviation of the prior of factors between joints, around 1: joints of a robot are alike unless data shows
more.
"""


@dataclass(frozen=True)
class Quantity:
    """A quantity of a model with drives; a row of the table ``QUANTITIES``.

    Attributes:
        unit: Unit for a hinge; for a slide, m replaces rad and N replaces N m.
        about: Description.
        excite: Motion that determines it.
        low, high: Bounds; see ``scale``.
        place: Where a value belongs: ``drive`` (a field of ``DriveParams``), ``law`` (a field of ``DriveTerms``), a
            field of the model per degree of freedom, or another name that ``place`` handles.
        term: Optional term of the model; "": none.
        nominal: Value if the file has none.
        scale: "": bounds are values; ``factor``: bounds are factors of the nominal value; the name of another quantity:
            bounds are factors of its nominal value.
        vanishes: Whether it may be 0.
        named: Whether ``auto`` omits its term unless a parameter names it: most logs cannot tell such terms from a zero
            or a stiffness, and damping that differs by direction made the EMPS's predictions of 10 s worse.
    """

    unit: str
    about: str
    excite: str
    low: float
    high: float
    place: str = "drive"
    term: str = ""
    nominal: float = 0.0
    scale: str = ""
    vanishes: bool = False
    named: bool = False


_LIMIT, _SLOW = "commands that the drive cannot follow, at its limit", "slow motion of each joint, with reversals"
_FAST, _WEIGHT = "fast motion of each joint, at several speeds", "motion of each joint against gravity, up and down"
_RELEASED = "motion with torque off (`enabled`)"
_GEARS, _TURN = (
    "slow motion of each joint over many of its repeats, both ways",
    "motion of each joint over most of a turn",
)
_UPRIGHT = "motion of joints whose axes are not upright, against gravity, up and down"
_PLAY = "slow motion of each joint, with reversals, and goals that change little"
_STEPS = "goals that change in steps, so far that the speed does not rise with the step any more"
_ALIKE = "motion of each joint, as of the first ones"


def _factor(of: str) -> Quantity:
    return Quantity("1", f"{of}, beside that of the first joints", _ALIKE, 0.2, 5.0, "factor", nominal=1.0)


QUANTITIES: Mapping[str, Quantity] = {
    "kp": Quantity("N m/rad", "stiffness of the drive", "goals that change while the joint bears a load",
                   10, 10, nominal=20.0, scale="factor"),
    "kd": Quantity("N m s/rad", "damping of the drive", f"{_RELEASED} besides that with torque on, to separate the "
                   "joint's damping from it", 30, 30, nominal=0.5, scale="factor", vanishes=True),
    "gain": Quantity("N m", "torque for each unit of the command", "torques or duties that change",
                     20, 20, nominal=1.0, scale="factor"),
    "released": Quantity("1", "share of the drive's damping with torque off", _RELEASED, 0.0, 1.0, nominal=0.5),
    "zero": Quantity("rad", "encoder at the model's zero", _WEIGHT, -0.15, 0.15),
    "damping": Quantity("N m s/rad", "viscous friction", _FAST, 30, 30, "dof_damping", "", 0.1, "factor", True),
    "armature": Quantity("kg m^2", "rotor behind the gears", "fast changes of the command, up to a few hertz",
                         30, 30, "dof_armature", "", 0.01, "factor", True),
    "frictionloss": Quantity("N m", "dry friction", _SLOW, 50, 20, "dof_frictionloss", "", 0.1, "factor", True),
    "payload": Quantity("kg", "mass added at the body's centre of mass", _WEIGHT, 0.0, 5.0, "payload"),
    "load": Quantity("1", "dry friction of gears, as a share of the drive's torque",
                     "the same motion with and without a load", 0.0, 1.0, "law", "load"),
    "static": Quantity("N m", "dry friction at rest beyond that in motion", _SLOW, 0, 5, "law", "stribeck",
                       scale="frictionloss"),
    "stribeck_rad_s": Quantity("rad/s", "speed at which 1/e of that is left",
                               "motion of each joint at many speeds, from slow to fast, with reversals",
                               10, 20, "law", "stribeck", 0.1, "factor"),
    "drag": Quantity("N m s^2/rad^2", "friction by the square of the speed", _FAST, 0, 5, "law", "drag",
                     scale="damping"),
    "bias": Quantity("N m", "dry friction upwards beyond the mean of both directions", _SLOW, -5, 5, "law", "direction",
                     scale="frictionloss"),
    "damping_bias": Quantity("N m s/rad", "viscous friction upwards beyond the mean of both directions", _FAST,
                             -1, 1, "law", "viscous_direction", scale="damping", named=True),
    "back_emf": Quantity("N m s/rad", "damping by the motor's voltage, with torque on, beyond its limit", _LIMIT,
                         0, 30, "law", "back_emf", scale="damping"),
    "play": Quantity("rad", "error of the angle that the drive leaves alone: dead zone, play of gears", _PLAY,
                     0.0, 0.1, "law", "play"),
    "torque": Quantity("N m", "largest torque of the drive", _LIMIT, 5, 5, "torque", "torque_limit", 10.0, "factor"),
    "top_speed": Quantity("rad/s", "largest speed of the answer to a step of the goal", _STEPS,
                          5, 5, "law", "speed_limit", 20.0, "factor"),
    "voltage": Quantity("1", "share of the drive's strength that is proportional to the supply voltage",
                        "motion against a load while the supply voltage changes", 0.0, 1.5, term="voltage"),
    "gravcomp": Quantity("1", "share of the bodies' weight that the robot's own controller carries",
                         "motion of each joint against gravity, up and down, over a wide range of angles",
                         0.0, 1.5, "robot", "gravcomp"),
    "tilt_x": Quantity("rad", "turn of the direction of gravity about the model's x axis", _UPRIGHT,
                       -0.3, 0.3, "robot", "tilt", named=True),
    "tilt_y": Quantity("rad", "turn of the direction of gravity about the model's y axis", _UPRIGHT,
                       -0.3, 0.3, "robot", "tilt", named=True),
    "eccentric_cos": Quantity("rad", "reading of an encoder off its axis beyond the angle, by the angle's cosine",
                              _TURN, -0.1, 0.1, "law", "eccentricity", named=True),
    "eccentric_sin": Quantity("rad", "reading of an encoder off its axis beyond the angle, by the angle's sine", _TURN,
                              -0.1, 0.1, "law", "eccentricity", named=True),
    "cogging_cos": Quantity("N m", "torque that repeats with the angle, by the cosine", _GEARS,
                            -5, 5, "law", "cogging", scale="frictionloss", named=True),
    "cogging_sin": Quantity("N m", "torque that repeats with the angle, by the sine", _GEARS,
                            -5, 5, "law", "cogging", scale="frictionloss", named=True),
    "cogging_per_turn": Quantity("1", "how often that torque repeats in a turn", _GEARS, 0.0, 10_000.0, "law",
                                 nominal=1.0),
    **{f"{of}_factor": _factor(of) for of in ("kp", "kd", "gain", "damping", "armature")},
}  # fmt: skip
"""Name -> quantity. A limit (``torque``, ``top_speed``) of ``NO_LIMIT`` is absent; as an optional term it gets its
bounds from the recordings.
"""
LIMITS = ("torque", "top_speed")
TERMS = {
    q.term: tuple(n for n, other in QUANTITIES.items() if other.term == q.term) for q in QUANTITIES.values() if q.term
}
"""Optional term -> its quantities."""


@dataclass(frozen=True)
class ParameterPattern:
    """One quantity of some joints, identified as a common value, or as a value of each joint.

    Attributes:
        what: Name of the quantity, such as ``damping``; ``payload`` belongs to a body instead of joints.
        joints: Regular expression that must match a joint's whole name.
        each: Whether each joint gets its own parameter.
        nominal: Value to start from; None: the model's value, or that of the table ``QUANTITIES``.
        low: Lower bound; None: as in the table.
        high: Upper bound; None: as in the table.
        name: Name of the parameter; default: the quantity, followed by the letters of ``joints`` for some joints.
        free: Whether it is identified; otherwise it is fixed at ``nominal``.
        term: Optional term of the model that it belongs to; "": none.
    """

    what: str
    joints: str = ALL
    each: bool = False
    nominal: float | None = None
    low: float | None = None
    high: float | None = None
    name: str = ""
    free: bool = True
    term: str = ""

    def __post_init__(self) -> None:
        """Check what does not depend on a model."""
        if self.what not in QUANTITIES:
            raise UsageError(f"unknown parameter {self.what!r} of a joint. Available: {', '.join(QUANTITIES)}")
        try:
            re.compile(self.joints)
        except re.error as error:
            hint = "such as .*_hip_joint"
            raise UsageError(f"{self.joints!r} is not a pattern for joints: {error}", hint=hint) from None
        if self.what == "cogging_per_turn" and self.free:
            raise UsageError(
                "cogging_per_turn is counted, not identified",
                hint="write cogging_per_turn=N: the least common multiple of poles and slots, times the gear ratio",
            )
        if self.quantity.place == "robot" and (self.each or self.joints != ALL):
            raise UsageError(f"{self.what} is a parameter of the whole robot", hint=f"write {self.what}")

    @staticmethod
    def parse(text: str) -> ParameterPattern:
        """Return the pattern of ``WHAT[:each][@PATTERN][=VALUE]``, e.g. ``frictionloss:each`` or ``kp@.*_calf``."""
        match = re.fullmatch(r"(\w+)(:each)?(?:@([^=]+))?(?:=([-+.\deE]+))?", text)
        if not match:
            raise UsageError(f"{text!r} is not a parameter", hint="write WHAT, WHAT:each, WHAT@PATTERN or WHAT=VALUE")
        value = float(match[4]) if match[4] else None
        return ParameterPattern(match[1], match[3] or ALL, bool(match[2]), value, free=value is None)

    @property
    def quantity(self) -> Quantity:
        """Its row of the table ``QUANTITIES``."""
        return QUANTITIES[self.what]

    @property
    def absent(self) -> bool:
        """Whether it is a limit that only an optional term adds."""
        return self.what in LIMITS and bool(self.term) and not self.free

    def matches(self, name: str) -> bool:
        """Return whether the pattern selects a joint or body."""
        return re.fullmatch(self.joints, name, re.DOTALL) is not None


@dataclass(frozen=True)
class ParameterAt:
    """A parameter, and the joints or bodies to which its value belongs.

    Attributes:
        parameter: The parameter.
        what: The quantity.
        at: Numbers of the joints in the robot's order; for ``payload``, numbers of the model's bodies.
    """

    parameter: Parameter
    what: str
    at: tuple[int, ...]

    @property
    def among_limits(self) -> bool:
        """Whether it is a limit that no pattern names: then the file's limits hold, too."""
        return self.what in LIMITS and bool(self.parameter.term) and not self.parameter.free


# -- patterns


def usual_patterns(
    commands: Sequence[str], physical: bool = False, model: MjModel = None, joints: Sequence[str] = ()
) -> tuple[ParameterPattern, ...]:
    """Return the patterns of the parameters that are identified if the user names none.

    Each group of like joints has one stiffness or gain, one damping and one inertia; each joint has its own dry
    friction. The damping of the drive can be told from that of the joint only if torque is switched off in the log, or
    if the log has gains; otherwise there is one damping.

    Args:
        commands: Fields of the log that drive joints.
        physical: Whether the log has gains in N m/rad and N m s/rad: then one factor on them is identified for all
            joints.
        model: The file's model, by whose values joints are grouped; default: all joints are one group.
        joints: The recorded joints.
    """
    factors: list[ParameterPattern] = []
    grouped: list[str] = []
    if "goal" in commands and physical:
        factors = [ParameterPattern(what, nominal=1.0, low=0.3, high=3.0) for what in ("kp", "kd")]
    elif "goal" in commands:
        grouped = ["kp", *(["kd"] if "enabled" in commands else [])]
    else:
        grouped = ["kd" if "goal_velocity" in commands else "gain"]
    if "goal_velocity" not in commands or "goal" in commands:
        grouped.append("damping")
    grouped.append("armature")
    groups = alike_joints(model, joints) if model is not None else []
    names = _group_names(groups)
    patterns = [
        ParameterPattern(what, "|".join(map(re.escape, group)), name=f"{what}_{name}")
        if len(groups) > 1
        else ParameterPattern(what)
        for what in grouped
        for group, name in zip(groups or [[]], names or [""], strict=True)
    ]
    return (*factors, *patterns, ParameterPattern("frictionloss", each=True))


def alike_joints(model: MjModel, joints: Sequence[str]) -> list[list[str]]:
    """Return groups of joints for which the file has the same gains, torque limit, damping, inertia and friction."""
    groups: dict[object, list[str]] = {}
    for joint in joints:
        dof = model.joint(joint).dofadr[0]
        fields = ("dof_damping", "dof_armature", "dof_frictionloss")
        own = tuple(round(float(getattr(model, field)[dof]), 9) for field in fields)
        groups.setdefault((gains_of(model, joint), limit_of(model, joint), own), []).append(joint)
    return list(groups.values())


def _group_names(groups: Sequence[Sequence[str]], most: int = 3) -> list[str]:
    """Return a name for each group: words that only its joints share, such as ``calf``, or its first joints."""
    words = [[re.findall(r"[A-Za-z0-9]+", joint) for joint in joints] for joints in groups]
    names = []
    for i, joints in enumerate(groups):
        elsewhere = {word for k, group in enumerate(words) if k != i for joint in group for word in joint}
        own = [word for word in words[i][0] if word not in elsewhere and all(word in joint for joint in words[i])]
        first = "_".join("_".join(joint) for joint in words[i][:most])
        more = f"_and_{len(joints) - most}" if len(joints) > most else ""
        names.append("_".join(own) if own and len(joints) > 1 else first + more)
    # Number names without Latin letters, and names that differ only in punctuation.
    return names if len({*names, ""}) > len(names) else [f"group{i + 1}" for i in range(len(names))]


def with_optional(
    patterns: Sequence[ParameterPattern], wanted: str = "all", joints: Sequence[str] = ()
) -> tuple[ParameterPattern, ...]:
    """Return the patterns, and a pattern for each further quantity of the optional terms.

    These quantities are 0 unless ``--terms`` chooses their terms.

    Args:
        wanted: ``auto``, ``all``, or names separated by commas, in addition to ``auto``. A quantity that a pattern
            names is available without the other quantities of its term.
    """
    named, names = {p.what for p in patterns}, {n.strip() for n in wanted.split(",")}
    if "cogging" in names and "cogging_per_turn" not in named:
        raise UsageError(
            "cogging needs the number of its periods in a turn of the joint", hint="add --parameter cogging_per_turn=N"
        )

    def offered(term: str) -> bool:
        if not any(QUANTITIES[what].named for what in TERMS[term]) or term in names:
            return True
        return wanted == "all" and (term != "cogging" or "cogging_per_turn" in named)

    further = [
        ParameterPattern(what, free=False, term=term)
        for term, quantities in TERMS.items()
        if offered(term)
        for what in quantities
        if what not in named
    ]
    return (*(replace(p, term=p.quantity.term) for p in patterns), *further, *sharing(patterns, joints, wanted))


_LESS = 200.0
"""Dry friction that the file does not have may be below the lower bound by this factor."""
_SIDES = {"l", "r", "left", "right", "fl", "fr", "rl", "rr", "lf", "rf", "lr", "lh", "rh", "hl", "hr", "bl", "br",
          "front", "rear", "hind", "back", "upper", "lower", "joint"}  # fmt: skip
"""Words by which the names of like joints differ."""
_MOST_JOINTS = 8
"""`auto` gives each joint its own value in robots of up to this many joints: with 12, a term has up to 11 parameters.
"""


def like_joints(joints: Sequence[str]) -> list[list[str]]:
    """Return groups of joints whose names are equal except for sides and numbers."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in joints:
        words = re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
        groups.setdefault(tuple(part for part in words if part not in _SIDES), []).append(name)
    return list(groups.values())


def sharing(patterns: Sequence[ParameterPattern], joints: Sequence[str], wanted: str) -> list[ParameterPattern]:
    """Return the factors by which groups of joints, or joints, differ from the first joint with the same value.

    Args:
        wanted: ``auto``, ``all``, or names of terms separated by commas.
    """
    names, found = {n.strip() for n in wanted.split(",")}, list[ParameterPattern]()
    for pattern in patterns:
        together, factor = [j for j in joints if pattern.matches(j)], f"{pattern.what}_factor"
        if not pattern.free or pattern.each or factor not in QUANTITIES or len(together) < 2:
            continue
        for kind, parts in (("by_group", like_joints(together)), ("by_joint", [[j] for j in together])):
            term = f"{pattern.what}_{kind}"
            usual = "all" in names or ("auto" in names and (kind == "by_group" or len(joints) <= _MOST_JOINTS))
            if not 1 < len(parts) < (len(together) if kind == "by_group" else len(together) + 1):
                continue
            if usual or term in names:
                end = "" if kind == "by_group" else "_alone"
                for part in parts[1:]:
                    label = f"{pattern.what}_of_{_shared_words(part)}{end}"
                    matching = "|".join(map(re.escape, part))
                    found.append(ParameterPattern(factor, matching, free=False, name=label, term=term))
    return found


def _shared_words(part: Sequence[str]) -> str:
    """Return the name of a joint, or the words that all names of a group share."""
    names = [re.split(r"\W+|_", name) for name in part]
    return "_".join(piece for piece in names[0] if all(piece in other for other in names))


# -- parameters


def expand(
    patterns: Sequence[ParameterPattern], joints: Sequence[str], model: MjModel, file_model: MjModel
) -> list[ParameterAt]:
    """Return the parameters of a model.

    Args:
        model: Compiled model with drives.
        file_model: Compiled model of the file.
    """
    found: list[ParameterAt] = []
    # If the drive has no damping, the joint's damping includes the damping of the file's servo.
    quantities = {pattern.what for pattern in patterns}
    whole_damping = "kp" in quantities and "kd" not in quantities
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    for pattern in patterns:
        of_body = pattern.what == "payload"
        names = bodies if of_body else list(joints)
        at = [i for i, name in enumerate(names) if name != PAYLOAD and pattern.matches(name)]
        if not at:
            raise UsageError(
                f"{pattern.what!r}: {pattern.joints!r} matches none of {', '.join(names)}",
                hint="a pattern matches whole names: .*_hip_joint",
            )
        # Joints with a common value form a group; slides and hinges have different units.
        sliding = set() if of_body or pattern.quantity.place == "robot" else set(slides_of(file_model, names))
        slides = [i for i in at if names[i] in sliding]
        hinges = [i for i in at if names[i] not in sliding]
        unit = pattern.quantity.unit
        label = pattern.name or (pattern.what if pattern.joints == ALL else f"{pattern.what}_{letters(pattern.joints)}")
        if pattern.each:
            groups = [([i], f"{pattern.name or pattern.what}_{letters(names[i])}") for i in at]
        elif slides and hinges and unit_for(unit, True) != unit:
            groups = [(hinges, label), (slides, f"{label}_slide")]
        else:
            groups = [(at, label)]
        for group, name in groups:
            some = [names[i] for i in group]
            parameter = _parameter(pattern, name, some, file_model, whole_damping)
            parameter = replace(parameter, unit=unit_for(unit, some[0] in sliding))
            found.append(ParameterAt(parameter, pattern.what, tuple(i + of_body for i in group)))
    return found


def letters(pattern: str) -> str:
    """Return the words of a name or a pattern, separated by underscores."""
    return re.sub(r"\W+", "_", pattern.replace(".*", "")).strip("_") or "all"


def _parameter(
    pattern: ParameterPattern, name: str, names: Sequence[str], file_model: MjModel, whole_damping: bool
) -> Parameter:
    quantity, what = pattern.quantity, pattern.what
    nominal = _nominal(pattern, names, file_model, whole_damping)
    # Bounds: values, factors of the nominal value, or factors of another quantity.
    low, high = quantity.low, quantity.high
    linear = quantity.scale != "factor" and quantity.place != "factor"
    if what in LIMITS and not pattern.free:
        low, high, linear = NO_LIMIT / 1e9, NO_LIMIT, False
    elif quantity.scale == "factor":
        low, high = nominal / quantity.low, nominal * quantity.high
        if what == "gain":  # the log may have the force at the joint, although the file's motor has a gear
            low, high = min(nominal, 1.0) / quantity.low, max(nominal, 1.0) * quantity.high
        if what == "frictionloss" and nominal == quantity.nominal:  # a guess, as the file has none: it may be far less
            low /= _LESS
    elif quantity.scale:
        size = _nominal(replace(pattern, what=quantity.scale, nominal=None, term="", free=True), names, file_model)
        low, high = size * quantity.low, size * quantity.high
    absent = NO_LIMIT if what in LIMITS else nominal
    return Parameter(
        name,
        quantity.unit,
        nominal,
        low if pattern.low is None else pattern.low,
        high if pattern.high is None else pattern.high,
        "linear" if linear else "log",
        "measurement" if what == "zero" else "dynamics",
        quantity.about,
        free=pattern.free,
        excite=quantity.excite,
        vanishes=quantity.vanishes,
        limits=what in LIMITS,
        term=pattern.term,
        prior=(1.0, ALIKE) if quantity.place == "factor" else None,
        off=absent if pattern.term and (not pattern.free or what in LIMITS) else None,
    )


def _nominal(
    pattern: ParameterPattern, names: Sequence[str], file_model: MjModel, whole_damping: bool = False
) -> float:
    """Return the nominal value: the median of the joints' values in the file.

    Args:
        whole_damping: Whether a joint's damping includes the damping of the file's servo.
    """
    what, quantity = pattern.what, pattern.quantity
    if pattern.nominal is not None:
        return pattern.nominal
    if pattern.absent:
        return NO_LIMIT
    if what == "gravcomp" and np.any(file_model.body_gravcomp > 0.0):
        return float(np.median(file_model.body_gravcomp[file_model.body_gravcomp > 0.0]))
    if quantity.scale != "factor":
        return quantity.nominal
    # The values of the joints that have one in the file.
    values: list[float | None] = []
    for name in names:
        gains = gains_of(file_model, name)
        if quantity.place.startswith("dof_"):
            value = float(getattr(file_model, quantity.place)[file_model.joint(name).dofadr[0]])
            values.append(value + (gains[1] if gains and whole_damping and what == "damping" else 0.0))
        elif what in ("kp", "kd"):
            values.append(gains and gains[what == "kd"])
        elif what in ("gain", "torque"):
            values.append((force_of if what == "gain" else limit_of)(file_model, name))
    positive = [v for v in values if v and v > 0]
    return float(np.median(positive)) if positive else quantity.nominal


# -- values in their places


def place(
    placed: Sequence[ParameterAt], values: Mapping[str, Scalar], base: PyTree, joints: np.ndarray, dofs: np.ndarray
) -> PyTree:
    """Put values of parameters into the world's parameters; return these.

    Args:
        base: ``DriveParams`` with nominal values.
        joints: Shape ``(joints,)``: their numbers in the model.
        dofs: Shape ``(joints,)``: index of each joint in the model's arrays.
    """
    drive: dict[str, PyTree] = {}
    model: dict[str, PyTree] = {}
    terms: PyTree = base.terms

    def field(name: str) -> PyTree:
        return model.get(name, jnp.asarray(getattr(base.model, name)))

    for p in placed:
        where = QUANTITIES[p.what].place
        if where == "factor" or p.what.startswith("tilt"):
            continue
        value, at = of_each(p, placed, values), np.array(p.at)
        if p.what == "gravcomp":
            carried = base.model.body_gravcomp
            model["body_gravcomp"] = jnp.where(carried > 0.0, values[p.parameter.name], carried)
        elif where == "drive":
            drive[p.what] = drive.get(p.what, getattr(base, p.what)).at[at].set(value)
        elif where == "law":
            terms = terms.replace(**{p.what: getattr(terms, p.what).at[at].set(value)})
        elif where == "torque":
            limits = field("jnt_actfrcrange")
            most = jnp.minimum(limits[joints[at], 1], value) if p.among_limits else value
            model["jnt_actfrcrange"] = limits.at[joints[at]].set(most[:, None] * jnp.array([-1.0, 1.0]))
        elif where == "payload":
            model["body_mass"] = field("body_mass").at[at].add(value)
        else:
            model[where] = field(where).at[dofs[at]].set(value)
    if model.keys() & {"dof_armature", "dof_damping"}:
        armature, damping = field("dof_armature"), field("dof_damping")
        rotor = beside_damping(armature[dofs], damping[dofs], base.model.opt.timestep)
        model["dof_armature"] = armature.at[dofs].set(rotor)
    if any(p.what.startswith("tilt") for p in placed):
        model["opt.gravity"] = tilted(placed, values, base.model.opt.gravity)
    return base.replace(model=base.model.tree_replace(model), terms=terms, **drive)


def of_each(p: ParameterAt, placed: Sequence[ParameterAt], values: Mapping[str, Scalar]) -> Array:
    """Return the value of a parameter at each of its joints, ``(joints,)``, times the joint's factors."""
    value = jnp.full(len(p.at), jnp.asarray(values[p.parameter.name], float))
    for factor in placed:
        if factor.what == f"{p.what}_factor":
            times = jnp.asarray(values[factor.parameter.name], float)
            value = jnp.where(np.isin(p.at, factor.at), times * value, value)
    return value


def tilted(placed: Sequence[ParameterAt], values: Mapping[str, Scalar], gravity: Array) -> PyTree:
    """Return gravity ``(3,)`` [m/s^2] turned about the model's x axis, then about its y axis.

    Args:
        gravity: Gravity of the model, ``(3,)`` [m/s^2].
    """
    angle = {p.what: values[p.parameter.name] for p in placed if p.what.startswith("tilt")}
    if not angle:
        return gravity
    x, y = (jnp.asarray(angle.get(what, 0.0), float) for what in ("tilt_x", "tilt_y"))
    g = jnp.asarray(gravity, float)
    g = jnp.array([g[0], jnp.cos(x) * g[1] - jnp.sin(x) * g[2], jnp.sin(x) * g[1] + jnp.cos(x) * g[2]])
    return jnp.array([jnp.cos(y) * g[0] + jnp.sin(y) * g[2], g[1], jnp.cos(y) * g[2] - jnp.sin(y) * g[0]])
