"""Uncertainty: textbook covariances where they hold, and honest ones where they do not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.uncertainty import uncertainty
from sim2real.identify.uncertainty.uncertainty import Linearised, from_linearised

WIDE = 1e4


def linear_table(count, names="abcdefg"):
    return ParameterTable([Parameter(names[i], "1", 0.0, -WIDE, WIDE, "linear") for i in range(count)])


def stub(table, initial_state="rest", segment_s=1.0):
    """Return what the uncertainty asks of a problem."""
    config = SimpleNamespace(initial_state=initial_state)
    channels = (Channel("q", "v", 1.0, 1.0),)
    return SimpleNamespace(table=table, config=config, channels=channels, segment_s=segment_s)


def regression(X, y, table=None, **arguments):
    """Fit ``y (S, C, F)`` by ``X (S, C, F, P)`` with numpy, and return the uncertainty of that, estimate and RSS."""
    flat = X.reshape(-1, X.shape[-1])
    b = np.linalg.lstsq(flat, y.reshape(-1), rcond=None)[0]
    r = (flat @ b - y.reshape(-1)).reshape(y.shape)
    table = table or linear_table(X.shape[-1])
    at = Linearised(r, X, np.diag(12.0 / table.span**2), b, r)
    return from_linearised(stub(table, **arguments), at), b, float(np.sum(r**2))


def test_a_linear_model_with_white_noise_has_the_textbooks_covariance():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(20, 50, 2, 3)) @ np.array([[1.0, 0.5, 0.0], [0.0, 2.0, 0.3], [0.0, 0.0, 0.1]])
    y = X @ np.array([1.0, -2.0, 0.5]) + 0.7 * rng.normal(size=X.shape[:-1])
    found, b, rss = regression(X, y)
    flat = X.reshape(-1, 3)
    expected = rss / (len(flat) - 3) * np.linalg.inv(flat.T @ flat)
    assert found.inflation == pytest.approx(1.0, abs=0.1)
    assert np.all(found.widening >= 1.0)
    assert np.all(found.widening < 1.4)
    widened = expected * found.inflation * np.outer(found.widening, found.widening)
    np.testing.assert_allclose(found.covariance, widened, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(found.scale_covariance, widened, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(found.standard_error, np.sqrt(np.diag(widened)), rtol=1e-4)
    np.testing.assert_allclose(found.correlation, widened / np.sqrt(np.outer(*[np.diag(widened)] * 2)), atol=1e-4)
    assert found.misfit == pytest.approx(np.sqrt(rss / len(flat)))
    reach = stats.t.ppf(0.975, len(flat) / found.inflation - 3) * found.standard_error
    np.testing.assert_allclose(found.low, b - reach, rtol=1e-4)
    np.testing.assert_allclose(found.high, b + reach, rtol=1e-4)
    assert found.verdict == ("accepted",) * 3


def test_few_measurements_get_the_quantile_of_student():
    rng = np.random.default_rng(3)
    x = np.linspace(-1, 1, 9)
    X = np.stack([np.ones(9), x], axis=1)[None, :, None]
    y = (2.0 + x + np.where(np.arange(9) % 2, -1.0, 1.0) * rng.uniform(0.05, 0.1, 9))[None, :, None]
    found, b, _ = regression(X, y)
    line = stats.linregress(x, y.ravel())
    assert found.inflation == 1.0  # signs alternate
    np.testing.assert_array_equal(found.widening, 1.0)  # a block is too few
    np.testing.assert_allclose(found.standard_error, [line.intercept_stderr, line.stderr], rtol=1e-5)
    np.testing.assert_allclose((found.high - b) / found.standard_error, stats.t.ppf(0.975, 7), rtol=1e-5)


def test_measurements_that_are_masked_do_not_count():
    rng = np.random.default_rng(1)
    X, noise = np.ones((1, 40, 1, 1)), rng.normal(size=(1, 40, 1))
    found, _, _ = regression(X, noise)
    padded = Linearised(
        np.concatenate([noise - noise.mean(), np.zeros((1, 60, 1))], axis=1) * -1,
        np.concatenate([X, np.zeros((1, 60, 1, 1))], axis=1),
        np.diag(12.0 / np.array([2 * WIDE]) ** 2),
        np.zeros(1),
        np.zeros((1, 100, 1)),
        np.arange(100)[None] < 40,
    )
    again = from_linearised(stub(linear_table(1)), padded)
    np.testing.assert_allclose(again.standard_error, found.standard_error, rtol=1e-6)


def autoregressive(rng, shape, rho):
    noise = rng.normal(size=shape)
    rows = [noise[:, 0]]
    for i in range(1, shape[1]):
        rows.append(rho * rows[-1] + np.sqrt(1 - rho**2) * noise[:, i])
    return np.stack(rows, axis=1)


def spread_of_estimates(make, repeats=150):
    """Return the standard deviation of estimates over data sets, and what one data set says of it, the median."""
    found = [regression(np.ones((*make(0).shape, 1)), make(i)) for i in range(repeats)]
    return np.std([b[0] for _, b, _ in found]), np.median([u.standard_error[0] for u, _, _ in found]), found[0][0]


def test_noise_that_is_correlated_in_time_widens():
    make = lambda i: autoregressive(np.random.default_rng(i), (20, 200, 1), 0.7)  # noqa: E731
    actual, claimed, first = spread_of_estimates(make)
    assert first.inflation == pytest.approx(1.7 / 0.3, rel=0.2)
    assert claimed == pytest.approx(actual, rel=0.2)


def test_what_differs_from_block_to_block_widens():
    """The model lacks something that changes slowly: white noise on a level of each second's own."""

    def make(i):
        rng = np.random.default_rng(i)
        return rng.normal(size=(30, 50, 1)) + rng.normal(size=(30, 1, 1))

    actual, claimed, first = spread_of_estimates(make)
    assert actual == pytest.approx(np.sqrt(1 / 30 + 1 / 1500), rel=0.2)
    assert first.widening[0] > 2.0
    assert claimed == pytest.approx(actual, rel=0.2)


