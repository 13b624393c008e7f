"""Global search by evolution strategies of evosax, on the host: ask for candidates, compute their losses, tell them.

A search is over a vector without bounds, in which 1 is about a quarter of the bounds' width: a logistic function keeps
values within their bounds, as evosax does not clip.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification.config import FitConfig
from sim2real.types import Array, PyTree

Losses = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Candidates ``(N, P)`` and the middle of their block of generations ``(P,)`` -> losses ``(N,)``."""
_BLOCK = 10
"""Number of generations in a block: initial states are linearised at its start, and its end decides whether to
continue.
"""
_NARROW = 0.02
"""The search ends if the standard deviation of the candidates is below this; 1 is about a quarter of the bounds' width.
"""
_STANDSTILL = 0.01
"""The search ends if the median loss improves by less than this share between blocks."""
_INFINITE = 1e9
_DECADE = 10.0
"""Positive bounds with at least this ratio are searched on a logarithmic scale."""
_INSIDE = 0.05
"""Smallest distance of the start from a bound, as a share of the bounds' width."""


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Attributes:
        x: Shape ``(P,)``: the best candidate.
        loss: Its loss.
        history: Shape ``(generations,)``: the best loss up to each generation.
        evaluations: Number of simulated candidates.
    """

    x: np.ndarray
    loss: float
    history: np.ndarray
    evaluations: int


def strategies() -> list[str]:
    """Return the names of evosax's algorithms that search from a mean."""
    import evosax.algorithms  # 2 s

    inits = {n: getattr(a, "init", None) for n, a in vars(evosax.algorithms).items() if hasattr(a, "ask")}
    return sorted(n for n, init in inits.items() if init and "mean" in inspect.signature(init).parameters)


def search(
    losses: Losses,
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    config: FitConfig,
    on_generation: Callable[[float, np.ndarray], None] | None = None,
) -> SearchResult:
    """Minimise losses from a start ``(P,)`` within bounds ``(P,)``.

    The search ends early when its candidates are close together, or the median of the last ten generations is not below
    that of the ten before. The best candidate does not count, as one of the first generation may be best by chance.

    Args:
        on_generation: Called with the best loss and the best candidate so far.

    Raises:
        UsageError: The strategy is unknown, or does not work with the population.
        Sim2RealError: When every loss is infinite or no number.
    """
    strategy, params = _strategy(config, len(start))
    ask, tell = jax.jit(strategy.ask), jax.jit(strategy.tell)
    key, first = jax.random.split(jax.random.key(config.seed))

    def inside(z: np.ndarray) -> np.ndarray:
        return low + (high - low) / (1.0 + np.exp(-z))

    # At a bound the logistic function is flat: a search that begins there would stay there.
    share = np.clip((start - low) / (high - low), _INSIDE, 1.0 - _INSIDE)
    state = jax.jit(strategy.init)(first, jnp.asarray(np.log(share / (1.0 - share)), jnp.float32), params)
    history, medians = [], []
    best, loss, middle = np.asarray(start, np.float64), _INFINITE, np.asarray(start, np.float64)
    for generation in range(config.generations):
        key, k_ask, k_tell = jax.random.split(key, 3)
        # Losses of a block are computed with initial states that are linearised at its first middle.
        if generation % _BLOCK == 0:
            middle = inside(np.asarray(strategy.get_mean(state), np.float64))
        candidates, state = ask(k_ask, state, params)
        spread = np.asarray(candidates, np.float64)
        if not np.isfinite(spread).all():
            raise UsageError(
                f"the strategy {config.strategy!r} breaks down: with a population of {config.population} for "
                f"{len(start)} parameters its candidates are no numbers",
                hint="try another population, or CMA_ES",
            )
        points = inside(spread)
        fitness = np.asarray(losses(points, middle), np.float64)
        fitness = np.where(np.isfinite(fitness), fitness, _INFINITE)
        state, _ = tell(k_tell, candidates, jnp.asarray(fitness, jnp.float32), state, params)
        if fitness.min() < loss:
            best, loss = points[fitness.argmin()], float(fitness.min())
        history.append(loss)
        medians.append(float(np.median(fitness)))
        if on_generation:
            on_generation(loss, best)
        if (generation + 1) % _BLOCK == 0:
            now, before = (float(np.median(part or [np.inf])) for part in (medians[-10:], medians[-20:-10]))
            stands_still = now < _INFINITE and now > (1.0 - _STANDSTILL) * before
            if stands_still or float(np.max(np.std(spread, axis=0))) < _NARROW:
                break
    if not loss < _INFINITE:
        raise Sim2RealError(
            "no candidate could be simulated: every loss is infinite or no number",
            hint="check the bounds: they may admit only unstable models",
        )
    return SearchResult(best, loss, np.array(history), config.population * len(history))


