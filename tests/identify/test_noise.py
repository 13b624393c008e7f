"""What a log shows of its sensor, and how far parameters must vary to cover what the model leaves unexplained."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import Noise
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.uncertainty import Linearised, above_noise, noises, widening

QUANTUM, DEVIATION, BIAS = 0.0015, 0.004, 0.003
SEGMENTS, LENGTH = 60, 80
TABLE = ParameterTable([Parameter("gain", "1", 1.0, 0.1, 10.0), Parameter("offset", "1", 1.0, 0.1, 10.0)])


def columns(deviation=DEVIATION, bias=BIAS, resolution=QUANTUM, slow=0.0):
    """Return segments of a sine: the model is it, the sensor scatters, and the model drifts off by ``slow``."""
    rng = np.random.default_rng(0)
    t = np.arange(LENGTH) * 0.02
    parts = []
    for s in range(SEGMENTS):
        truth = np.sin(3 * t + s)
        read = truth + slow * np.sin(2 * t + rng.uniform(0, 6)) + bias * rng.standard_normal()
        read = read + deviation * rng.standard_normal(LENGTH)
        read = np.round(read / resolution) * resolution if resolution else read
        parts.append((np.full(LENGTH, float(s)), read, truth))
    segment, measured, model = (np.concatenate(p) for p in zip(*parts, strict=True))
    return {"segment": segment, "q[1]_measured": measured, "q[1]_identified": model}


@pytest.mark.parametrize(
    ("made", "deviation", "resolution", "offset"),
    [
        ({}, DEVIATION, QUANTUM, BIAS),
        ({"deviation": 0.0, "bias": 0.0, "resolution": 0.0}, 0.0, 0.0, 0.0),
        ({"slow": 0.05, "bias": 0.0}, DEVIATION, QUANTUM, None),  # errors of the model are no noise
    ],
)
def test_white_noise_rounding_and_bias_are_told_apart(made, deviation, resolution, offset):
    (found,) = noises(columns(**made), {"q": "rad"})
    assert (found.field, found.unit, found.place) == ("q[1]", "rad", ("q", 1))
    assert found.resolution == pytest.approx(resolution, rel=1e-6)
    assert found.deviation == pytest.approx(deviation, rel=0.05)
    assert offset is None or found.offset == pytest.approx(offset, rel=0.3)


@pytest.mark.parametrize(("slow", "ratio"), [(0.0, 1.0), (0.3, 1.04), (1.0, 1.41), (5.0, 5.1)])
def test_residuals_are_above_the_noise_by_the_errors_of_the_model(slow, ratio):
    rng, t = np.random.default_rng(0), np.arange(SEGMENTS * LENGTH).reshape(SEGMENTS, LENGTH) * 0.02
    raw = rng.standard_normal((SEGMENTS, LENGTH, 2)) + slow * np.sqrt(2.0) * np.sin(2 * t)[..., None]
    compared = np.ones(raw.shape[:2], bool)
    raw[::2, -20:], compared[::2, -20:] = 7.0, False
    assert above_noise(linearised(raw, compared)) == pytest.approx(ratio, rel=0.05)


def linearised(raw, compared):
    return Linearised(raw, np.zeros((*raw.shape, 1)), np.eye(1), np.zeros(1), raw, compared)


@pytest.mark.parametrize("sizes", [(-1.0, 0.0, 0.0), (0.0, np.nan, 0.0), (0.0, 0.0, np.inf)])
def test_sizes_that_are_none_are_refused(sizes):
    with pytest.raises(ValueError, match="noise of"):
        Noise("q", "rad", *sizes)


def test_what_was_not_measured_is_not_noise():
    assert above_noise(linearised(np.zeros((3, 8, 1)), np.zeros((3, 8), bool))) == np.inf


def test_missing_samples_and_short_segments_are_left_out():
    samples = columns()
    samples["q[1]_measured"][::7] = np.nan
    samples["segment"][:3] = -1.0
    (found,) = noises(samples, {})
    assert found.deviation == pytest.approx(DEVIATION, rel=0.3)
    samples["q[1]_measured"][:] = np.nan
    assert noises(samples, {}) == ()


def linear(spread, noise=1.0):
    """Return a linear model whose parameters differ from segment to segment, fitted with one set for all.

    Returns:
        The linearised residuals, and the covariance of least squares.
    """
    rng = np.random.default_rng(1)
    t = np.linspace(0.0, 1.0, LENGTH)
    J = np.stack([np.sin(3 * t), np.ones(LENGTH)], axis=-1) * 20.0
    J = np.broadcast_to(J[None, :, None, :], (SEGMENTS, LENGTH, 1, 2))
    own = spread * rng.standard_normal((SEGMENTS, 2))
    raw = np.einsum("scfp,sp->scf", J, own) + noise * rng.standard_normal((SEGMENTS, LENGTH, 1))
    flat = J.reshape(-1, 2)
    raw = raw - np.einsum("scfp,p->scf", J, np.linalg.lstsq(flat, raw.ravel(), rcond=None)[0])
    covariance = np.linalg.inv(flat.T @ flat)
    at = Linearised(raw, J, np.zeros((2, 2)), np.zeros(2), raw)
    return at, SimpleNamespace(scale_covariance=covariance)


def test_a_model_that_explains_all_but_the_noise_widens_nothing():
    assert 1.0 <= widening(*linear(0.0)) < 1.6


@pytest.mark.parametrize("spread", [0.1, 0.4])
def test_draws_predict_as_spread_out_as_the_segments_are(spread):
    """A robot whose parameters differ from moment to moment."""
    at, uncertain = linear(spread)
    J = at.jacobian.reshape(-1, 2)
    predicted = widening(at, uncertain) ** 2 * np.einsum("np,pq,nq->n", J, uncertain.scale_covariance, J).mean()
    assert predicted == pytest.approx(spread**2 * np.mean(np.sum(J**2, axis=1)), rel=0.4)


def test_without_samples_nothing_is_widened():
    none = np.zeros((1, 5), bool)
    at = Linearised(np.zeros((1, 5, 1)), np.zeros((1, 5, 1, 2)), np.eye(2), np.zeros(2), np.zeros((1, 5, 1)), none)
    assert widening(at, SimpleNamespace(scale_covariance=np.eye(2))) == 1.0
