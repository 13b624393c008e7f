"""Actuators and ranges as Python files, for mjlab (1.6) and for Isaac Lab (2.x, on Isaac Sim 5 and later).

https://mujocolab.github.io/mjlab, https://isaac-sim.github.io/IsaacLab
"""

import math
import re
from collections.abc import Mapping, Sequence

import jinja2

from sim2real.errors import UsageError
from sim2real.identification.export.terms import Term, Terms

_MJLAB_RANGES = {"joint_damping": "damping", "joint_armature": "armature", "joint_friction": "frictionloss"}
"""Function of mjlab -> term."""
_ISAACLAB_FIELDS = {
    "stiffness": "stiffness",
    "damping": "actuator_damping",
    "effort_limit": "effort_limit",
    "armature": "armature",
    "friction": "frictionloss",
    "dynamic_friction": "frictionloss",
    "viscous_friction": "damping",
}
"""Field of an actuator's configuration in Isaac Lab -> term."""
_ISAACLAB_SCALED = {"friction_distribution_params": "frictionloss", "armature_distribution_params": "armature"}


def mjlab_source(terms: Terms, title: str, about: Sequence[tuple[str, str]]) -> str:
    """Return a Python file with a tuple ``ACTUATORS`` and a dict ``EVENTS``.

    Raises:
        UsageError: When an actuator's command is no position.
    """
    _require_positions(terms, "mjlab")
    ranges = {
        function: _listed({j: _span(own[term]) for j, own in terms.joints.items() if not own[term].known})
        for function, term in _MJLAB_RANGES.items()
    }
    return _rendered("mjlab", terms, title, about, joint_ranges=ranges)


def isaaclab_source(terms: Terms, title: str, about: Sequence[tuple[str, str]]) -> str:
    """Return a Python file with a dict ``ACTUATORS`` and a class ``IdentifiedEvents``.

    Raises:
        UsageError: When an actuator's command is no position.
    """
    _require_positions(terms, "Isaac Lab")
    driven = _driven(terms)
    fields = {
        field: _listed({j: _number(own[term].estimate) for j, own in driven.items() if term in own})
        for field, term in _ISAACLAB_FIELDS.items()
    }
    scaled = {
        joint: ", ".join(
            f'"{field}": {_span(own[term], own[term].estimate)}'
            for field, term in _ISAACLAB_SCALED.items()
            if own[term].estimate > 0 and not own[term].known
        )
        for joint, own in driven.items()
    }
    return _rendered("isaaclab", terms, title, about, fields=fields, scaled=scaled)


def _require_positions(terms: Terms, target: str) -> None:
    """Raise an error if an actuator's command is no position."""
    others = [name for name, own in terms.joints.items() if "gain" in own]
    if others or not terms.all_positions:
        raise UsageError(
            f"{target} has position drives with a stiffness and a damping; "
            + (f"the actuators of {', '.join(others)} take other commands" if others else "no actuator has one"),
            hint="export to mjcf or json",
        )


def _driven(terms: Terms) -> Mapping[str, Mapping[str, Term]]:
    """Return the joints that a position drive moves."""
    return {name: own for name, own in terms.joints.items() if "stiffness" in own}


def _rendered(target: str, terms: Terms, title: str, about: Sequence[tuple[str, str]], **values: object) -> str:
    """Return a template's text; its lags are the least and the largest round trip, in steps of the physics."""
    trip, step_s = terms.delays.round_trip, terms.timestep_s
    least, most = (0, 0) if trip is None else (math.floor(trip.low / step_s), math.ceil(trip.high / step_s))
    loader = jinja2.PackageLoader("sim2real.identification.export")
    environment = jinja2.Environment(
        loader=loader,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        "n": _number,
        "span": _span,
        "pattern": _pattern,
        "text": lambda text: text.replace("\\", "/").replace('"', "'"),
        "identifier": lambda name: re.sub(r"\W", "_", name),
    }
    template = environment.get_template(f"{target}.py.jinja")
    return template.render(
        terms=terms, title=title, about=about, driven=_driven(terms), least=least, most=most, **values
    )


def _pattern(name: str) -> str:
    """Return the expression that matches an element's name, as a Python literal."""
    return repr(re.escape(name).replace("\\/", "/"))


def _number(value: float) -> str:
    return f"{value:.6g}"


def _span(term: Term, scale: float = 1.0) -> str:
    """Return an interval as a Python tuple, its ends divided by ``scale``."""
    return f"({_number(term.low / scale)}, {_number(term.high / scale)})"


def _listed(values: Mapping[str, str]) -> str:
    """Return the entries of a Python dict: pattern of a joint's name -> value."""
    return ", ".join(f"{_pattern(joint)}: {value}" for joint, value in values.items())
