"""Parameters of a model: names, units, bounds, priors, and the map from points of a search to values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from sim2real.artifacts.posterior import TRANSFORMS, Posterior, Transform, from_scale
from sim2real.errors import UsageError
from sim2real.identification.parameter_paths import set_leaf
from sim2real.types import PyTree

_BELOW, _BEYOND = 4.0, 50.0
"""Bounds of a limit, relative to the largest value that recordings reach. The true limit may be lower, as unknown
inertia and friction distort this value, or higher than what the joint did.
"""
_ABOVE = 0.1
"""How far above a lower bound of 0 a search starts, as a share of the range between the bounds."""


@dataclass(frozen=True)
class Parameter:
    """One quantity to identify.

    Attributes:
        name: Unique in its table.
        unit: Unit of nominal value and bounds.
        nominal: Value of the data sheet; for a delay, its value in a model without delays.
        transform: Scale of the search: ``linear``, or ``log`` for positive values.
        kind: ``dynamics``, ``delay``, or ``measurement`` (offset of an encoder or a clock).
        about: Description in one line.
        excite: Motion that determines it, as advice to the user; "": no advice.
        leaf: Where the value belongs in the nodes' parameters, ``node.field.field[index]``; None: the model puts it
            there.
        prior: Mean and standard deviation of a normal distribution of the value; None: uniform within the bounds.
        free: Whether it is identified; otherwise it stays at ``nominal``.
        side: For a delay: ``command`` (from the policy to the world) or ``measurement`` (from the world to the policy).
        term: Name of the optional term of the model that it belongs to, such as ``cogging``; "": none.
        off: Its value in a model without that term; default: the nominal value.
        vanishes: Whether 0 is the smallest possible value, as for a friction. On a logarithmic scale an estimate cannot
            reach 0; it counts as negligible if the model without the parameter is as good.
        limits: Whether it limits a quantity, such as a torque. If the recordings do not reach the limit, the estimate
            is only a lower bound.
        begin: Start of a search; None: the nominal value, or for a delay a value within its bounds. The search of a
            limit that no motion reaches begins below it, where the residuals depend on it.
        narrowed: Whether the user raised its lower bound.
        causes: Cause that changes several parameters at once, such as a payload -> change of this one on its scale when
            the cause grows by a factor of e.
    """

    name: str
    unit: str
    nominal: float
    low: float
    high: float
    transform: Transform = "log"
    kind: Literal["dynamics", "delay", "measurement"] = "dynamics"
    about: str = ""
    leaf: str | None = None
    prior: tuple[float, float] | None = None
    free: bool = True
    side: Literal["", "command", "measurement"] = ""
    term: str = ""
    off: float | None = None
    vanishes: bool = False
    limits: bool = False
    begin: float | None = None
    narrowed: bool = False
    excite: str = ""
    causes: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        """Check the bounds."""
        # Bounds that fit the scale.
        if self.transform not in TRANSFORMS:
            raise UsageError(
                f"parameter {self.name!r}: unknown transform {self.transform!r}. Available: {', '.join(TRANSFORMS)}"
            )
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise UsageError(f"parameter {self.name!r}: bounds [{self.low}, {self.high}] {self.unit} are no interval")
        if self.transform == "log" and self.low <= 0:
            raise UsageError(
                f"parameter {self.name!r}: a logarithmic scale needs a positive lower bound, got {self.low}"
            )
        # Value of an absent term, and the prior.
        if self.off is not None and not (self.term and math.isfinite(self.off)):
            raise UsageError(
                f"parameter {self.name!r}: off = {self.off} is its value without a term, and its term is {self.term!r}",
                hint="name the term, and a finite value",
            )
        if self.prior is not None and not (math.isfinite(self.prior[0]) and 0.0 < self.prior[1] < math.inf):
            raise UsageError(
                f"parameter {self.name!r}: the prior {self.prior} is no mean and deviation of a normal distribution",
                hint="remove the prior: without one it is uniform within the bounds",
            )

    @property
    def without(self) -> float:
        """The value in a model without the parameter's term."""
        return self.nominal if self.off is None else self.off

    def to_scale(self, value: float) -> float:
        """Return a value on the parameter's scale."""
        return float(TRANSFORMS[self.transform][0](value))

    def from_scale(self, x: float) -> float:
        """Return the value at a point of the parameter's scale."""
        return float(from_scale(self.transform, x))


