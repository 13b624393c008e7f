"""Search by evolution strategy: global, no gradient, bounds in the bijection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.graph.tree import strong


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Attributes:
        z: Shape ``(P,)``: the best candidate.
        loss: Its loss.
        history: Shape ``(generations,)``: the best loss up to each generation.
        evaluations: Candidates that were simulated.
    """

    z: np.ndarray
    loss: float
    history: np.ndarray
    evaluations: int


def cma_es(
    losses: Callable[[Any, Any], Any],
    start: np.ndarray,
    population: int,
    generations: int,
    seed: int,
    std: float = 0.7,
    on_generations: Callable[[int, float], None] | None = None,
) -> SearchResult:
    """Minimise with CMA-ES; every candidate of a generation sees the same data (common random numbers).

    Args:
        losses: ``candidates (N, P), mean of their distribution (P,) -> (N,)``, traceable.
        start: Shape ``(P,)``: mean of the first generation.
        population: Candidates a generation.
        generations: At most, above ten rounded up to tens; the search ends early once ten of them have improved the
            loss by less than 0.01 %.
        seed: Seed of the candidates.
        std: Standard deviation of the first generation, in ``z``.
        on_generations: Called with the number of generations done since the last call and the best loss.

    Raises:
        Sim2RealError: When no candidate has a finite loss.
    """
    from evosax.algorithms import CMA_ES  # evosax takes 2 s to import

    strategy = CMA_ES(population_size=population, solution=jnp.zeros(len(start)))
    params = strategy.default_params.replace(std_init=std)
    key = jax.random.key(seed)
    state = strong(strategy.init(key, jnp.asarray(start, jnp.float32), params))  # else the second call compiles again
    batch = min(10, generations)

    run = _generations(strategy, params, losses, batch)
    history: list[np.ndarray] = []
    for index in range(-(-generations // batch)):
        state, best = run(state, jax.random.fold_in(key, index + 1))
        history.append(np.asarray(best))
        if on_generations:
            on_generations(batch, float(best[-1]))
        if len(history) > 1 and history[-2][-1] - best[-1] < 1e-4 * abs(best[-1]):
            break
    best_so_far = np.concatenate(history)
    if best_so_far[-1] >= 1e9:
        raise Sim2RealError(
            "no candidate could be simulated: every loss is infinite or no number",
            hint="check the bounds: they may admit only unstable models",
        )
    return SearchResult(
        np.asarray(state.best_solution), float(best_so_far[-1]), best_so_far, population * best_so_far.size
    )


def _generations(strategy: Any, params: Any, losses: Callable[[Any, Any], Any], count: int) -> Any:
    """Return the program of some generations: ``(state, key) -> (state, best loss up to each)``."""

    @jax.jit
    def run(state: Any, key: Any) -> tuple[Any, Any]:
        def generation(state: Any, key: Any) -> tuple[Any, Any]:
            ask, tell = jax.random.split(key)
            candidates, state = strategy.ask(ask, state, params)
            fitness = losses(candidates, strategy.get_mean(state))
            fitness = jnp.where(jnp.isfinite(fitness), fitness, 1e9)
            state, _ = strategy.tell(tell, candidates, fitness, state, params)
            return state, state.best_fitness

        return jax.lax.scan(generation, state, jax.random.split(key, count))

    return run
