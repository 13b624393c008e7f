"""Global search by evolution strategies: without gradients, with restarts and common random numbers."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.tree import strong
from sim2real.identify.config import FitConfig
from sim2real.identify.programs import program

Losses = Callable[[Any, Any, Any], Any]
"""``candidates (N, P), around (P,), pick (B,) or None -> losses (N,)``, traceable."""
_STUCK = 1e-4
_INFINITE = 1e9


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Attributes:
        z: Shape ``(P,)``: the best candidate.
        loss: Its loss, on all segments.
        history: Shape ``(generations,)``: the best loss up to each generation, on the segments of that generation.
        evaluations: Candidates that were simulated.
        finalists: Shape ``(K, P)``: the best of each run, best first.
    """

    z: np.ndarray
    loss: float
    history: np.ndarray
    evaluations: int
    finalists: np.ndarray


def strategies() -> list[str]:
    """Return the names of the algorithms there are."""
    import evosax.algorithms  # 2 s

    return sorted(n for n, a in vars(evosax.algorithms).items() if inspect.isclass(a) and hasattr(a, "ask"))


def search(
    losses: Losses,
    start: np.ndarray,
    config: FitConfig,
    segments: np.ndarray | None = None,
    on_generations: Callable[[int, float, np.ndarray], None] | None = None,
    programs: dict[Any, Any] | None = None,
    on_compile: Callable[[bool], None] | None = None,
    alone: Callable[[np.ndarray], float] | None = None,
) -> SearchResult:
    """Minimise; every candidate of a generation sees the same data (common random numbers).

    A run ends early once ten generations have improved the loss by less than 0.01 %. Restarts follow BIPOP: in turn
    with twice the largest population so far, and with the first population from a random place, with smaller steps.

    Args:
        losses: See ``Losses``.
        start: Shape ``(P,)``: middle of the first generation.
        config: How to search.
        segments: Shape ``(S,)``: what batches are drawn from; None without batches.
        on_generations: Called with the number of generations done since the last call, and the best loss and candidate
            of this run so far.
        programs: Compiled programs of earlier calls with the same losses; those of this one are added.
        on_compile: Called with True before a program is compiled, and with False afterwards.
        alone: Loss of one candidate on all segments, where there is a program for it; default: that of ``losses``.

    Raises:
        UsageError: When there is no such strategy, or it cannot work with this population.
        Sim2RealError: When no candidate has a finite loss.
    """
    key = jax.random.key(config.seed)
    batch = min(10, config.generations)
    programs = {} if programs is None else programs
    runs, histories, evaluations, large = [], [], 0, config.population
    for index in range(config.restarts + 1):
        k_run, k_step, k_middle = jax.random.split(jax.random.fold_in(key, index), 3)
        middle, std, population = start, config.std, config.population
        if index % 2:
            large = population = 2 * large
        elif index:
            # Hansen draws the population of small runs as well; each size takes 5 s to compile, so ours keep the first.
            u = float(jax.random.uniform(k_step))
            middle = np.asarray(jax.random.normal(k_middle, start.shape)) * 1.5
            std = config.std * 10.0 ** (-2.0 * u)
        kind = (config.strategy, population, config.batch, config.generations, config.std)
        if kind not in programs:
            programs[kind] = _Run(losses, config, population, len(start), batch, segments)
        z, history, count = programs[kind](k_run, middle, std, config.generations, on_generations, on_compile)
        runs.append(z)
        histories.append(history)
        evaluations += count
    # Each is linearised at itself: finalists of several runs may lie far apart.
    loss = alone or programs.setdefault("alone", program(lambda z: losses(z[None], z, None)[0]))
    finalists, best = _ranked(np.stack(runs), loss)
    history = np.minimum.accumulate(np.concatenate(histories))
    return SearchResult(finalists[0], best, history, evaluations, finalists)


def _ranked(finalists: np.ndarray, alone: Callable[[Any], Any]) -> tuple[np.ndarray, float]:
    """Return the finalists ``(K, P)``, best first, and the loss of the best."""
    losses = np.array([float(alone(z)) for z in finalists])
    order = np.argsort(np.where(np.isfinite(losses), losses, _INFINITE))
    best = float(losses[order[0]])
    if not best < _INFINITE:
        raise Sim2RealError(
            "no candidate could be simulated: every loss is infinite or no number",
            hint="check the bounds: they may admit only unstable models",
        )
    return finalists[order], best


