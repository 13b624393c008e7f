"""Flags with which to identify again after an estimate at a bound."""

from sim2real.identify.parameters import Parameter

_WIDER = 4.0
"""Factor between the old and the new bound on a logarithmic scale."""
_LONGEST_S = 1.0
"""Longest delay that the flags allow [s]."""


def is_physical(p: Parameter, upper: bool) -> bool:
    """Return whether no value beyond a bound is possible: delays and frictions are not below 0."""
    return not upper and p.low == 0.0 and not p.narrowed and (p.kind == "delay" or p.transform == "linear")


def way_out(p: Parameter, upper: bool, max_delay_s: float) -> str:
    """Return flags that widen the bound at which a parameter lies.

    Args:
        max_delay_s: Longest delay of the model [s].
    """
    if p.kind == "delay":
        return _longer(p, max_delay_s) if upper else f"--bounds {p.name} 0 {p.high:g}"
    low, high = p.low, p.high
    if p.transform == "log":
        low, high = (low, high * _WIDER) if upper else (low / _WIDER, high)
    elif p.transform == "logit":
        low, high = (low, 1.0 - (1.0 - high) / _WIDER) if upper else (low / _WIDER, high)
    else:
        below = low - (high - low)  # a share or a friction is not negative
        low, high = (low, high + (high - low)) if upper else (max(below, 0.0) if low > 0.0 else below, high)
    return f"--bounds {p.name} {low:.6g} {high:.6g}"


def _longer(p: Parameter, max_delay_s: float) -> str:
    """Return flags that allow a longer delay; "" if the delay is the longest possible."""
    if p.high < 0.999 * max_delay_s:  # it was narrowed
        return f"--bounds {p.name} {p.low:g} {min(2.0 * p.high, max_delay_s):g}"
    return f"--max-delay-s {min(2.0 * max_delay_s, _LONGEST_S):g}" if max_delay_s < _LONGEST_S else ""