class ParameterTable:
    """Parameters in a fixed order; maps points ``(P,)`` of the free ones, each on its scale, to values.

    Attributes:
        columns: The free parameters.
        low: Shape ``(P,)``: lower bounds on the parameters' scales.
        span: Shape ``(P,)``: width of the bounds.
    """

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self.parameters = tuple(parameters)
        names = [p.name for p in self.parameters]
        if len(set(names)) != len(names):
            raise UsageError(f"parameter names must differ: {', '.join(names)}")
        self.columns = tuple(p for p in self.parameters if p.free)
        self.names = tuple(p.name for p in self.columns)
        self.low = np.array([c.to_scale(c.low) for c in self.columns])
        self.high = np.array([c.to_scale(c.high) for c in self.columns])
        self.span = self.high - self.low

    def __len__(self) -> int:
        return len(self.columns)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    def __getitem__(self, name: str) -> Parameter:
        for p in self.parameters:
            if p.name == name:
                return p
        raise UsageError(f"unknown parameter {name!r}. Available: {', '.join(p.name for p in self.parameters)}")

    def with_fixed(self, values: Mapping[str, float]) -> ParameterTable:
        """Return the table with some parameters fixed at values."""
        changed = {p.name: p for p in self.parameters}
        for name, value in values.items():
            changed[name] = replace(self[name], nominal=float(value), free=False)
        return ParameterTable(changed.values())

    def with_free(self, name: str) -> ParameterTable:
        """Return the table with one more parameter to identify."""
        return ParameterTable(replace(p, free=p.free or p.name == name) for p in self.parameters)

    def with_nominal(self, values: Mapping[str, float]) -> ParameterTable:
        """Return the table with other nominal values, which are starts of a search; unknown names are ignored."""
        return ParameterTable(
            (replace(p, nominal=float(values[p.name]), begin=None) if p.name in values else p for p in self.parameters),
        )

    def with_begin(self, values: Mapping[str, float]) -> ParameterTable:
        """Return the table with other starts of a search; unknown names are ignored."""
        return ParameterTable(
            (replace(p, begin=float(values[p.name])) if p.name in values else p for p in self.parameters),
        )

    def with_bounds(self, bounds: Mapping[str, tuple[float, float]]) -> ParameterTable:
        """Return the table with other bounds for some parameters.

        Raises:
            UsageError: A name is unknown, bounds exclude the nominal value, or bounds of a delay exceed the old, for
                which the model's windows are made.
        """
        changed = {p.name: p for p in self.parameters}
        for name, (low, high) in bounds.items():
            before = self[name]
            p = replace(before, low=float(low), high=float(high), narrowed=float(low) > before.low)
            absent_limit = p.limits and p.off is not None
            if p.kind != "delay" and not absent_limit and not p.low <= p.nominal <= p.high:
                raise UsageError(
                    f"the bounds [{low:g}, {high:g}] {p.unit} of {name!r} exclude its nominal value {p.nominal:.4g}",
                    hint="widen the bounds, or correct the nominal value in the pipeline",
                )
            if p.kind == "delay" and not before.low <= p.low < p.high <= before.high:
                raise UsageError(
                    f"the bounds [{low:g}, {high:g}] s of {name!r} go beyond [{before.low:g}, {before.high:g}] s",
                    hint="narrow them, or allow longer delays with --max-delay-s",
                )
            changed[name] = p
        return ParameterTable(changed.values())

    def with_reached(self, reached: Mapping[str, float]) -> ParameterTable:
        """Return the table with bounds and starts of absent limits, from what recordings reach.

        Args:
            reached: Limit -> the largest value that recordings reach; bounds that a user gave stay.
        """
        rows = (
            replace(p, low=most / _BELOW, high=most * _BEYOND, begin=most) if most > 0.0 and p.high >= p.without else p
            for p, most in ((p, reached.get(p.name, 0.0)) for p in self.parameters)
        )
        return ParameterTable(rows)

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the optional terms that have free parameters, in the order of the table."""
        return tuple(dict.fromkeys(c.term for c in self.columns if c.term))

    def with_terms(self, names: Iterable[str]) -> ParameterTable:
        """Return the table with some optional terms; parameters of absent terms are fixed at ``without``.

        Raises:
            UsageError: A term is unknown.
        """
        names = set(names)
        terms = dict.fromkeys(p.term for p in self.parameters if p.term)
        if unknown := sorted(names - set(terms)):
            raise UsageError(f"unknown term {unknown[0]!r}. Available: {', '.join(terms) or 'none'}")
        rows = (
            p if not p.term else replace(p, free=True) if p.term in names else replace(p, nominal=p.without, free=False)
            for p in self.parameters
        )
        return ParameterTable(rows)

    def of_terms(self, present: np.ndarray) -> np.ndarray:
        """Return which free parameters a model with some of ``terms`` has, ``(P,)``, bool.

        Args:
            present: Shape ``(T,)``, bool: which terms.
        """
        chosen = dict(zip(self.terms, present, strict=True)) | {"": True}
        return np.array([chosen[c.term] for c in self.columns], bool)

    def without_terms(self, x: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Return a point with the parameters of absent terms at their values without effect, ``(P,)``.

        Args:
            present: Shape ``(T,)``, bool: which of ``terms``.
        """
        off = [c.to_scale(min(max(c.without, c.low), c.high)) for c in self.columns]
        return np.where(self.of_terms(present), x, off)

    def of_limits(self) -> np.ndarray:
        """Return which of ``terms`` are limits, ``(T,)``, bool."""
        return np.array([any(p.limits for p in self if p.term == name) for name in self.terms], bool)

    def decode(self, x: np.ndarray, present: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Return values by name at points on the parameters' scales ``(..., P)``, leaves ``(...)``.

        Args:
            present: Shape ``(P,)``, bool: which parameters are kept; others get their values without effect; default:
                all are kept.
        """
        x = np.asarray(x, np.float64)
        values = {p.name: np.full(x.shape[:-1], p.nominal) for p in self.parameters}
        for i, p in enumerate(self.columns):
            there = present is None or present[i]
            values[p.name] = from_scale(p.transform, x[..., i]) if there else np.full(x.shape[:-1], p.without)
        return values

    def placed(self, params: Mapping[str, PyTree], values: Mapping[str, ArrayLike]) -> dict[str, PyTree]:
        """Return the nodes' parameters with each value at its ``leaf``."""
        tree: dict[str, PyTree] = dict(params)
        for p in self.parameters:
            if p.leaf is not None:
                tree = set_leaf(tree, p.leaf, values[p.name])
        return tree

    def encode(self, values: Mapping[str, ArrayLike]) -> np.ndarray:
        """Return values by name as a point ``(P,)`` on the parameters' scales, within the bounds."""
        at = [float(np.squeeze(values[p.name])) for p in self.columns]
        inside = [p.to_scale(min(max(v, p.low), p.high)) for v, p in zip(at, self.columns, strict=True)]
        return self.within(np.array(inside))

    def within(self, x: np.ndarray) -> np.ndarray:
        """Return points on the parameters' scales ``(..., P)``, clipped to the bounds."""
        return np.clip(x, self.low, self.high)

    def posterior(self, x: np.ndarray, covariance: np.ndarray, widening: float = 1.0) -> Posterior:
        """Return the distribution from which training draws.

        Args:
            x: Shape ``(P,)``: the estimate, on the parameters' scales.
            covariance: Shape ``(P, P)``, on the parameters' scales.
            widening: Factor on the standard deviations, so that draws cover the errors of the model.
        """
        transform: tuple[Transform, ...] = tuple(c.transform for c in self.columns)
        return Posterior(self.names, transform, np.asarray(x), covariance, self.low, self.high, widening)

    def start(self, share: float = 0.25) -> np.ndarray:
        """Return the start of a fit, ``(P,)``: each parameter at its ``begin``, delays at a share of their interval.

        A friction begins above 0: at 0 a joint never sticks, and the derivative by friction is wrong.
        """
        at = lambda p, share: p.low + share * (p.high - p.low)  # noqa: E731
        begins = {p.name: p.nominal if p.begin is None else p.begin for p in self.parameters}
        open_delay = lambda p: p.kind == "delay" and p.begin is None  # noqa: E731
        first = {p.name: at(p, share) if open_delay(p) else begins[p.name] for p in self.parameters}
        for p in self.parameters:
            if p.kind != "delay" and p.begin is None and p.transform == "linear" and p.nominal == p.low:
                first[p.name] = at(p, _ABOVE)
        return self.encode(first)

    def starts(self) -> np.ndarray:
        """Return starts of a descent, ``(K, P)``: with short delays, and with long ones."""
        delayed = any(c.kind == "delay" and c.begin is None for c in self.columns)
        return np.stack([self.start(share) for share in ((0.25, 0.75) if delayed else (0.25,))])

    def nominal(self) -> np.ndarray:
        """Return the nominal values, ``(P,)``, on the parameters' scales."""
        return self.encode({p.name: p.nominal for p in self.parameters})

    def prior_residuals(self, x: np.ndarray) -> np.ndarray:
        """Return the priors' residuals ``(Q,)`` at ``x (P,)``: distances from the mean, in standard deviations."""
        pulls = [(i, c, *c.prior) for i, c in enumerate(self.columns) if c.prior is not None]
        return np.array([(c.from_scale(x[i]) - mean) / deviation for i, c, mean, deviation in pulls])

    def unscale(self, x: np.ndarray) -> np.ndarray:
        """Return values for points on the parameters' scales ``(..., P)``, clipped to the bounds."""
        inside = self.within(x)
        values = [from_scale(c.transform, inside[..., i]) for i, c in enumerate(self.columns)]
        return np.stack(values, axis=-1)

    def slope(self, x: np.ndarray) -> np.ndarray:
        """Return d value / d scale at points on the parameters' scales, ``(P,)``."""
        values = self.unscale(x)
        return np.array([TRANSFORMS[c.transform][2](v) for c, v in zip(self.columns, values, strict=True)])