class _Run:
    """The program of one population size, and a run of it."""

    def __init__(
        self, losses: Losses, config: FitConfig, population: int, size: int, count: int, segments: Any
    ) -> None:
        self.name, self.population, self.count, self.losses = config.strategy, population, count, losses
        self.strategy = _strategy(config, population, size)
        self.by_population = "mean" not in inspect.signature(type(self.strategy).init).parameters
        batched = 0 < config.batch < (0 if segments is None else len(segments))
        self.pick = (
            (lambda key: jax.random.choice(key, jnp.asarray(segments), (config.batch,), replace=False))
            if batched
            else (lambda key: None)
        )
        self.batched = batched
        self.devices = jax.local_devices()[: config.devices]
        self.advance: Any = None

    def __call__(
        self,
        key: Any,
        middle: np.ndarray,
        std: float,
        generations: int,
        told: Callable[[int, float, np.ndarray], None] | None,
        on_compile: Callable[[bool], None] | None,
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Run; return the best candidate ``(P,)``, the best loss up to each generation, and how many were simulated."""
        params = self.strategy.default_params
        if hasattr(params, "std_init"):
            params = params.replace(std_init=std)
        params = strong(params)
        k_first, *keys = jax.random.split(key, 1 + -(-generations // self.count))
        state = strong(self._first(k_first, jnp.asarray(middle, jnp.float32), std, params))  # else it compiles twice
        if self.advance is None:
            with telling(on_compile):
                self.advance = program(self._advance).lower(state, params, k_first).compile()
        history: list[np.ndarray] = []
        for k_generations in keys:
            state, best = self.advance(state, params, k_generations)
            history.append(np.asarray(best))
            if not self.by_population and not np.isfinite(np.asarray(self._middle(state))).all():
                raise UsageError(
                    f"the strategy {self.name!r} breaks down: with a population of {self.population} for "
                    f"{middle.size} parameters its candidates are no numbers",
                    hint="try another population, or CMA_ES",
                )
            reached = float(np.min(history[-1]))
            if told:
                told(self.count, reached, np.asarray(self._best(state)))
            before = float(np.min(np.concatenate(history[:-1]))) if len(history) > 1 else np.inf
            # With batches the losses of two generations are on different segments: they cannot show a standstill.
            if not self.batched and np.isfinite(before) and before - reached < _STUCK * abs(reached):
                break
        losses = np.minimum.accumulate(np.concatenate(history))
        return np.asarray(self._best(state)), losses, self.population * losses.size

    def _first(self, key: Any, middle: Any, std: float, params: Any) -> Any:
        if not self.by_population:
            return self.strategy.init(key, middle, params)
        k_spread, k_pick, k_init = jax.random.split(key, 3)
        spread = std * jax.random.normal(k_spread, (self.population, middle.size))
        candidates = middle + spread.at[0].set(0.0)
        return self.strategy.init(k_init, candidates, self._fitness(candidates, middle, k_pick), params)

    def _best(self, state: Any) -> Any:
        return self._middle(state) if self.batched else state.best_solution

    def _middle(self, state: Any) -> Any:
        return state.best_solution if self.by_population else self.strategy.get_mean(state)

    def _fitness(self, candidates: Any, around: Any, key: Any) -> Any:
        fitness = self.losses(candidates, around, self.pick(key))
        return jnp.where(jnp.isfinite(fitness), fitness, _INFINITE)

    def _divided(self, candidates: Any) -> Any:
        """Return candidates of which each device simulates a part."""
        return self._spread(candidates, PartitionSpec("candidates"))

    def _on_all(self, values: Any) -> Any:
        """Return values that all devices have: each makes the same next generation."""
        return self._spread(values, PartitionSpec())

    def _spread(self, values: Any, how: PartitionSpec) -> Any:
        if len(self.devices) == 1:
            return values
        where = NamedSharding(Mesh(np.array(self.devices), ("candidates",), (AxisType.Auto,)), how)
        return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, where), values)

    def _advance(self, state: Any, params: Any, key: Any) -> tuple[Any, Any]:
        def generation(state: Any, key: Any) -> tuple[Any, Any]:
            ask, tell, pick = jax.random.split(key, 3)
            candidates, state = self.strategy.ask(ask, state, params)
            fitness = self._on_all(self._fitness(self._divided(candidates), self._middle(state), pick))
            state, _ = self.strategy.tell(tell, candidates, fitness, state, params)
            return state, jnp.min(fitness)

        return self._on_all(jax.lax.scan(generation, state, jax.random.split(key, self.count)))


@contextmanager
def telling(on_compile: Callable[[bool], None] | None) -> Iterator[None]:
    """Tell that a program is compiled inside a ``with`` block: True before, False afterwards."""
    tell = on_compile or (lambda on: None)
    tell(True)
    yield
    tell(False)


def _strategy(config: FitConfig, population: int, size: int) -> Any:
    import evosax.algorithms
    import optax

    if config.strategy not in strategies():
        raise UsageError(f"unknown strategy {config.strategy!r}. Available: {', '.join(strategies())}")
    algorithm = getattr(evosax.algorithms, config.strategy)
    arguments: dict[str, Any] = {"population_size": population, "solution": jnp.zeros(size)}
    wanted = inspect.signature(algorithm).parameters
    missing = [n for n, p in wanted.items() if p.default is p.empty and n not in arguments]
    if missing:
        raise UsageError(
            f"the strategy {config.strategy!r} needs {', '.join(missing)}, which no search here has", hint="try CMA_ES"
        )
    if "std_schedule" in wanted:
        arguments["std_schedule"] = optax.exponential_decay(config.std, config.generations, 0.03)
    try:
        return algorithm(**arguments)
    except (AssertionError, ValueError, TypeError) as error:
        raise UsageError(
            f"the strategy {config.strategy!r} refuses a population of {population}: {error}",
            hint="try another population, or CMA_ES",
        ) from error