@pytest.fixture
def uneven():
    """Regressors ``(S, C, F, P)`` of ten segments, of which some say much more than others."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(10, 60, 1, 2)) * np.exp(rng.normal(0.0, 0.6, (10, 1, 1, 1)))


def test_intervals_of_a_right_model_are_not_wider_for_few_blocks_that_differ(uneven):
    rng = np.random.default_rng(1)
    found = [regression(uneven, rng.normal(size=uneven.shape[:-1])) for _ in range(300)]
    widening, off = np.stack([u.widening for u, _, _ in found]), np.stack([b for _, b, _ in found])
    reach = np.stack([(u.high - u.low) / 2 for u, _, _ in found])
    assert np.mean(widening > 1.0) < 0.2
    assert np.median(reach, axis=0) == pytest.approx(1.96 * off.std(axis=0), rel=0.1)
    assert np.mean(np.abs(off) <= reach) == pytest.approx(0.95, abs=0.025)


def test_intervals_of_a_wrong_model_widen_with_few_blocks_too(uneven):
    """Gains differ from segment to segment: the linearised intervals hold the truth in half of all recordings."""
    rng = np.random.default_rng(1)
    gains = 0.3 * rng.normal(size=(300, 10, 1, 1, 2))
    made = [rng.normal(size=uneven.shape[:-1]) + np.sum(g * uneven, axis=-1) for g in gains]
    found = [regression(uneven, y) for y in made]
    held = [(u.low <= 0.0) & (u.high >= 0.0) for u, _, _ in found]
    narrow = [np.abs(b) <= 1.96 * u.standard_error / u.widening for u, b, _ in found]
    assert np.mean(narrow) < 0.7
    assert np.mean(held) > 0.88


def test_long_segments_are_many_blocks():
    """Levels of a second each, in one segment of thirty."""
    rng = np.random.default_rng(0)
    y = (rng.normal(size=(30, 50, 1)) + rng.normal(size=(30, 1, 1))).reshape(1, 1500, 1)
    found, _, _ = regression(np.ones((*y.shape, 1)), y, segment_s=30.0)
    assert found.widening[0] > 2.0


def test_what_nothing_determines_gets_the_width_of_its_bounds():
    table = ParameterTable([Parameter("a", "1", 0.0, -1.0, 1.0, "linear"), Parameter("b", "1", 1.0, 0.1, 10.0)])
    rng = np.random.default_rng(0)
    X = np.concatenate([np.ones((10, 50, 1, 1)), np.zeros((10, 50, 1, 1))], axis=-1)
    r = 0.1 * rng.normal(size=(10, 50, 1))
    at = Linearised(r, X, np.diag(12.0 / table.span**2), np.array([0.2, 0.0]), r)
    found = from_linearised(stub(table), at)
    assert found.verdict == ("accepted", "not identifiable")
    np.testing.assert_allclose(np.sqrt(found.scale_covariance[1, 1]), table.span[1] / np.sqrt(12.0), rtol=1e-5)
    assert found.standard_error[1] == pytest.approx(1.0 * table.span[1] / np.sqrt(12.0), rel=1e-5)  # value 1 times dlog
    assert (found.low[1], found.high[1]) == (pytest.approx(0.1, rel=0.2), pytest.approx(10.0, rel=0.2))


def test_an_estimate_at_a_bound_is_told():
    table = ParameterTable([Parameter("a", "1", 0.0, -1.0, 1.0, "linear")])
    noise = 0.1 * np.random.default_rng(0).normal(size=(10, 50, 1))
    for x, verdict in ((0.5, "accepted"), (0.995, "at a bound"), (-0.995, "at a bound")):
        at = Linearised(noise, np.ones((10, 50, 1, 1)), np.diag(12.0 / table.span**2), np.array([x]), noise)
        found = from_linearised(stub(table), at)
        assert found.verdict == (verdict,)
        assert -1.0 <= found.low[0] < found.high[0] <= 1.0


def test_what_lies_at_a_narrow_bound_is_no_less_at_a_bound_for_being_vague():
    table = ParameterTable([Parameter("a", "1", 0.0, -0.1, 0.1, "linear")])
    noise = np.random.default_rng(0).normal(size=(2, 10, 1))
    at = Linearised(noise, np.ones((2, 10, 1, 1)), np.diag(12.0 / table.span**2), np.array([0.1]), noise)
    assert from_linearised(stub(table), at).verdict == ("at a bound",)


@pytest.fixture
def delayed():
    """A gain and two delays of which the residuals know the sum alone."""
    table = ParameterTable(
        [
            Parameter("gain", "1", 0.0, -WIDE, WIDE, "linear"),
            Parameter("late", "s", 0.0, 0.0, 0.06, "linear", "delay", side="measurement"),
            Parameter("early", "s", 0.0, 0.0, 0.05, "linear", "delay", side="command"),
        ]
    )
    rng = np.random.default_rng(0)
    gain, delay = rng.normal(size=(2, 20, 60, 1))
    X = np.stack([gain, 100.0 * delay, 100.0 * delay], axis=-1)
    r = rng.normal(size=gain.shape)
    at = Linearised(r, X, np.diag(12.0 / table.span**2), np.array([1.0, 0.02, 0.025]), r)
    return SimpleNamespace(table=table, at=at, X=X)


def test_the_misfit_counts_every_deviation(delayed):
    """However a robust loss tames what is far off: 10 deviations are 10."""
    at = replace(delayed.at, raw=np.where(delayed.at.residuals != 0.0, 10.0, 0.0))
    assert from_linearised(stub(delayed.table), at).misfit == pytest.approx(10.0)


def test_with_one_delay_fixed_the_other_is_known(delayed):
    one = delayed.table.with_fixed({"early": 0.0})
    r = delayed.at.residuals
    at = Linearised(r, delayed.X[..., :2], np.diag(12.0 / one.span**2), delayed.at.x[:2], r)
    assert from_linearised(stub(one, "free"), at).verdict == ("accepted", "accepted")


def test_an_inverse_of_what_doubles_do_not_resolve_has_no_negative_variances():
    """Two parameters that a recording tells only as a sum, and a third that only its bounds say anything of."""
    column = np.random.default_rng(0).normal(size=400) * 1e6
    J = np.stack([column, column * (1.0 + 1e-12), 0.0 * column], axis=1)
    precision = J.T @ J + np.diag([1e-5, 1e-5, 1e-5])
    root = uncertainty.root_of_inverse(precision)
    assert np.isfinite(root).all()
    variance = np.diag(root @ root.T)
    assert variance[2] == pytest.approx(1e5)
    assert (variance[:2] > 100.0 / float(column @ column)).all(), "neither is known by itself"
    sure = np.diag([1.0, 4.0, 9.0]) + 0.5
    root = uncertainty.root_of_inverse(sure)
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(sure), rtol=1e-12)


@pytest.mark.parametrize("freedom", [2.0, 9.0, 40.0])
def test_intervals_widen_gradually_with_what_chance_does_not_explain(freedom):
    ratio = np.linspace(0.5, 4.0, 7001)
    quantile = 1.96
    wider = uncertainty._widening(ratio, np.full(len(ratio), freedom), quantile, np.ones(len(ratio), bool))
    assert np.all(np.diff(wider) >= 0.0)
    assert np.diff(wider).max() < 0.01
    chance = stats.chi2.sf(freedom * ratio**2, freedom)
    np.testing.assert_array_equal(wider[chance > 0.2], 1.0)
    full = ratio * stats.t.ppf(0.975, freedom) / quantile
    np.testing.assert_allclose(wider[chance < 0.05], full[chance < 0.05], rtol=1e-9)


@pytest.mark.parametrize("share", [(1.0,), (0.75, 0.25), (0.5, 0.5)])
@pytest.mark.parametrize(("wrong", "least"), [(0.0, 1.0), (0.3, 2.0), (1.0, 4.0)])
def test_what_one_block_determines_widens_as_what_many_determine(share, wrong, least):
    """Gains differ from block to block, and the third acts in one or two: these cannot show that it differs."""
    rng = np.random.default_rng(1)
    X = rng.normal(size=(20, 60, 1, 3)) * np.exp(rng.normal(0.0, 0.4, (20, 1, 1, 1)))
    X[..., 2] = 0.0
    for block, part in enumerate(share, 3):
        X[block, ..., 2] = np.sqrt(part) * rng.normal(size=(60, 1))
    made = [rng.normal(size=X.shape[:-1]) for _ in range(200)]
    found = [regression(X, y + np.sum(wrong * rng.normal(size=(20, 1, 1, 3)) * X, axis=-1)) for y in made]
    held = np.mean([(u.low[2] <= 0.0) & (u.high[2] >= 0.0) for u, _, _ in found])
    widening = np.median([u.widening[2] for u, _, _ in found])
    assert held > 0.9
    assert widening == 1.0 if wrong == 0.0 else widening > least


def test_where_blocks_determine_nothing_repeatedly_they_say_nothing():
    one = np.array([9.0])
    assert uncertainty._widening(one, np.array([1.9]), 1.96, np.array([False])) == 1.0
