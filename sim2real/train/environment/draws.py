"""The robots that training draws: parameters and delays together, as far apart as the recordings leave open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sim2real.artifacts.estimation.posterior import TRANSFORMS, Posterior
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.errors import UsageError
from sim2real.train.environment.variation import VariationConfig

COUNT = 1024
"""How many robots are drawn."""


def draw_robots(
    values: Mapping[str, float],
    found: Identification | None,
    vary: VariationConfig,
    randomise: float,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Draw parameters and delays of robots: name -> ``(K,)``; those that are the same for all are left out.

    Args:
        values: Parameter -> the value to train on.
        found: What was identified; None: the values are a data sheet's.
        randomise: Factor on how much; 0: only what ``vary.range`` says.

    Raises:
        UsageError: When ``vary.range`` names no parameter.
    """
    drawn: dict[str, np.ndarray] = {}
    if vary.uniform and randomise:
        share = min(vary.uniform * randomise, 0.99)
        drawn = {n: v * rng.uniform(1.0 - share, 1.0 + share, COUNT) for n, v in values.items() if v}
    elif found is not None and found.posterior is not None and randomise:
        wider = found.widening if vary.misfit and found.widening is not None else 1.0
        sampled = widened(found, wider).sample(rng, COUNT, randomise)
        kinds = {p.name: p.kind for p in found.parameters}
        drawn = {n: v for n, v in sampled.items() if kinds.get(n) in ("dynamics", "delay")}
    if unknown := sorted(set(vary.range) - set(values)):
        raise UsageError(
            f"vary.range names {', '.join(unknown)}, which this model does not have",
            hint=f"its parameters: {', '.join(values)}",
        )
    return drawn | {n: rng.uniform(low, high, COUNT) for n, (low, high) in vary.range.items()}


def widened(found: Identification, factor: float) -> Posterior:
    """Return the posterior with what differs from recording to recording, and with deviations times a factor.

    So do its alternatives. A log tells only the sum of all delays. How they share it is left as it is: it changes
    nothing that a policy sees, and bounds on each delay would bend the sum.

    Args:
        found: What was identified, with a posterior.
    """
    posterior = found.posterior
    assert posterior is not None
    others = tuple(replace(o, posterior=_widened(o.posterior, found, factor)) for o in posterior.others)
    return replace(_widened(posterior, found, factor), others=others)


def _widened(posterior: Posterior, found: Identification, factor: float) -> Posterior:
    covariance = posterior.covariance * factor**2
    names = list(posterior.names)
    delays = [i for i, n in enumerate(names) if any(p.name == n and p.kind == "delay" for p in found.parameters)]
    share = np.eye(len(names))
    if delays:
        share[np.ix_(delays, delays)] = 1.0 / len(delays)
    covariance = share @ covariance @ share.T
    for quantity in found.aggregate:
        if quantity.name in names:
            i = names.index(quantity.name)
            slope = float(TRANSFORMS[posterior.transform[i]][2](np.float64(quantity.mean)))
            covariance[i, i] += (quantity.between / slope) ** 2
        elif quantity.name == ROUND_TRIP and delays:
            covariance[np.ix_(delays, delays)] += (quantity.between / len(delays)) ** 2
    return replace(posterior, covariance=covariance)
