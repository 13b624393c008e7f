"""What may be absent: textbook bounds where the model is linear, and refusals where the data bounds nothing."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.uncertainty.ensemble import posterior
from sim2real.identify.uncertainty.identifiability import from_linearised as judged
from sim2real.identify.uncertainty.negligible import negligible
from sim2real.identify.uncertainty.profile import ONE_SIDED, Profile
from sim2real.identify.uncertainty.uncertainty import Linearised, from_linearised

SEGMENTS, SAMPLES = 30, 40
LOW, HIGH = 1e-4, 10.0


def made(effects, truth, seed=0, names="fgh", gain=0.0):
    """Return a problem whose residuals are linear in frictions, its estimate, and what is known of it.

    Args:
        effects: Shape ``(P, N)``: what 1 of each does.
        truth: Their true values.
        seed: Of the noise, of deviation 1.
        names: One a friction.
        gain: Effect of a parameter on a linear scale, ``k``, true at 0, where it is not 0.
    """
    rows = [Parameter(n, "N m", 0.1, LOW, HIGH, vanishes=True) for n, _ in zip(names, effects, strict=False)]
    X = np.asarray(effects, float)
    if np.ndim(gain):
        rows.append(Parameter("k", "1", 0.0, -10.0, 10.0, "linear"))
        X = np.vstack([X, gain])
    table = ParameterTable(rows)
    noise = np.random.default_rng(seed).normal(size=X.shape[1])
    y = np.asarray([*truth, 0.0][: len(X)]) @ X + noise
    free = np.linalg.lstsq(X.T, y, rcond=None)[0]
    low = np.array([p.low for p in table])
    best = np.maximum(free, low * 1.01)
    if (free < low).any() and len(rows) > 1:  # one is at its bound: the others are fitted without it
        at_bound = free < low
        rest = np.linalg.lstsq(X[~at_bound].T, y - low[at_bound] @ X[at_bound], rcond=None)[0]
        best[~at_bound] = rest
    x = np.array([p.to_scale(v) for p, v in zip(table, best, strict=True)])
    shape = (SEGMENTS, SAMPLES, 1)
    slope = np.where([p.transform == "log" for p in table], best, 1.0)
    r = (best @ X - y).reshape(shape)
    J = (X * slope[:, None]).T.reshape(*shape, len(X))
    at = Linearised(r, J, np.diag(12.0 / table.span**2), x, r)

    def given(z, values):
        own = np.where(np.isnan(values), best, values)
        return (own @ X - y).reshape(len(values), *shape)

    problem = SimpleNamespace(
        table=table, config=SimpleNamespace(initial_state="rest"), channels=(Channel("q", None, 1.0, 1.0),),
        segment_s=1.0, train=np.arange(SEGMENTS), with_values=given,
    )  # fmt: skip
    spread, check = from_linearised(problem, at), judged(problem, at)
    return problem, x, at, spread, check, best


def after(*arguments, **options):
    problem, x, at, spread, check, best = made(*arguments, **options)
    return problem, spread, check, *negligible(problem, x, at, spread, check), best


def noise(seed, size=SEGMENTS * SAMPLES):
    return np.random.default_rng([seed, 7]).normal(size=size)


@pytest.mark.parametrize("seed", [0, 5, 9])
def test_a_friction_that_is_not_there_gets_the_textbooks_upper_bound(seed):
    effect = 100.0 * noise(0)
    _, before, _, spread, check, _ = after([effect], [0.0], seed=seed)
    assert before.verdict[0] != "accepted"
    assert spread.verdict == ("negligible",)
    assert check.undetermined == ()
    assert spread.low[0] == 0.0
    sigma = 1.0 / np.linalg.norm(effect)
    # The sum of squares, over its variance, is then 1.645^2 above that at 0, or at the free estimate if that is more.
    free = effect @ np.random.default_rng(seed).normal(size=len(effect)) / (effect @ effect) / sigma
    expected = free + np.hypot(1.645, min(free, 0.0))
    assert spread.high[0] == pytest.approx(expected * sigma, rel=0.25)


def test_the_bound_holds_for_95_of_100_robots():
    held = judged_so = 0
    for seed in range(300):
        effect = 30.0 * noise(seed)
        truth = 0.3 / np.linalg.norm(effect)
        _, _, _, spread, _, _ = after([effect], [truth], seed=seed)
        if spread.verdict[0] == "negligible":
            judged_so += 1
            held += spread.high[0] >= truth
    assert judged_so > 150
    assert held >= 0.93 * judged_so


@pytest.mark.parametrize("size", [0.0, 0.005])
def test_what_has_no_effect_or_hardly_any_is_not_bounded(size):
    _, before, _, spread, check, _ = after([size * noise(1)], [0.0])
    assert spread.verdict == before.verdict
    assert check.undetermined == (("f",),)


def test_a_friction_that_is_there_stays_as_it_was():
    _, before, _, spread, _, _ = after([30.0 * noise(2)], [0.5])
    assert spread is before
    assert spread.verdict == ("accepted",)


def test_of_two_that_stand_for_each_other_only_one_may_be_absent():
    effect = 100.0 * noise(4)
    truth = 4.0 / np.linalg.norm(effect)  # together they are needed
    _, _, _, spread, _, _ = after([effect, effect + 20.0 * noise(5)], [truth / 2, truth / 2], seed=1)
    assert spread.verdict.count("negligible") <= 1


def test_intervals_of_others_allow_for_all_that_it_may_be():
    effect = 100.0 * noise(6)
    _, before, _, spread, _, best = after([effect], [0.0], seed=4, gain=effect + 60.0 * noise(7))
    assert spread.verdict[0] == "negligible"
    k = 1
    assert spread.high[k] - spread.low[k] > 1.05 * (before.high[k] - before.low[k])
    assert spread.low[k] < best[k] < spread.high[k]
    # What training draws of it stays below its bound, but for one in twenty.
    assert np.log(best[0]) + 1.645 * np.sqrt(spread.scale_covariance[0, 0]) == pytest.approx(np.log(spread.high[0]))


def limited(pushes, limit, estimate, seed=0):
    """Return what is judged of ``y = min(gain push, limit)``, with noise of deviation 0.1, at an estimate of the limit.

    Args:
        pushes: Shape ``(N,)``.
        limit: The true one, with a gain of 1.
        estimate: Where the fit has ended.
        seed: Of the noise.
    """
    table = ParameterTable(
        [Parameter("gain", "1", 1.0, 0.1, 10.0), Parameter("most", "N m", 1.5, 0.1, 8.0, limits=True)]
    )
    y = (np.minimum(pushes, limit) + 0.1 * np.random.default_rng(seed).normal(size=len(pushes))) / 0.1
    free = pushes < min(limit, estimate)
    gain = max(0.1 * pushes[free] @ y[free] / (pushes[free] @ pushes[free]), 0.11)
    best, shape = np.array([gain, estimate]), (SEGMENTS, SAMPLES, 1)
    x = np.array([p.to_scale(v) for p, v in zip(table, best, strict=True)])

    def off(values):
        return np.minimum(values[0] * pushes, values[1]) / 0.1 - y

    J = np.stack([np.where(gain * pushes < estimate, gain * pushes, 0.0), (gain * pushes >= estimate) * estimate], -1)
    r = off(best).reshape(shape)
    at = Linearised(r, J.reshape(*shape, 2) / 0.1, np.diag(12.0 / table.span**2), x, r)
    problem = SimpleNamespace(
        table=table, config=SimpleNamespace(initial_state="rest"), channels=(Channel("q", None, 1.0, 1.0),),
        segment_s=1.0, train=np.arange(SEGMENTS), with_values=lambda z, rows: np.stack(
            [off(np.where(np.isnan(row), best, row)).reshape(shape) for row in rows]),
    )  # fmt: skip
    spread, check = from_linearised(problem, at), judged(problem, at)
    return problem, at, spread, check, *negligible(problem, x, at, spread, check)


PUSHES = np.abs(np.random.default_rng(3).uniform(-1.0, 1.0, SEGMENTS * SAMPLES))


@pytest.mark.parametrize("seed", [0, 5, 9])
@pytest.mark.parametrize("estimate", [1.2, 3.0, 7.99])
def test_of_a_limit_that_no_motion_reaches_only_a_lower_bound_is_said(estimate, seed):
    problem, at, before, open_before, spread, check = limited(PUSHES, 4.0, estimate, seed)
    assert before.verdict[1] in ("not identifiable", "at a bound")
    assert "most" in open_before.undetermined[0]
    assert spread.verdict == ("accepted", "not reached")
    assert check.undetermined == ()
    assert spread.high[1] == pytest.approx(8.0)
    assert 0.8 < spread.low[1] <= 1.0, "more than was reached cannot be said; much less would be a waste"
    found = SimpleNamespace(problem=problem, z=problem.table.encode({"gain": 1.0, "most": estimate}), refined=())
    drawn = posterior(found, at, spread, found, None).sample(np.random.default_rng(0), 500)["most"]
    assert drawn.min() >= spread.low[1] * (1 - 1e-9)
    assert drawn.max() <= 8.0
    assert np.percentile(drawn, 90) > 2.0, "any higher limit explains the recordings as well"


def test_the_loss_below_a_limit_grows_from_what_was_reached_on():
    """Values are 2 % apart: a bound between the last without effect and the next was 0.7 % too high."""
    values, reached = np.array([3.0, 1.0102, 0.9892, 0.9688]), 1.0
    curve = Profile(values, (1200.0 * np.maximum(reached - values, 0.0)) ** 2, np.zeros((4, 1)), np.zeros((4, 1)))
    assert curve.bound() == pytest.approx(reached - ONE_SIDED / 1200.0, abs=1e-6)


def test_a_limit_that_is_reached_stays_as_it_was():
    _, _, before, _, spread, _ = limited(PUSHES, 0.7, 0.7)
    assert spread is before
    assert spread.verdict == ("accepted", "accepted")
    assert spread.low[1] < 0.7 < spread.high[1]


def test_a_limit_of_what_never_moves_is_not_bounded():
    _, _, before, check, spread, _ = limited(1e-4 * PUSHES, 4.0, 3.0)
    assert spread is before
    assert any("most" in group for group in check.undetermined)


def test_a_limit_that_is_contradicted_is_not_taken_for_one_that_is_not_reached():
    _, _, _, _, spread, _ = limited(PUSHES, 4.0, 0.101)
    assert spread.verdict[1] == "at a bound"
