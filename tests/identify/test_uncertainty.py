"""Uncertainty: textbook covariances where they hold, and honest ones where they do not."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import optimize, stats

from sim2real.errors import UsageError
from sim2real.identification import uncertainty
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.residuals import Linearised
from sim2real.identification.uncertainty import aggregate, determined, from_linearised

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
    errors = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found.standard_error, errors, rtol=0.35)
    assert np.all(found.standard_error > 0.95 * errors)
    spread = np.sqrt(np.diag(found.scale_covariance))
    correlation = found.scale_covariance / np.outer(spread, spread)
    np.testing.assert_allclose(correlation, expected / np.outer(errors, errors), atol=0.02)
    np.testing.assert_allclose(found.high - b, 1.961 * found.standard_error, rtol=1e-3)
    np.testing.assert_allclose(b - found.low, 1.961 * found.standard_error, rtol=1e-3)
    assert found.state == ("ok",) * 3


def test_a_residual_that_is_exactly_zero_counts():
    r, everywhere = np.random.default_rng(3).normal(size=(10, 40, 1)), np.ones((10, 40), bool)
    resting = np.where(np.arange(10)[:, None, None] < 5, r, 0.0)
    whole, half = uncertainty.deviation(resting, everywhere), uncertainty.deviation(resting[:5], everywhere[:5])
    assert whole == pytest.approx(half / np.sqrt(2.0), rel=1e-6)


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
    actual, claimed, _ = spread_of_estimates(make)
    assert claimed == pytest.approx(actual, rel=0.2)


def test_what_differs_from_part_to_part_widens():
    """The model lacks something that changes slowly: white noise on a level of each segment's own."""

    def make(i):
        rng = np.random.default_rng(i)
        return rng.normal(size=(20, 50, 1)) + rng.normal(size=(20, 1, 1))

    actual, claimed, _ = spread_of_estimates(make)
    assert actual == pytest.approx(np.sqrt(1 / 20 + 1 / 1000), rel=0.2)
    assert claimed == pytest.approx(actual, rel=0.25)


@pytest.fixture
def uneven():
    """Regressors ``(S, C, F, P)`` of ten segments, of which some say much more than others."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(10, 60, 1, 2)) * np.exp(rng.normal(0.0, 0.6, (10, 1, 1, 1)))


@pytest.mark.parametrize(("wrong", "least", "most"), [(0.0, 0.9, 0.99), (0.3, 0.85, 0.99)])
def test_intervals_hold_the_truth_of_a_right_model_and_of_a_wrong_one(uneven, wrong, least, most):
    """The wrong one's gains differ from segment to segment: linearised intervals hold the truth in half of the logs."""
    rng = np.random.default_rng(1)
    gains = wrong * rng.normal(size=(300, 10, 1, 1, 2))
    made = [rng.normal(size=uneven.shape[:-1]) + np.sum(g * uneven, axis=-1) for g in gains]
    held = [(u.low <= 0.0) & (u.high >= 0.0) for u, _, _ in (regression(uneven, y) for y in made)]
    assert least < np.mean(held) < most


def test_what_nothing_determines_gets_the_width_of_its_bounds():
    table = ParameterTable([Parameter("a", "1", 0.0, -1.0, 1.0, "linear"), Parameter("b", "1", 1.0, 0.1, 10.0)])
    rng = np.random.default_rng(0)
    X = np.concatenate([np.ones((10, 50, 1, 1)), np.zeros((10, 50, 1, 1))], axis=-1)
    r = 0.1 * rng.normal(size=(10, 50, 1))
    at = Linearised(r, X, np.diag(12.0 / table.span**2), np.array([0.2, 0.0]), r)
    found = from_linearised(stub(table), at)
    assert found.state == ("ok", "not determined")
    np.testing.assert_allclose(np.sqrt(found.scale_covariance[1, 1]), table.span[1] / np.sqrt(12.0), rtol=1e-5)
    assert found.standard_error[1] == pytest.approx(1.0 * table.span[1] / np.sqrt(12.0), rel=1e-5)  # value 1 times dlog
    assert (found.low[1], found.high[1]) == (pytest.approx(0.1, rel=0.2), pytest.approx(10.0, rel=0.2))


