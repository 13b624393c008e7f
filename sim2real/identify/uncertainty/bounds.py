"""What to do about an estimate that lies at a bound: flags with which to identify again."""

from __future__ import annotations

from sim2real.identify.parameters import Parameter
from sim2real.identify.uncertainty.round_trip import RoundTrip

_WIDER = 4.0
"""Factor by which a bound on a logarithmic scale is moved."""
_LONGEST_S = 1.0
"""The longest delay that can be asked for [s]."""


def is_physical(p: Parameter, upper: bool) -> bool:
    """Return whether nothing lies beyond a bound: there is no delay and no friction below 0.

    Args:
        p: The parameter, with its bounds.
    """
    return not upper and p.low == 0.0 and not p.narrowed and (p.kind == "delay" or p.transform == "linear")


def way_out(p: Parameter, upper: bool, max_delay_s: float) -> str:
    """Return flags that widen the bound at which a parameter lies.

    Args:
        p: The parameter, with its bounds.
        max_delay_s: For which delays the model is made [s].
    """
    if p.kind == "delay":
        return _longer(p, max_delay_s) if upper else f"--bounds {p.name} 0 {p.high:g}"
    low, high = p.low, p.high
    if p.transform == "log":
        low, high = (low, high * _WIDER) if upper else (low / _WIDER, high)
    elif p.transform == "logit":
        low, high = (low, 1.0 - (1.0 - high) / _WIDER) if upper else (low / _WIDER, high)
    else:
        low, high = (low, high + (high - low)) if upper else (low - (high - low), high)
    return f"--bounds {p.name} {low:.6g} {high:.6g}"


def way_out_of(trip: RoundTrip, parameters: dict[str, Parameter], max_delay_s: float) -> str:
    """Return flags for a round-trip delay that lies at a bound.

    Args:
        parameters: Name -> parameter, with its bounds.
        max_delay_s: For which delays the model is made [s].
    """
    flags = [way_out(parameters[n], trip.at_bound == "upper", max_delay_s) for n in trip.parts]
    return " ".join(dict.fromkeys(flag for flag in flags if flag))


def _longer(p: Parameter, max_delay_s: float) -> str:
    """Return flags that allow a longer delay; empty where none can be allowed."""
    if p.high < 0.999 * max_delay_s:  # it was narrowed
        return f"--bounds {p.name} {p.low:g} {min(2.0 * p.high, max_delay_s):g}"
    return f"--max-delay-s {min(2.0 * max_delay_s, _LONGEST_S):g}" if max_delay_s < _LONGEST_S else ""
