"""Actuators and ranges as Python files, for mjlab (1.6) and for Isaac Lab (2.x, on Isaac Sim 5 and later).

https://mujocolab.github.io/mjlab, https://isaac-sim.github.io/IsaacLab
"""

import math
import re
from collections.abc import Sequence

import jinja2

from sim2real.errors import UsageError
from sim2real.identification.export.terms import Term, Terms

TARGETS = {"mjlab": "mjlab", "isaaclab": "Isaac Lab"}
"""Target, which is the name of its template -> its name in texts."""


def source_of(target: str, terms: Terms, title: str, about: Sequence[tuple[str, str]]) -> str:
    """Return the Python file for a target, with the actuators and the events that randomise them.

    Raises:
        UsageError: When an actuator's command is no position.
    """
    others = [name for name, own in terms.joints.items() if "gain" in own]
    if others or not terms.all_positions:
        raise UsageError(
            f"{TARGETS[target]} has position drives with a stiffness and a damping; "
            + (f"the actuators of {', '.join(others)} take other commands" if others else "no actuator has one"),
            hint="export to mjcf or json",
        )
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sim2real.identification.export"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {
        "n": _number,
        "span": _span,
        "pattern": lambda name: repr(re.escape(name).replace("\\/", "/")),
        "text": lambda text: text.replace("\\", "/").replace('"', "'"),
        "identifier": lambda name: re.sub(r"\W", "_", name),
    }
    # Lags are the least and the largest round trip, in steps of the physics.
    trip, step_s = terms.delays.round_trip, terms.timestep_s
    least, most = (0, 0) if trip is None else (math.floor(trip.low / step_s), math.ceil(trip.high / step_s))
    driven = {name: own for name, own in terms.joints.items() if "stiffness" in own}
    template = environment.get_template(f"{target}.py.jinja")
    return template.render(terms=terms, title=title, about=about, driven=driven, least=least, most=most)


def _number(value: float) -> str:
    return f"{value:.6g}"


def _span(term: Term, scale: float = 1.0) -> str:
    """Return an interval as a Python tuple, its ends divided by ``scale``."""
    return f"({_number(term.low / scale)}, {_number(term.high / scale)})"
