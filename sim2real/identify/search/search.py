"""Global search by evolution strategies of evosax: ask for candidates, compute their losses, tell them."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.identification import Search
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identify.config import FitConfig
from sim2real.types import PyTree

Losses = Callable[[np.ndarray, np.ndarray, bool], np.ndarray]
"""Candidates ``(N, P)``, the middle of their generation ``(P,)`` and whether that middle is new -> losses ``(N,)``."""
_BLOCK = 10
"""Generations with one middle, after which the search decides whether to continue."""
_NARROW = 0.02
"""Deviation of a generation's candidates at which the search ends; 1 is about a quarter of the bounds' width."""
_STANDSTILL = 0.01
"""Relative improvement of the generations' median between blocks below which a search stands still."""
_INFINITE = 1e9


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Attributes:
        z: Shape ``(P,)``: the best candidate.
        loss: Its loss.
        record: Strategy, evaluations, and the best loss up to each generation.
    """

    z: np.ndarray
    loss: float
    record: Search


def strategies() -> list[str]:
    """Return the names of evosax's algorithms that search from a mean."""
    import evosax.algorithms  # 2 s

    inits = {n: getattr(a, "init", None) for n, a in vars(evosax.algorithms).items() if hasattr(a, "ask")}
    return sorted(n for n, init in inits.items() if init and "mean" in inspect.signature(init).parameters)


def search(
    losses: Losses,
    start: np.ndarray,
    config: FitConfig,
    on_generation: Callable[[float, np.ndarray], None] | None = None,
) -> SearchResult:
    """Minimise losses from a start ``(P,)``.

    The search ends early when its candidates are close together, or the median of the last ten generations is not below
    that of the ten before. The best candidate does not count, as one of the first generation may be best by chance.

    Args:
        on_generation: Called with the best loss and the best candidate so far.

    Raises:
        UsageError: When the strategy is unknown, or does not work with the population.
        Sim2RealError: When every loss is infinite or no number.
    """
    strategy, params = _strategy(config, len(start))
    ask, tell = jax.jit(strategy.ask), jax.jit(strategy.tell)
    key, first = jax.random.split(jax.random.key(config.seed))
    state = jax.jit(strategy.init)(first, jnp.asarray(start, jnp.float32), params)
    history, medians = [], []
    best, loss, middle = np.asarray(start, np.float64), _INFINITE, np.asarray(start, np.float64)
    for generation in range(config.generations):
        key, k_ask, k_tell = jax.random.split(key, 3)
        # Losses of a block are computed with initial states that are linearised at its first middle.
        if new := generation % _BLOCK == 0:
            middle = np.asarray(strategy.get_mean(state), np.float64)
        candidates, state = ask(k_ask, state, params)
        points = np.asarray(candidates, np.float64)
        if not np.isfinite(points).all():
            raise UsageError(
                f"the strategy {config.strategy!r} breaks down: with a population of {config.population} for "
                f"{len(start)} parameters its candidates are no numbers",
                hint="try another population, or CMA_ES",
            )
        fitness = np.asarray(losses(points, middle, new), np.float64)
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
            if stands_still or float(np.max(np.std(points, axis=0))) < _NARROW:
                break
    if not loss < _INFINITE:
        raise Sim2RealError(
            "no candidate could be simulated: every loss is infinite or no number",
            hint="check the bounds: they may admit only unstable models",
        )
    record = Search(strategy=config.strategy, history=np.array(history), evaluations=config.population * len(history))
    return SearchResult(best, loss, record)


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
            f"the strategy {config.strategy!r} needs {', '.join(missing)}, which no search here has", hint="try CMA_ES"
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
