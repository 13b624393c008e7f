"""Delay distributions from recorded delays."""

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.delays import EmpiricalDist, StaticDist

_CONSTANT_S = 1e-7
"""Delays with a smaller standard deviation are fitted by a constant [s]."""
_MAX_LAG = 200
"""Largest lag at which the autocorrelation is computed [delays]."""


def fit_mixture(samples: np.ndarray, components: int = 4, seed: int = 0) -> StaticDist:
    """Fit a mixture of normal distributions; delays drawn from it are independent of each other.

    Args:
        samples: Shape ``(n,)``: recorded delays [s].
        components: Largest number of components; the Bayesian information criterion chooses the number.

    Returns:
        A constant, or a ``distrax.MixtureSameFamily``, whose draws are clipped at 0.

    Raises:
        UsageError: There are too few samples, or one is negative or not finite.
        Sim2RealError: scikit-learn is not installed; a plain installation lacks it.
    """
    x = _checked(samples)
    if x.std() < _CONSTANT_S:
        return StaticDist(float(x.mean()))
    if x.size < 2 * components:
        raise UsageError(f"{x.size} delays are too few for a mixture of up to {components} components")
    import distrax  # imported late: distrax takes 1.6 s, scikit-learn another 1 s
    import jax.numpy as jnp

    try:
        from sklearn.mixture import GaussianMixture
    except ImportError as error:
        raise Sim2RealError(
            "fit_mixture needs scikit-learn, which is not installed", hint="pip install 'sim2real[mixture]'"
        ) from error

    # Fit mixtures of 1, 2, ... components, and choose by the information criterion.
    scaled = ((x - x.mean()) / x.std())[:, None]
    fits = [GaussianMixture(k, random_state=seed, reg_covar=1e-6).fit(scaled) for k in range(1, components + 1)]
    best = min(fits, key=lambda fit: fit.bic(scaled))
    # Return to seconds: the fit is on samples without mean and scale.
    loc = np.asarray(best.means_)[:, 0] * x.std() + x.mean()
    scale = np.sqrt(np.asarray(best.covariances_)[:, 0, 0]) * x.std()
    return StaticDist(
        distrax.MixtureSameFamily(
            mixture_distribution=distrax.Categorical(probs=jnp.asarray(best.weights_, jnp.float32)),
            components_distribution=distrax.Normal(jnp.asarray(loc, jnp.float32), jnp.asarray(scale, jnp.float32)),
        )
    )


def resample(samples: np.ndarray) -> EmpiricalDist:
    """Return an ``EmpiricalDist`` whose blocks are as long as the recorded delays stay correlated.

    The block length is ``1 + 2 * (sum of the autocorrelation over lags 1, 2, ...)``, up to the first lag at which it
    falls below 0.1. So independent delays are drawn one by one, and runs of slow steps stay together.

    Args:
        samples: Shape ``(n,)``: recorded delays [s] in the order in which they occurred.

    Raises:
        UsageError: There are fewer than 2 samples, or one is negative or not finite.
    """
    x = _checked(samples)
    spread = x - x.mean()
    power = float(spread @ spread)
    if power < _CONSTANT_S**2 * x.size:
        return EmpiricalDist(x, 1)
    block = 1.0
    for lag in range(1, min(_MAX_LAG, x.size // 4)):
        rho = float(spread[:-lag] @ spread[lag:]) / power
        if rho < 0.1:
            break
        block += 2.0 * rho
    return EmpiricalDist(x, round(block))


def _checked(samples: np.ndarray) -> np.ndarray:
    """Return the samples as float64, checked to be at least 2 finite delays of at least 0 s."""
    x = np.asarray(samples, np.float64)
    if x.ndim != 1 or x.size < 2 or not np.isfinite(x).all() or (x < 0).any():
        raise UsageError(f"recorded delays must be at least 2 finite times of at least 0 s, got shape {x.shape}")
    return x
