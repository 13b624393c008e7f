"""Rewards whose terms have names."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from operator import add
from typing import Any

from sim2real.errors import UsageError


def split_reward(reward: Any) -> tuple[Any, dict[str, Any]]:
    """Return what a task's ``get_reward`` returned as a number, the sum of its terms in their order, and the terms.

    Raises:
        UsageError: There are names, but no terms.
    """
    if not isinstance(reward, Mapping):
        return reward, {}
    if not reward:
        raise UsageError("the task's get_reward returned no terms", hint="return a number, or terms by name")
    return reduce(add, reward.values()), dict(reward)
