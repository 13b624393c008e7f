"""Draws of parameters and delays for the episodes of a training, within the uncertainty of the identification."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.posterior import TRANSFORMS, Posterior
from sim2real.errors import UsageError
from sim2real.training.environment.variation import VariationConfig

COUNT = 1024
"""Number of draws."""


def draw_robots(
    values: Mapping[str, float],
    identification: Identification | None,
    vary: VariationConfig,
    randomise: float,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Draw parameters and delays: name -> ``(K,)``, without parameters that are equal in all draws.

    Args:
        values: Parameter -> the value to train on.
        identification: None: the values come from a data sheet.
        randomise: Factor on the standard deviations; 0: draw only the parameters in ``vary.range``.
    """
    draws: dict[str, np.ndarray] = {}
    if vary.uniform and randomise:
        share = min(vary.uniform * randomise, 0.99)
        draws = {n: v * rng.uniform(1.0 - share, 1.0 + share, COUNT) for n, v in values.items() if v}
    elif identification is not None and identification.posterior is not None and randomise:
        factor = identification.posterior.widening if vary.misfit else 1.0
        sampled = widen_posterior(identification, identification.posterior, factor).sample(rng, COUNT, randomise)
        kinds = {p.name: p.kind for p in identification.parameters}
        draws = {n: v for n, v in sampled.items() if kinds.get(n) in ("dynamics", "delay")}

    # Ranges that the user gives replace the posterior.
    if unknown := sorted(set(vary.range) - set(values)):
        raise UsageError(
            f"vary.range names {', '.join(unknown)}, which this model does not have",
            hint=f"its parameters: {', '.join(values)}",
        )
    return draws | {n: rng.uniform(low, high, COUNT) for n, (low, high) in vary.range.items()}


def without_default_ranges(
    vary: VariationConfig, defaults: VariationConfig, identified: Mapping[str, float]
) -> VariationConfig:
    """Return a variation without the pipeline's ranges of identified parameters; the user's ranges stay.

    Args:
        defaults: The pipeline's variation.
        identified: Parameter -> estimate, or the value at which it was fixed.
    """
    ranges = {n: r for n, r in vary.range.items() if n not in identified or defaults.range.get(n) != r}
    return replace(vary, range=ranges)


def widen_posterior(identification: Identification, posterior: Posterior, factor: float) -> Posterior:
    """Return the identification's posterior with its standard deviations times a factor.

    Then the variance between logs is added.
    """
    covariance = posterior.covariance * factor**2
    names = list(posterior.names)

    # Add the variance between logs, on the scale of the posterior.
    for row in identification.over_logs:
        if row.name in names:
            i = names.index(row.name)
            slope = float(TRANSFORMS[posterior.transform[i]][2](np.float64(row.mean)))
            covariance[i, i] += (row.spread / slope) ** 2
    return replace(posterior, covariance=covariance)
