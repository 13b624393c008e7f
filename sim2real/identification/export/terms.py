"""An identification in MuJoCo's terms: every field of the model that it determines, with an interval.

No table maps parameters to fields. Robots are drawn from the posterior, and a model is compiled of each: the fields
that differ between the models were identified, also by parameters that several joints share.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from sim2real.artifacts.identification import ROUND_TRIP, Estimate, Identification
from sim2real.artifacts.timing import Spread

DRAWS = 200
"""Number of robots drawn from the posterior: the ends of a 95 % interval then vary by a twelfth of its width."""
_mj: Any = mujoco
_HINGE_OR_SLIDE = (int(_mj.mjtJoint.mjJNT_HINGE), int(_mj.mjtJoint.mjJNT_SLIDE))
_DOF = {"damping": "dof_damping", "armature": "dof_armature", "frictionloss": "dof_frictionloss"}
_BODY = ("mass", "ipos", "inertia")


@dataclass(frozen=True)
class Term:
    """A number of a model: its estimate, and the ends of its 95 % interval."""

    estimate: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether the interval is a point: the identification does not change this number."""
        return self.low == self.high


@dataclass(frozen=True)
class Delays:
    """Delays that a simulation without them has to add [s]; None where nothing of the kind was identified.

    Attributes:
        command: From a command's departure to its effect.
        measurement: From a motion to the stamp of its measurement.
        round_trip: Sum of both, which a log determines even if it does not separate them.
        computation: Node -> from the start of a step to its end, as recorded.
    """

    command: Term | None = None
    measurement: Term | None = None
    round_trip: Term | None = None
    computation: Mapping[str, Spread] | None = None


@dataclass(frozen=True)
class Terms:
    """A robot in a simulator's terms.

    Attributes:
        joints: Joint -> ``damping``, ``armature``, ``frictionloss`` and, where an actuator drives it, ``stiffness``,
            ``actuator_damping``, ``effort_limit``, and ``gain`` if its command is no position.
        bodies: Body -> ``mass``, ``ipos[i]``, ``inertia[i]``, if they were identified.
        delays: The delays.
        timestep_s: Step of the model's physics [s].
        unexpressed: Parameters that set no field of the model.
    """

    joints: Mapping[str, Mapping[str, Term]]
    bodies: Mapping[str, Mapping[str, Term]]
    delays: Delays
    timestep_s: float
    unexpressed: tuple[str, ...]

    @property
    def all_positions(self) -> bool:
        """Whether the command of every actuator is a position."""
        driven = [t for t in self.joints.values() if "stiffness" in t or "gain" in t]
        return bool(driven) and all("stiffness" in t for t in driven)


def find_terms(
    found: Identification, mjcf: Callable[[Mapping[str, float]], str], sides: Mapping[str, str], draws: int = DRAWS
) -> Terms:
    """Return an identification in MuJoCo's terms.

    Args:
        mjcf: Parameters by name -> the robot's model with them.
        sides: Delay -> ``command`` or ``measurement``.
    """
    best = found.values
    model = _mj.MjModel.from_xml_string(mjcf(best))
    numbers = _numbers(model)
    rows = [_numbers(_mj.MjModel.from_xml_string(mjcf({**best, **own}))) for own in _draws(found, draws)]
    low, high = (
        {k: float(np.quantile([row[k] for row in rows], q)) if rows else v for k, v in numbers.items()}
        for q in (0.025, 0.975)
    )
    terms = {k: Term(v, min(v, low[k]), max(v, high[k])) for k, v in numbers.items()}
    joints: dict[str, dict[str, Term]] = {}
    bodies: dict[str, dict[str, Term]] = {}
    for (kind, element, name), term in terms.items():
        if kind == "joint":
            joints.setdefault(element, {})[name] = term
        elif not term.known:
            bodies.setdefault(element, {})[name] = term
    return Terms(
        joints, bodies, find_delays(found, sides), float(model.opt.timestep), tuple(_unexpressed(found, mjcf, best))
    )


def find_delays(found: Identification, sides: Mapping[str, str]) -> Delays:
    """Return the delays that were identified.

    Args:
        sides: Delay -> ``command`` or ``measurement``.
    """
    delays = [p for p in found.parameters if p.kind == "delay"]

    def total(parts: Sequence[Estimate]) -> Term | None:
        if not parts:
            return None
        ends = [[p.estimate for p in parts]]
        ends += [[p.estimate if end is None else end for p, end in zip(parts, own, strict=True)] for own in (
            [p.low95 for p in parts], [p.high95 for p in parts])]  # fmt: skip
        return Term(*(float(sum(end)) for end in ends))

    whole = [p for p in found.parameters if p.name == ROUND_TRIP] or delays
    return Delays(
        command=total([p for p in delays if sides.get(p.name) == "command"]),
        measurement=total([p for p in delays if sides.get(p.name) == "measurement"]),
        round_trip=total(whole),
        computation={n: t.computation for n, t in found.timing.nodes.items()} if found.timing else None,
    )


def _draws(found: Identification, count: int) -> list[dict[str, float]]:
    if found.posterior is None:
        return []
    drawn = found.posterior.sample(np.random.default_rng(0), count)
    return [{n: float(v[i]) for n, v in drawn.items()} for i in range(count)]


def _numbers(model: Any) -> dict[tuple[str, str, str], float]:
    """Return the model's numbers: (``joint`` or ``body``, its name, the term) -> number."""
    found: dict[tuple[str, str, str], float] = {}
    for j in range(model.njnt):
        if model.jnt_type[j] in _HINGE_OR_SLIDE:
            for name, field in _DOF.items():
                found["joint", model.joint(j).name, name] = float(getattr(model, field)[model.jnt_dofadr[j]])
    for a in range(model.nu):
        if model.actuator_trntype[a] == int(_mj.mjtTrn.mjTRN_JOINT):
            joint = model.joint(int(model.actuator_trnid[a, 0])).name
            bias = model.actuator_biasprm[a]
            if bias[1] != 0.0:
                found["joint", joint, "stiffness"], found["joint", joint, "actuator_damping"] = -bias[1], -bias[2]
            else:
                found["joint", joint, "gain"] = float(model.actuator_gainprm[a, 0])
            if model.actuator_forcelimited[a]:
                found["joint", joint, "effort_limit"] = float(model.actuator_forcerange[a, 1])
            elif model.jnt_actfrclimited[model.actuator_trnid[a, 0]]:
                found["joint", joint, "effort_limit"] = float(model.jnt_actfrcrange[model.actuator_trnid[a, 0], 1])
    for b in range(1, model.nbody):
        for field in _BODY:
            values = np.atleast_1d(getattr(model, f"body_{field}")[b])
            for i, value in enumerate(values):
                name = field if len(values) == 1 else f"{field}[{i}]"
                found["body", model.body(b).name, name] = float(value)
    return {k: float(v) + 0.0 for k, v in found.items()}  # no negative zeros


def _unexpressed(
    found: Identification, mjcf: Callable[[Mapping[str, float]], str], best: Mapping[str, float]
) -> list[str]:
    """Return the parameters, except delays, that do not change the model."""
    names = {p.name: p for p in found.parameters if p.kind not in ("delay", "derived")}
    # An optional term that is not part of the model sets no field.
    names = {name: p for name, p in names.items() if p.state != "fixed" or p.estimate != p.nominal}
    text = mjcf(best)
    return [
        name for name, p in names.items() if mjcf({**best, name: best[name] + 0.1 * (abs(best[name]) or 1.0)}) == text
    ]
