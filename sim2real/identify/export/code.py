"""Parts that the Python files for other simulators share: their head, numbers, ranges, and lags in steps."""

import math
import re
from collections.abc import Sequence

from sim2real.errors import UsageError
from sim2real.identify.export.terms import Term, Terms


def check_drives(terms: Terms, target: str) -> None:
    """Raise an error if an actuator's command is no position.

    Raises:
        UsageError: With the joints.
    """
    others = [name for name, own in terms.joints.items() if "gain" in own]
    if others or not terms.all_positions:
        raise UsageError(
            f"{target} has position drives with a stiffness and a damping; "
            + (f"the actuators of {', '.join(others)} take other commands" if others else "no actuator has one"),
            hint="export to mjcf or json",
        )


def driven(terms: Terms) -> list[str]:
    """Return the joints that an actuator drives."""
    return [name for name, own in terms.joints.items() if "stiffness" in own]


def lags(terms: Terms) -> tuple[int, int]:
    """Return the least and the largest round trip, in steps of the physics."""
    trip = terms.delays.round_trip
    return (
        (0, 0) if trip is None else (math.floor(trip.low / terms.timestep_s), math.ceil(trip.high / terms.timestep_s))
    )


def head(title: str, about: Sequence[tuple[str, str]], says: Sequence[str], imports: Sequence[str]) -> list[str]:
    """Return the first lines of a file.

    Args:
        says: What a user has to know, a line each.
    """
    facts = [f"{name}: {_plain(text)}" for name, text in about]
    return [f'"""{_plain(title)}', "", *facts, "", *says, '"""', "", *imports, ""]


def pattern(name: str) -> str:
    """Return the expression that matches an element's name, as a Python literal."""
    return repr(re.escape(name).replace("\\/", "/"))


def n(value: float) -> str:
    """Return a number with six digits."""
    return f"{value:.6g}"


def span(term: Term, scale: float = 1.0) -> str:
    """Return an interval as a Python tuple, its ends divided by ``scale``."""
    return f"({n(term.low / scale)}, {n(term.high / scale)})"


def _plain(text: str) -> str:
    return text.replace("\\", "/").replace('"', "'")
