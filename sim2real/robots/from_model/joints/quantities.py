"""Quantities of a robot's model that can be identified, and patterns that name them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, cast

from sim2real.errors import UsageError
from sim2real.robots.from_model.joints.joint_patterns import require_quick

What = Literal[
    "kp", "kd", "gain", "torque", "speed", "released", "damping", "armature", "frictionloss", "zero", "payload",
    "load", "static", "stribeck_rad_s", "drag", "bias", "back_emf", "play", "top_speed", "tilt_x", "tilt_y", "gravcomp",
    "eccentric_cos", "eccentric_sin", "cogging_cos", "cogging_sin", "cogging_per_turn",
    "kp_factor", "kd_factor", "gain_factor", "damping_factor", "armature_factor", "voltage", "damping_bias",
]  # fmt: skip
FACTORS = ("kp_factor", "kd_factor", "gain_factor", "damping_factor", "armature_factor")
"""Factors of some joints on the quantity that all joints share."""
ALIKE = 0.3
"""Deviation of their prior, about 1: joints of one robot are alike where the data does not show otherwise."""
ALL = ".*"
TILT = ("tilt_x", "tilt_y")
COGGING = ("cogging_cos", "cogging_sin", "cogging_per_turn")
WIDE = {"kp": (10, 10), "kd": (30, 30), "gain": (20, 20), "torque": (5, 5), "speed": (5, 5), "top_speed": (5, 5),
         "damping": (30, 30), "armature": (30, 30), "frictionloss": (50, 20), "stribeck_rad_s": (10, 20)}  # fmt: skip
"""Factors of the lower bound below, and of the upper bound above the nominal value."""
FALLBACK = {"kp": 20.0, "kd": 0.5, "gain": 1.0, "torque": 10.0, "speed": 20.0, "top_speed": 20.0, "damping": 0.1,
             "armature": 0.01, "frictionloss": 0.1, "stribeck_rad_s": 0.1}  # fmt: skip
"""Nominal values where the model has none."""
ABOUT = {
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
    "damping_bias": ("N m s/rad", "viscous friction upwards beyond the mean of both directions"),
    "back_emf": ("N m s/rad", "damping by the motor's voltage, with torque on, beyond its limit"),
    "play": ("rad", "error of the angle that the drive leaves alone: dead zone, play of gears"),
    "top_speed": ("rad/s", "largest speed of the answer to a step of the goal"),
    "tilt_x": ("rad", "turn of the direction of gravity about the model's x axis"),
    "tilt_y": ("rad", "turn of the direction of gravity about the model's y axis"),
    "gravcomp": ("1", "share of the bodies' weight that the robot's own controller carries"),
    "eccentric_cos": ("rad", "reading of an encoder off its axis beyond the angle, by the angle's cosine"),
    "eccentric_sin": ("rad", "reading of an encoder off its axis beyond the angle, by the angle's sine"),
    "cogging_cos": ("N m", "torque that repeats with the angle, by the cosine"),
    "cogging_sin": ("N m", "torque that repeats with the angle, by the sine"),
    "cogging_per_turn": ("1", "how often that torque repeats in a turn"),
    "voltage": ("1", "share of the drive's strength that is proportional to the supply voltage"),
    **{f: ("1", f"{f.removesuffix('_factor')}, beside that of the first joints") for f in FACTORS},
}
EXCITE = {
    "kp": "goals that change while the joint bears a load",
    "kd": "motion with torque off (`enabled`) besides that with torque on, to separate the joint's damping from it",
    "gain": "torques or duties that change",
    "released": "motion with torque off (`enabled`)",
    "armature": "fast changes of the command, up to a few hertz",
    "load": "the same motion with and without a load",
    "stribeck_rad_s": "motion of each joint at many speeds, from slow to fast, with reversals",
    "play": "slow motion of each joint, with reversals, and goals that change little",
    "top_speed": "goals that change in steps, so far that the speed does not rise with the step any more",
    "gravcomp": "motion of each joint against gravity, up and down, over a wide range of angles",
    **dict.fromkeys(("torque", "speed", "back_emf"), "commands that the drive cannot follow, at its limit"),
    **dict.fromkeys(("frictionloss", "static", "bias"), "slow motion of each joint, with reversals"),
    **dict.fromkeys(("damping", "damping_bias", "drag"), "fast motion of each joint, at several speeds"),
    **dict.fromkeys(("zero", "payload"), "motion of each joint against gravity, up and down"),
    **dict.fromkeys(TILT, "motion of joints whose axes are not upright, against gravity, up and down"),
    **dict.fromkeys(("eccentric_cos", "eccentric_sin"), "motion of each joint over most of a turn"),
    "voltage": "motion against a load while the supply voltage changes",
    **dict.fromkeys(FACTORS, "motion of each joint, as of the first ones"),
    **dict.fromkeys(COGGING, "slow motion of each joint over many of its repeats, both ways"),
}
"""Motion that determines each quantity."""
VANISHING = ("kd", "damping", "armature", "frictionloss")
"""Quantities that may be 0."""
FIXED = {"zero": (0.0, -0.15, 0.15), "released": (0.5, 0.0, 1.0), "payload": (0.0, 0.0, 5.0),
          "load": (0.0, 0.0, 1.0), "play": (0.0, 0.0, 0.1), "tilt_x": (0.0, -0.3, 0.3), "tilt_y": (0.0, -0.3, 0.3),
          "gravcomp": (0.0, 0.0, 1.5), "voltage": (0.0, 0.0, 1.5),
          "eccentric_cos": (0.0, -0.1, 0.1), "eccentric_sin": (0.0, -0.1, 0.1),
          "cogging_per_turn": (1.0, 0.0, 10_000.0)}  # fmt: skip
OF_MODEL = {"static": ("frictionloss", 5.0), "bias": ("frictionloss", 5.0), "drag": ("damping", 5.0),
             "damping_bias": ("damping", 1.0), "back_emf": ("damping", 30.0), "cogging_cos": ("frictionloss", 5.0),
             "cogging_sin": ("frictionloss", 5.0)}  # fmt: skip
"""Terms without a usual size: their bound is a factor times another quantity of the model."""
BOTH_WAYS = ("bias", "damping_bias", "cogging_cos", "cogging_sin")
"""Those that may be negative."""
OPTIONAL = {
    "load": ("load",),
    "stribeck": ("static", "stribeck_rad_s"),
    "drag": ("drag",),
    "direction": ("bias",),
    "viscous_direction": ("damping_bias",),
    "back_emf": ("back_emf",),
    "play": ("play",),
    "torque_limit": ("torque",),
    "speed_limit": ("top_speed",),
    "voltage": ("voltage",),
    "gravcomp": ("gravcomp",),
    "tilt": TILT,
    "eccentricity": ("eccentric_cos", "eccentric_sin"),
    "cogging": ("cogging_cos", "cogging_sin"),
}
"""Optional terms, and the quantities that each has."""
WHOLE = (*TILT, *OPTIONAL["gravcomp"])
"""Quantities of the whole robot, without effect in a model without gravity."""
ONLY_NAMED = ("viscous_direction", "tilt", "eccentricity", "cogging")
"""Terms that ``auto`` omits unless a parameter names them: in few robots they differ from a zero or a stiffness, and
damping that differs by direction predicted 1 s of the EMPS best, and 10 s of it worst."""
LIMITS = (*OPTIONAL["torque_limit"], *OPTIONAL["speed_limit"])
"""Limits of what a drive does, absent at ``NO_LIMIT``. As optional terms they get their bounds from the recordings."""
LAWS = (*(q for term in OPTIONAL.values() for q in term if q not in (*WHOLE, "torque", "voltage")), "cogging_per_turn")
"""Quantities that are set before every step."""
ON_DRIVE = ("kp", "kd", "gain", "released", "zero", "voltage")
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
        if self.what not in ABOUT:
            raise UsageError(f"unknown parameter {self.what!r} of a joint. Available: {', '.join(ABOUT)}")
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
        return self.name or (self.what if self.joints == ALL else f"{self.what}_{letters(self.joints)}")


def letters(pattern: str) -> str:
    """Return the letters and digits of a name or a pattern, words apart."""
    return re.sub(r"\W+", "_", pattern.replace(".*", "")).strip("_") or "all"
