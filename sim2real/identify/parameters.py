"""Parameters as data: names, units, bounds, and the map from an unbounded vector to values inside the bounds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError


@dataclass(frozen=True)
class Parameter:
    """One quantity to identify.

    Attributes:
        name: Unique in its table.
        unit: Unit of nominal value and bounds.
        nominal: The data sheet's value; for a delay, what a model without delays has.
        low: Lower bound.
        high: Upper bound.
        log: Whether the search moves on a logarithmic scale.
        kind: ``dynamics`` or ``delay``.
        about: One line for tables and pages.
    """

    name: str
    unit: str
    nominal: float
    low: float
    high: float
    log: bool = True
    kind: str = "dynamics"
    about: str = ""

    def __post_init__(self) -> None:
        """Check the bounds."""
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise UsageError(f"parameter {self.name!r}: bounds [{self.low}, {self.high}] {self.unit} are no interval")
        if self.log and self.low <= 0:
            raise UsageError(
                f"parameter {self.name!r}: a logarithmic scale needs a positive lower bound, got {self.low}"
            )


class ParameterTable:
    """Parameters in a fixed order, and the bijection between values and an unbounded vector ``z``.

    The bounds live in the bijection (a logistic function on a linear or logarithmic scale): evosax does not clip.

    Args:
        parameters: The parameters; names must differ.
    """

    def __init__(self, parameters: Iterator[Parameter] | list[Parameter] | tuple[Parameter, ...]) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(p.name for p in self.parameters)
        if len(set(self.names)) != len(self.names):
            raise UsageError(f"parameter names must differ: {', '.join(self.names)}")
        scale = [math.log if p.log else float for p in self.parameters]
        self._low = np.array([s(p.low) for s, p in zip(scale, self.parameters, strict=True)])
        self._high = np.array([s(p.high) for s, p in zip(scale, self.parameters, strict=True)])
        self._log = np.array([p.log for p in self.parameters])

    def __len__(self) -> int:
        return len(self.parameters)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    def __getitem__(self, name: str) -> Parameter:
        if name not in self.names:
            raise UsageError(f"unknown parameter {name!r}. Available: {', '.join(self.names)}")
        return self.parameters[self.names.index(name)]

    def with_bounds(self, bounds: Mapping[str, tuple[float, float]]) -> ParameterTable:
        """Return the table with other bounds for some parameters.

        Raises:
            UsageError: When a name is unknown, bounds of a dynamics parameter exclude its nominal value, or those of a
                delay go beyond the table's, for which the model's windows are made.
        """
        changed = {p.name: p for p in self.parameters}
        for name, (low, high) in bounds.items():
            own = self[name]
            p = replace(own, low=float(low), high=float(high))
            if p.kind == "dynamics" and not p.low <= p.nominal <= p.high:
                raise UsageError(
                    f"the bounds [{low:g}, {high:g}] {p.unit} of {name!r} exclude its nominal value {p.nominal:.4g}",
                    hint="widen the bounds, or correct the nominal value in the pipeline",
                )
            if p.kind == "delay" and not own.low <= p.low < p.high <= own.high:
                raise UsageError(
                    f"the bounds [{low:g}, {high:g}] s of {name!r} go beyond [{own.low:g}, {own.high:g}] s",
                    hint="narrow them, or allow longer delays with --max-delay-s",
                )
            changed[name] = p
        return ParameterTable(tuple(changed.values()))

    def decode(self, z: Any) -> dict[str, Any]:
        """Map an unbounded vector ``(P,)`` to values by name; differentiable."""
        x = self._low + (self._high - self._low) * jax.nn.sigmoid(z)
        return {p.name: jnp.exp(x[i]) if p.log else x[i] for i, p in enumerate(self.parameters)}

    def encode(self, values: Mapping[str, float]) -> np.ndarray:
        """Map values to the unbounded vector ``(P,)``; values at or outside a bound end just inside it."""
        x = np.array([math.log(values[p.name]) if p.log else values[p.name] for p in self.parameters])
        share = np.clip((x - self._low) / (self._high - self._low), 1e-3, 1 - 1e-3)
        return np.log(share / (1 - share))

    def start(self) -> np.ndarray:
        """Return where a search begins, ``(P,)``: the nominal value, for delays a quarter of the interval."""
        first = {
            p.name: p.nominal if p.kind == "dynamics" else p.low + 0.25 * (p.high - p.low) for p in self.parameters
        }
        return self.encode(first)

    def scale(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return each parameter on its own scale, linear or logarithmic, and d scale / d z; both ``(P,)``."""
        share = 1.0 / (1.0 + np.exp(-np.asarray(z, np.float64)))
        span = self._high - self._low
        return self._low + span * share, span * share * (1 - share)

    def unscale(self, x: np.ndarray) -> np.ndarray:
        """Return values for points on the parameters' scales, kept within the bounds, ``(P,)``."""
        inside = np.clip(x, self._low, self._high)
        return np.where(self._log, np.exp(np.where(self._log, inside, 0.0)), inside)

    @property
    def span(self) -> np.ndarray:
        """Width of the bounds on the parameters' scales, ``(P,)``."""
        return self._high - self._low

    @property
    def logarithmic(self) -> np.ndarray:
        """Which parameters have a logarithmic scale, ``(P,)``, bool."""
        return self._log
