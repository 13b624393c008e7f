"""Rewards whose terms have names."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import add
from typing import TYPE_CHECKING

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.types import PyTree


def split_reward(reward: PyTree) -> tuple[PyTree, dict[str, PyTree]]:
    """Return what a task's ``get_reward`` returned as a number, the sum of its terms in their order, and the terms.

    Raises:
        UsageError: There are names, but no terms.
    """
    if not isinstance(reward, Mapping):
        return reward, {}
    if not reward:
        raise UsageError("the task's get_reward returned no terms", hint="return a number, or terms by name")
    return reduce(add, reward.values()), dict(reward)
