"""CMA-ES in the unit box with restarts, as BAM and PACE search."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

WORST_LOSS = 1e12
"""Loss of a candidate whose simulation returned NaN or infinity."""


def minimise(
    losses: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    deadline: float,
    seed: int,
    sigma: float = 0.25,
    population: int | None = None,
) -> tuple[np.ndarray, float, int]:
    """Search until a deadline; after convergence, restart at a random place with twice the population.

    Args:
        losses: Candidates ``(N, P)`` in the unit box -> ``(N,)``.
        start: Start of the first run ``(P,)``.
        deadline: On the clock of the process's processor time [s]; at least one generation is evaluated.
        population: Candidates of a generation of the first run; None: the tutorial's.

    Returns:
        The best candidate, its loss, and the number of evaluations.
    """
    from cmaes import CMA  # the extra `bench`

    rng, box = np.random.default_rng(seed), np.tile([0.0, 1.0], (len(start), 1))
    best, lowest, evaluated = start.copy(), np.inf, 0
    run = CMA(start, sigma, box, n_max_resampling=10, seed=seed, population_size=population)
    while True:
        candidates = np.array([run.ask() for _ in range(run.population_size)])
        values = np.nan_to_num(losses(candidates), nan=WORST_LOSS, posinf=WORST_LOSS)
        evaluated += len(values)
        if values.min() < lowest:
            lowest, best = float(values.min()), candidates[np.argmin(values)].copy()
        if time.process_time() > deadline:
            return best, lowest, evaluated
        run.tell(list(zip(candidates, values.tolist(), strict=True)))
        if np.ptp(values) <= 1e-3 * abs(values.min()) or run.should_stop():
            place, count = rng.uniform(0.0, 1.0, len(start)), 2 * run.population_size
            seed = int(rng.integers(2**31))
            run = CMA(place, sigma, box, n_max_resampling=10, seed=seed, population_size=count)