def test_an_estimate_at_a_bound_is_told():
    table = ParameterTable([Parameter("a", "1", 0.0, -1.0, 1.0, "linear")])
    noise = 0.1 * np.random.default_rng(0).normal(size=(10, 50, 1))
    for x, verdict in ((0.5, "ok"), (0.995, "at a bound"), (-0.995, "at a bound")):
        at = Linearised(noise, np.ones((10, 50, 1, 1)), np.diag(12.0 / table.span**2), np.array([x]), noise)
        found = from_linearised(stub(table), at)
        assert found.state == (verdict,)
        assert -1.0 <= found.low[0] < found.high[0] <= 1.0
    # Being vague makes it no less at a bound.
    table = ParameterTable([Parameter("a", "1", 0.0, -0.1, 0.1, "linear")])
    at = Linearised(noise, 0.3 * np.ones((10, 50, 1, 1)), np.diag(12.0 / table.span**2), np.array([0.1]), noise)
    assert from_linearised(stub(table), at).state == ("at a bound",)


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


@pytest.mark.parametrize("share", [(1.0,), (0.75, 0.25), (0.5, 0.5)])
@pytest.mark.parametrize(("wrong", "least"), [(0.0, 0.9), (0.3, 0.85), (1.0, 0.85)])
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
    assert held > least


def table_of(*parameters):
    return ParameterTable(list(parameters))