def _strategy(config: FitConfig, size: int) -> tuple[PyTree, PyTree]:
    """Return the algorithm of a configuration, and its parameters."""
    import evosax.algorithms
    import optax

    if config.strategy not in strategies():
        raise UsageError(f"unknown strategy {config.strategy!r}. Available: {', '.join(strategies())}")
    algorithm = getattr(evosax.algorithms, config.strategy)
    arguments: dict[str, PyTree] = {"population_size": config.population, "solution": jnp.zeros(size)}
    wanted = inspect.signature(algorithm).parameters
    missing = [n for n, p in wanted.items() if p.default is p.empty and n not in arguments]
    if missing:
        raise UsageError(
            f"the strategy {config.strategy!r} needs {', '.join(missing)}, which this search does not pass on",
            hint="try CMA_ES",
        )
    # Shrink the deviation of strategies that do not adapt it.
    if "std_schedule" in wanted:
        arguments["std_schedule"] = optax.exponential_decay(config.std, config.generations, 0.03)
    try:
        strategy = algorithm(**arguments)
    except (AssertionError, ValueError, TypeError) as error:
        raise UsageError(
            f"the strategy {config.strategy!r} refuses a population of {config.population}: {error}",
            hint="try another population, or CMA_ES",
        ) from error
    params = strategy.default_params
    return strategy, params.replace(std_init=config.std) if hasattr(params, "std_init") else params


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
        """Return the loss, its start and the number of evaluations, for a report."""
        return {"loss": self.loss, "start": self.start, "evaluations": self.evaluations}

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter."""
        return ArtifactTable(
            ("parameter", "value"), [[n, np.array2string(v, precision=5)] for n, v in self.parameters.items()]
        )


class _Scale:
    """Maps parameters by name to a point ``(P,)`` and back; on a logarithmic scale if bounds span a decade."""

    def __init__(self, parameters: Mapping[str, Any], bounds: Mapping[str, Any]) -> None:
        self._like = {n: np.asarray(v, np.float64) for n, v in parameters.items()}
        rows = [_checked(n, v, bounds[n]) for n, v in self._like.items()]
        value, low, high = (np.concatenate([row[i] for row in rows]) for i in range(3))
        self._log = (low > 0) & (high >= _DECADE * low)
        self.begin, self.low, self.high = (np.where(self._log, np.log(np.where(self._log, v, 1.0)), v)
            for v in (value, low, high))  # fmt: skip

    def parameters(self, x: Array, np_: Any = jnp) -> dict[str, PyTree]:
        """Return the parameters at a point ``(P,)``, in numpy or JAX."""
        flat, tree, at = np_.where(self._log, np_.exp(np_.where(self._log, x, 0.0)), x), {}, 0
        for name, like in self._like.items():
            tree[name] = flat[at : at + like.size].reshape(like.shape)
            at += like.size
        return tree


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
        config: Strategy, population, generations, spread and seed of the search; a dict has the settings that differ
            from the default.
        compiled: Whether JAX compiles the loss; otherwise it is plain Python and is called for each candidate in turn.

    Raises:
        UsageError: Parameters and bounds do not fit each other, or the loss is not one number.
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
    begin = scale.begin
    program = jax.jit(jax.vmap(one))
    every = lambda c: np.asarray(program(jnp.asarray(c, jnp.float32)))  # noqa: E731
    losses = every if compiled else lambda c: np.array([number(z) for z in c])
    first = float(losses(np.stack([begin] * config.population))[0] if compiled else number(begin))
    result = search(lambda candidates, middle: losses(candidates), begin, scale.low, scale.high, config)

    # Keep the start if the search finds nothing better.
    better = result.loss < first or not np.isfinite(first)
    values = scale.parameters(np.asarray(result.x if better else begin, np.float64), np)
    return Minimum(
        {n: np.asarray(v) for n, v in values.items()},
        result.loss if better else first,
        first,
        result.history,
        result.evaluations + 1,
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
