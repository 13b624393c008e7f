"""A grid of settings that are trained in parallel in one program, each with every seed. Imports no JAX."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig

if TYPE_CHECKING:
    from sim2real.types import Array

SWEPT = tuple(f.name for f in fields(PPOConfig) if type(f.default) is float)
"""Settings that are numbers in the program. Other settings determine its shapes or its structure."""


@dataclass(frozen=True)
class Sweep:
    """A grid of settings.

    Attributes:
        values: Setting -> the values to try.
    """

    values: Mapping[str, tuple[float, ...]]

    @staticmethod
    def parse(texts: Sequence[str]) -> Sweep:
        """Parse texts such as ``learning_rate=1e-3,3e-3``, one for each setting.

        Raises:
            UsageError: A setting cannot be swept, or a value is no number.
        """
        values: dict[str, tuple[float, ...]] = {}
        for text in texts:
            # Split NAME=VALUE,VALUE...
            name, sign, listed = text.partition("=")
            name = name.strip().replace("-", "_").removeprefix("ppo.")
            try:
                numbers = tuple(float(word) for word in listed.split(","))
            except ValueError:
                sign, numbers = "", ()
            if not sign or len(set(numbers)) < len(numbers) or name in values:
                raise UsageError(
                    f"sweep {text!r} is no list of different numbers for one setting",
                    hint="write NAME=VALUE,VALUE..., one --sweep for each, such as --sweep learning_rate=1e-3,3e-3",
                )
            if name not in SWEPT:
                exists = any(f.name == name for f in fields(PPOConfig))
                reason = "sets the shape or the parts of the program" if exists else "is no setting of PPO"
                raise UsageError(
                    f"{name} cannot be swept: it {reason}", hint=f"settings that can be swept: {', '.join(SWEPT)}"
                )
            values[name] = numbers
        return Sweep(values)

    @property
    def grid(self) -> list[dict[str, float]]:
        """All combinations of the values, in order; one empty combination without a sweep."""
        names = list(self.values)
        return [dict(zip(names, numbers, strict=True)) for numbers in itertools.product(*self.values.values())]

    def names(self, num_seeds: int) -> list[str]:
        """Return the name of each place on the seed axis, such as ``learning_rate=0.001, seed 0``."""
        points = [f"{format_point(point)}, " if point else "" for point in self.grid]
        return [f"{point}seed {seed}" for point in points for seed in range(num_seeds)]

    def configs(self, config: PPOConfig) -> list[PPOConfig]:
        """Return the settings of each point of the grid.

        Raises:
            UsageError: A value is out of its range, or has no effect.
        """
        if "target_kl" in self.values and config.schedule != "adaptive":
            raise UsageError("target_kl has no effect with a linear step size", hint="add --ppo.schedule adaptive")
        return [replace(config, **point) for point in self.grid]


def format_point(point: Mapping[str, float]) -> str:
    """Return a point of the grid as text, such as ``learning_rate=0.001``."""
    return ", ".join(f"{name}={value:g}" for name, value in point.items())


def with_numbers(config: PPOConfig, numbers: Mapping[str, Array | int]) -> PPOConfig:
    """Return settings in which some numbers are traced arguments of the program.

    ``dataclasses.replace`` would compare the traced numbers with their bounds; they were checked before.
    """
    changed = copy.copy(config)
    for name, value in numbers.items():
        object.__setattr__(changed, name, value)
    return changed
