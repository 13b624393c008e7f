"""Optional terms that give groups of joints, or each joint, values other than the one that all joints share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import cast

from sim2real.robots.from_model.joints.quantities import FACTORS, ParameterPattern, What

_SIDES = {"l", "r", "left", "right", "fl", "fr", "rl", "rr", "lf", "rf", "lr", "lh", "rh", "hl", "hr", "bl", "br",
          "front", "rear", "hind", "back", "upper", "lower", "joint"}  # fmt: skip
"""Words of a name that distinguish several alike joints."""
_MOST_JOINTS = 8
"""Most joints of a robot that `auto` gives a value each: with 12 joints a term has up to 11 parameters."""


def like_joints(joints: Sequence[str]) -> list[list[str]]:
    """Return groups of joints with like names: names that are equal apart from sides and numbers."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in joints:
        letters = re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
        groups.setdefault(tuple(part for part in letters if part not in _SIDES), []).append(name)
    return list(groups.values())


def sharing(terms: Sequence[ParameterPattern], joints: Sequence[str], wanted: str) -> list[ParameterPattern]:
    """Return the factors by which groups of joints, or single joints, differ from the first of those with one value.

    Args:
        wanted: ``auto``, ``all``, or names of terms with commas between.
    """
    names, patterns = {n.strip() for n in wanted.split(",")}, list[ParameterPattern]()
    for term in terms:
        together = [j for j in joints if re.fullmatch(term.joints, j, re.DOTALL)]
        factor = f"{term.what}_factor"
        if not term.free or term.each or factor not in FACTORS or len(together) < 2:
            continue
        groups = like_joints(together)
        for kind, parts in (("by_group", groups), ("by_joint", [[j] for j in together])):
            name = f"{term.what}_{kind}"
            usual = "all" in names or ("auto" in names and (kind == "by_group" or len(joints) <= _MOST_JOINTS))
            if not 1 < len(parts) < (len(together) if kind == "by_group" else len(together) + 1):
                continue
            if usual or name in names:
                end = "" if kind == "by_group" else "_alone"
                patterns += [_factor(factor, part, f"{term.what}_of_{_label(part)}{end}", name) for part in parts[1:]]
    return patterns


def _factor(what: str, part: Sequence[str], name: str, term: str) -> ParameterPattern:
    pattern = "|".join(map(re.escape, part))
    return ParameterPattern(cast(What, what), pattern, free=False, name=name, term=term)


def _label(part: Sequence[str]) -> str:
    """Return the name of a joint, or the words that the names of a group share."""
    names = [re.split(r"\W+|_", name) for name in part]
    return "_".join(piece for piece in names[0] if all(piece in other for other in names))
