"""The minimum of any loss within bounds, by the search that identification uses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import UsageError
from sim2real.identify.config import FitConfig
from sim2real.identify.search.search import search
from sim2real.types import Array, PyTree

_DECADE = 10.0
"""Positive bounds with at least this ratio are searched on a logarithmic scale."""
_INSIDE = 1e-3
"""The search begins at least so far from a bound, as a share of the bounds' width."""


@dataclass(frozen=True, repr=False)
class Minimum(Shown):
    """Result of a minimisation.

    Attributes:
        parameters: Name -> value, as ``loss`` takes them.
        loss: The loss there.
        start: The loss where the search began.
        history: Shape ``(generations,)``: the best loss up to each generation.
        evaluations: How often the loss was computed.
    """

    parameters: dict[str, np.ndarray]
    loss: float
    start: float
    history: np.ndarray
    evaluations: int

    def about(self) -> dict[str, PyTree]:
        """Return what to say about it: name -> value."""
        return {"loss": self.loss, "start": self.start, "evaluations": self.evaluations}

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter."""
        return ArtifactTable(
            ("parameter", "value"), [[n, np.array2string(v, precision=5)] for n, v in self.parameters.items()]
        )


class _Scale:
    """Between parameters in bounds and a vector without bounds, in which 1 is about a quarter of the bounds' width."""

    def __init__(self, parameters: Mapping[str, Any], bounds: Mapping[str, Any]) -> None:
        self.start = {n: np.asarray(v, np.float64) for n, v in parameters.items()}
        rows = [_checked(n, v, bounds[n]) for n, v in self.start.items()]
        self.value, self.low, self.high = (np.concatenate([row[i] for row in rows]) for i in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            self.log = (self.low > 0) & (self.high >= _DECADE * self.low)

    def first(self) -> np.ndarray:
        """Return where the search begins, ``(P,)``."""
        low, high, value = (np.where(self.log, np.log(np.where(self.log, v, 1.0)), v) for v in self._ends())
        share = np.clip((value - low) / (high - low), _INSIDE, 1.0 - _INSIDE)
        return np.log(share / (1.0 - share))

    def parameters(self, z: Array, np_: Any = jnp) -> dict[str, PyTree]:
        """Return the parameters at ``z (P,)``, in numpy or JAX."""
        share = 1.0 / (1.0 + np_.exp(-z))
        low = np.where(self.log, self.low, 1.0)
        scaled = low * np_.exp(share * np.log(np.where(self.log, self.high / low, 1.0)))
        flat = np_.where(self.log, scaled, self.low + (self.high - self.low) * share)
        tree, at = {}, 0
        for name, like in self.start.items():
            tree[name] = flat[at : at + like.size].reshape(like.shape)
            at += like.size
        return tree

    def _ends(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.low, self.high, self.value


def minimise(
    loss: Callable[[dict[str, PyTree]], Array | float],
    parameters: Mapping[str, Any],
    bounds: Mapping[str, Any],
    config: FitConfig | Mapping[str, Any] | None = None,
    compiled: bool = True,
) -> Minimum:
    """Return the parameters within bounds that minimise a user's loss.

    Args:
        loss: Parameters -> a number, such as a rollout's error. JAX compiles it for a whole generation of candidates.
        parameters: Name -> start, a number or an array.
        bounds: Name -> (lowest, highest), numbers or arrays. Positive bounds of a decade or more are searched on a
            logarithmic scale.
        config: Strategy, population, generations, spread and seed of the search; a dict has the settings that
            differ from the default.
        compiled: False: the loss is plain Python, and is called for each candidate in turn.

    Raises:
        UsageError: When parameters and bounds do not fit each other, or the loss is not one number.
        Sim2RealError: When the loss is nowhere finite.
    """
    if lacking := sorted(set(parameters) ^ set(bounds)):
        raise UsageError(f"{', '.join(lacking)}: parameters and bounds must have the same names")
    if not parameters:
        raise UsageError("there is no parameter to search for")
    config, scale = _configured(config), _Scale(parameters, bounds)

    def one(z: Array) -> PyTree:
        value = jnp.asarray(loss(scale.parameters(z)))
        if value.shape:
            raise UsageError(f"the loss must be one number, got an array of shape {value.shape}", hint="sum it up")
        return value

    def number(z: np.ndarray) -> float:
        return float(np.asarray(loss(scale.parameters(np.asarray(z, np.float64), np))))

    # Search, with a compiled program for a generation, or candidate by candidate.
    begin, size = scale.first(), scale.value.size
    program = jax.jit(jax.vmap(one))
    every = lambda c: np.asarray(program(jnp.asarray(c, jnp.float32)))  # noqa: E731
    losses = every if compiled else lambda c: np.array([number(z) for z in c])
    first = float(losses(np.stack([begin] * config.population))[0] if compiled else number(begin))
    result = search(lambda candidates, middle, new: losses(candidates), begin, config)

    # Keep the start if the search finds nothing better.
    better = result.loss < first or not np.isfinite(first)
    values = scale.parameters(np.asarray(result.z if better else begin, np.float64).reshape(size), np)
    return Minimum(
        {n: np.asarray(v) for n, v in values.items()},
        result.loss if better else first,
        first,
        result.record.history,
        result.record.evaluations + 1,
    )


def _configured(config: FitConfig | Mapping[str, Any] | None) -> FitConfig:
    usual = FitConfig(generations=150)
    if config is None or isinstance(config, FitConfig):
        return config or usual
    if unknown := [name for name in config if name not in {f.name for f in fields(usual)}]:
        raise UsageError(f"config has no {', '.join(unknown)}. Available: {', '.join(f.name for f in fields(usual))}")
    return replace(usual, **config)


def _checked(name: str, value: np.ndarray, bounds: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a parameter's values and bounds, each ``(size,)``."""
    try:
        low, high = (np.broadcast_to(np.asarray(b, np.float64), value.shape).ravel() for b in bounds)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"{name}: bounds must be two numbers, or arrays of shape {value.shape}; got {bounds!r}"
        ) from error
    flat = value.ravel()
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise UsageError(f"{name}: bounds must be finite, the lower below the higher; got {bounds!r}")
    if not ((flat >= low) & (flat <= high)).all():
        raise UsageError(f"{name} begins outside of its bounds: {value} is not in {bounds!r}")
    return flat, low, high