def linear(table, x, columns, noise=1.0, seed=0):
    """Return the linearisation of residuals with columns of some sizes, ``(S, K, 1, P)``, at a point."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(10, 60, 1, len(columns))) * np.array(columns)
    r = noise * rng.normal(size=J.shape[:-1])
    r -= (J.reshape(-1, len(columns)) @ np.linalg.lstsq(J.reshape(-1, len(columns)), r.ravel(), rcond=None)[0]).reshape(
        r.shape
    )
    return Linearised(r, J, np.diag(12.0 / table.span**2), np.array(x), r)


def test_a_friction_that_may_be_0_has_an_upper_bound_and_is_no_open_question():
    """On its logarithmic scale it is anywhere below; its effect is in proportion to its value."""
    friction = Parameter("friction", "N m", 0.1, 0.001, 1.0, vanishes=True)
    table = table_of(Parameter("gain", "1", 1.0, 0.1, 10.0), friction)
    value = 0.0015
    at = linear(table, [0.0, np.log(value)], [5.0, 20.0 * value])
    found = from_linearised(stub(table), at)
    assert found.state == ("ok", "absent")
    assert found.low[1] == 0.0
    assert found.high[1] == pytest.approx(value + 1.645 / (20.0 * np.sqrt(600)), rel=0.1)
    # One that could be large is not determined.
    vague = from_linearised(stub(table), linear(table, [0.0, np.log(value)], [5.0, 0.01 * value]))
    assert vague.state[1] == "not determined"


def test_what_may_be_0_only_if_others_vanish_with_it_is_no_absent_parameter():
    """Of gain and damping without a known force only the ratio counts: halves of both fit as well, zeros do not."""
    damping = Parameter("damping", "N m s/rad", 0.1, 0.001, 1.0, vanishes=True)
    table = table_of(Parameter("gain", "1", 1.0, 0.1, 10.0), damping)
    at = linear(table, [0.0, np.log(0.01)], [50.0, 0.0])
    at.jacobian[..., 1] = -at.jacobian[..., 0]
    assert from_linearised(stub(table), at).state[1] == "not determined"


def test_a_limit_that_no_motion_reaches_is_told_as_that():
    limit = Parameter("torque", "N m", 2.0, 0.5, 50.0, limits=True, term="torque", off=1e9)
    table = table_of(Parameter("gain", "1", 1.0, 0.1, 10.0), limit)
    found = from_linearised(stub(table), linear(table, [0.0, np.log(3.0)], [5.0, 0.0]))
    assert found.state == ("ok", "not reached")
    assert (found.low[1], found.high[1]) == (pytest.approx(3.0), pytest.approx(50.0))


@pytest.mark.parametrize(
    ("mix", "names"),
    [
        (np.eye(3), []),
        (np.diag([1.0, 1.0, 0.0]), ["c"]),
        (np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), ["a", "b"]),
        (np.array([[1.0, 1.0, 1.0]]), ["a", "b", "c"]),
    ],
)
def test_parameters_that_only_a_combination_determines_are_named(mix, names):
    table = table_of(*(Parameter(n, "1", 1.0, 0.5, 2.0) for n in "abc"))
    J = 5.0 * np.random.default_rng(0).normal(size=(10, 60, 1, len(mix))) @ mix
    at = Linearised(np.zeros(J.shape[:-1]), J, np.diag(12.0 / table.span**2), np.zeros(3), np.zeros(J.shape[:-1]))
    problem = SimpleNamespace(table=table, segment_s=1.0, train=np.arange(10))
    found = determined(problem, at)
    assert [list(group) for group in found.undetermined] == ([names] if names else [])
    assert all(name in found.messages[0] for name in names)
    assert not determined(problem, at, names).undetermined, "what may be absent does not count"
    # A minute of such data: ten segments of a second are a sixth of it.
    if not names:
        error = found.standard_error_per_minute["a"]
        assert error == pytest.approx(
            np.sqrt(np.linalg.inv(6.0 * J.reshape(-1, 3).T @ J.reshape(-1, 3))[0, 0]), rel=0.05
        )


def test_each_recording_alone_is_a_linear_step_from_all(monkeypatch):
    table = table_of(Parameter("a", "1", 0.0, -9.0, 9.0, "linear"))
    rng = np.random.default_rng(0)
    J, levels = np.ones((12, 50, 1, 1)), np.repeat([0.5, -0.5, 0.0], 4)
    r = 0.1 * rng.normal(size=(12, 50, 1)) - levels[:, None, None]
    at = Linearised(r, J, np.diag(12.0 / table.span**2), np.zeros(1), r)
    monkeypatch.setattr(uncertainty, "of_recordings", lambda problem: np.repeat(np.eye(3, dtype=bool), 4, axis=1))
    problem = stub(table)
    (row,) = uncertainty.compare_recordings(problem, at)
    assert row.mean == pytest.approx(0.0, abs=0.02)
    assert row.spread == pytest.approx(0.5, abs=0.03)  # the deviation of 0.5, -0.5 and 0
    assert row.low95 < -1.0
    bounded = table_of(Parameter("a", "1", 0.0, -1.0, 9.0, "linear"))
    (row,) = uncertainty.compare_recordings(stub(bounded), at)
    assert row.low95 == -1.0, "no further recording has a value beyond the bounds"


# Eight randomised trials of intravenous magnesium, log odds ratios and their standard errors' squares: any effects do.
EFFECTS = np.array([0.095, 0.277, 0.367, 0.664, 0.462, 0.185])
VARIANCES = np.array([0.033, 0.031, 0.050, 0.011, 0.043, 0.023])


def test_a_textbook_meta_analysis():
    """Borenstein, Hedges, Higgins and Rothstein, "A basic introduction to fixed-effect and random-effects models"."""
    found = aggregate(EFFECTS, np.sqrt(VARIANCES))
    assert found.mean == pytest.approx(0.358, abs=1e-3)
    assert found.standard_error == pytest.approx(0.105, abs=1e-3)
    assert found.spread**2 == pytest.approx(0.037, abs=1e-3)


def test_the_between_variance_solves_the_moment_equation():
    """DerSimonian and Laird: the expectation of Q under that variance is the Q that was found."""
    rng = np.random.default_rng(0)
    s = rng.uniform(0.1, 0.6, 7)
    x = 3.0 + rng.normal(size=7) * np.sqrt(s**2 + 0.25)
    w = s**-2
    q = float(w @ (x - np.average(x, weights=w)) ** 2)
    residual_maker = np.diag(w) - np.outer(w, w) / w.sum()  # Q = x' M x, so E Q = tr(M (S + between^2))
    expected = lambda tau2: float(np.trace(residual_maker @ np.diag(s**2 + tau2)))  # noqa: E731
    tau2 = optimize.brentq(lambda t: expected(t) - q, 0.0, 100.0)
    found = aggregate(x, s)
    assert found.spread**2 == pytest.approx(tau2, rel=1e-6)
    design, cov = np.ones((7, 1)), np.diag(s**2 + tau2)
    information = float((design.T @ np.linalg.solve(cov, design))[0, 0])
    mean = float((design.T @ np.linalg.solve(cov, x))[0]) / information
    assert found.mean == pytest.approx(mean)
    assert found.standard_error == pytest.approx(information**-0.5)
    reach = stats.t.ppf(0.975, 5) * np.sqrt(tau2 + 1 / information + np.median(s**2))
    assert (found.low95, found.high95) == (pytest.approx(mean - reach), pytest.approx(mean + reach))


def test_recordings_that_agree_have_nothing_between_them():
    found = aggregate(np.array([1.0, 1.1, 0.95]), np.full(3, 0.2))
    assert found.spread == 0.0
    assert found.mean == pytest.approx(np.mean([1.0, 1.1, 0.95]))
    assert found.standard_error == pytest.approx(0.2 / np.sqrt(3))


def test_one_recording_is_none():
    with pytest.raises(UsageError, match="two recordings at least, got 1"):
        aggregate(np.array([1.0]), np.array([0.1]))
