"""CMA-ES as published (N. Hansen, The CMA Evolution Strategy: A Tutorial, arXiv 1604.00772), in a unit box."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

WORST_LOSS = 1e12
"""Loss of a candidate whose simulation returned NaN or infinity."""


class CmaEs:
    """One run.

    Args:
        mean: Start ``(P,)``, within [0, 1].
    """

    def __init__(self, mean: np.ndarray, sigma: float, population: int, rng: np.random.Generator) -> None:
        n, self.count, self._rng = len(mean), population, rng
        weights = np.log(population / 2 + 0.5) - np.log(np.arange(1, population // 2 + 1))
        self._w = weights / weights.sum()
        mu = 1 / np.sum(self._w**2)
        self._cs, self._cc = (mu + 2) / (n + mu + 5), (4 + mu / n) / (n + 4 + 2 * mu / n)
        self._c1 = 2 / ((n + 1.3) ** 2 + mu)
        self._cmu = min(1 - self._c1, 2 * (mu - 2 + 1 / mu) / ((n + 2) ** 2 + mu))
        self._damp, self._mu = 1 + 2 * max(0.0, np.sqrt((mu - 1) / (n + 1)) - 1) + self._cs, mu
        self._chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        self.mean, self.sigma, self._c = mean.copy(), sigma, np.eye(n)
        self._ps, self._pc, self._generation = np.zeros(n), np.zeros(n), 0

    def sample(self) -> np.ndarray:
        """Return candidates ``(population, P)``, drawn again a few times where they leave the box."""
        self._d, self._b = np.linalg.eigh(self._c)
        self._d = np.sqrt(np.maximum(self._d, 1e-20))
        draw = lambda k: self._rng.standard_normal((k, len(self.mean))) * self._d @ self._b.T  # noqa: E731
        steps = draw(self.count)
        for _ in range(10):
            out = np.any(np.abs(self.mean + self.sigma * steps - 0.5) > 0.5, axis=1)
            steps[out] = draw(int(out.sum()))
        return np.clip(self.mean + self.sigma * steps, 0.0, 1.0)

    def update(self, candidates: np.ndarray, losses: np.ndarray) -> None:
        """Update mean, step size and covariance from a generation.

        Args:
            candidates: Shape ``(population, P)``.
            losses: Shape ``(population,)``.
        """
        self._generation += 1
        best = (candidates[np.argsort(losses)[: len(self._w)]] - self.mean) / self.sigma
        step = self._w @ best
        self.mean = self.mean + self.sigma * step
        white = self._b @ ((self._b.T @ step) / self._d)
        self._ps = (1 - self._cs) * self._ps + np.sqrt(self._cs * (2 - self._cs) * self._mu) * white
        length = np.linalg.norm(self._ps) / np.sqrt(1 - (1 - self._cs) ** (2 * self._generation))
        heavy = length / self._chi < 1.4 + 2 / (len(self.mean) + 1)
        self._pc = (1 - self._cc) * self._pc + heavy * np.sqrt(self._cc * (2 - self._cc) * self._mu) * step
        lost = self._c1 * (1 - heavy) * self._cc * (2 - self._cc)
        self._c = (1 - self._c1 - self._cmu + lost) * self._c + self._c1 * np.outer(self._pc, self._pc)
        self._c += self._cmu * (best.T * self._w) @ best
        self.sigma *= float(np.exp(min(1.0, self._cs / self._damp * (np.linalg.norm(self._ps) / self._chi - 1))))


def minimise(
    losses: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    deadline: float,
    seed: int,
    sigma: float = 0.25,
    population: int = 0,
) -> tuple[np.ndarray, float, int]:
    """Search until a deadline; after convergence, restart at a random place with twice the population.

    Args:
        losses: Candidates ``(N, P)`` in the unit box -> ``(N,)``.
        start: Start of the first run ``(P,)``.
        deadline: On the clock of the process's processor time [s]; at least one generation is evaluated.
        population: Candidates of a generation of the first run; 0: the tutorial's.

    Returns:
        The best candidate, its loss, and the number of evaluations.
    """
    rng = np.random.default_rng(seed)
    count = population or 4 + int(3 * np.log(len(start)))
    best, lowest, evaluated = start.copy(), np.inf, 0
    run = CmaEs(start, sigma, count, rng)
    while True:
        candidates = run.sample()
        values = np.nan_to_num(losses(candidates), nan=WORST_LOSS, posinf=WORST_LOSS)
        evaluated += len(values)
        if values.min() < lowest:
            lowest, best = float(values.min()), candidates[np.argmin(values)].copy()
        if time.process_time() > deadline:
            return best, lowest, evaluated
        run.update(candidates, values)
        if np.ptp(values) <= 1e-3 * abs(values.min()) or run.sigma < 1e-4:
            count *= 2
            run = CmaEs(rng.uniform(0.0, 1.0, len(start)), sigma, count, rng)
