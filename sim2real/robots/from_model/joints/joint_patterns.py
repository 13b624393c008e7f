"""Patterns for the names of joints that cannot take longer to match than a moment."""

from __future__ import annotations

import re
from collections.abc import Iterable

from sim2real.errors import UsageError

_MOST_STEPS = 10**8
"""Largest number of steps of a match; Python takes about 1 s for them."""
_GROUP = re.compile(r"\((?:\?[:=!<]*)?([^()]*)\)([*+?]|\{[^}]*\})?")
_ATOM = re.compile(r"\\.|\[\^?\]?[^]]*\]")
_REPEATS = re.compile(r"[*+]|\{\d*,?\d*\}")


def require_quick(pattern: str, names: Iterable[str]) -> None:
    """Raise a UsageError for a pattern whose match with a name can take more steps than the limit.

    A repeated group with a repetition or a choice inside takes exponentially many steps; k repetitions in a row take
    as many as the length of the name to the power of k.
    """
    # Letters and sets take one step each.
    text, nested = _ATOM.sub("x", pattern), False
    while (group := _GROUP.search(text)) is not None:
        inside, again = group[1], group[2] or ""
        nested |= bool(re.match(r"[*+{]", again) and re.search(r"[*+?{|]", inside))
        choice = "?" * bool(re.search(r"[?|]", inside + again))
        text = text[: group.start()] + "x" + choice + "*" * len(_REPEATS.findall(inside + again)) + text[group.end() :]
    longest = max((len(name) for name in names), default=1)
    if nested or longest ** len(_REPEATS.findall(text)) > _MOST_STEPS:
        raise UsageError(
            f"to match {pattern[:80]!r} can take hours: it repeats a repetition or a choice, or has too many "
            "repetitions",
            hint="such as .*_hip_joint, or (left|right)_knee",
        )
