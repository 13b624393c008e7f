"""Terms chosen by what is left out, on a linear model: there the statistics are exact, and numpy can do it all over."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from sim2real.errors import UsageError
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.validation.optional_terms import Selection, Statistics, below, choose, narrowed, votes

PARTS, ROWS, NOISE = 6, 200, 0.1


def row(name, term="", off=None):
    return Parameter(name, "1", 0.0, -10.0, 10.0, "linear", term=term, off=off)


TABLE = ParameterTable(
    [row("a"), row("b"), row("c", "real"), row("d", "idle"), row("e", "idle"), row("f", "once", 0.5)]
)


@pytest.fixture
def linear():
    """y = X w + noise in six parts; d and e do nothing, and f differs from 0.5 in one part alone."""
    rng = np.random.default_rng(4)
    X = rng.normal(size=(PARTS, ROWS, 6))
    w = np.tile([1.0, -2.0, 0.3, 0.0, 0.0, 0.5], (PARTS, 1))
    w[3, 5] = 1.0
    y = np.einsum("krp,kp->kr", X, w) + NOISE * rng.normal(size=(PARTS, ROWS))
    x = np.linalg.lstsq(X.reshape(-1, 6), y.reshape(-1), rcond=None)[0] + 0.05 * rng.normal(size=6)
    r = np.einsum("krp,p->kr", X, x) - y
    stats = Statistics(
        x=x,
        value=np.sum(r**2, axis=1),
        gradient=np.einsum("krp,kr->kp", X, r),
        information=np.einsum("krp,krq->kpq", X, X),
        prior=np.zeros((6, 6)),
        count=np.full(PARTS, float(ROWS)),
    )
    return SimpleNamespace(X=X, y=y, stats=stats)


def by_numpy(linear, free, held):
    """Fit each part's complement by least squares, and return the mean square on the part."""
    found = []
    for k in range(PARTS):
        rest = np.delete(np.arange(PARTS), k)
        X, y = linear.X[rest].reshape(-1, 6), linear.y[rest].reshape(-1)
        w = held.copy()
        w[free] = np.linalg.lstsq(X[:, free], y - X @ held, rcond=None)[0]
        found.append(np.mean((linear.X[k] @ w - linear.y[k]) ** 2))
    return np.array(found)


def test_excess_and_errors_are_those_of_fits_by_numpy(linear):
    found = choose(linear.stats, TABLE)
    assert found.order[-1] == "real"
    held = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    term_of = {"real": [2], "idle": [3, 4], "once": [5]}
    free, scores = [0, 1, 2, 3, 4, 5], []
    for gone in [None, *found.order]:
        free = [i for i in free if gone is None or i not in term_of[gone]]
        own = np.where(np.isin(np.arange(6), free), 0.0, held)
        scores.append(by_numpy(linear, free, own))
    best = min(scores, key=lambda s: s.mean())
    np.testing.assert_allclose(found.excess, [(s - best).mean() for s in scores], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        found.error, [(s - best).std(ddof=1) / np.sqrt(PARTS) for s in scores], rtol=1e-6, atol=1e-12
    )


def test_a_term_that_all_parts_need_stays_and_one_that_none_or_one_needs_goes(linear):
    np.testing.assert_array_equal(choose(linear.stats, TABLE).kept, [True, False, False])


def test_steps_are_least_squares_without_the_part(linear):
    step = linear.stats.step(TABLE, np.array([True, False, True]), 2)
    rest = np.delete(np.arange(PARTS), 2)
    free = [0, 1, 2, 5]
    w = np.linalg.lstsq(linear.X[rest].reshape(-1, 6)[:, free], linear.y[rest].reshape(-1), rcond=None)[0]
    np.testing.assert_allclose((linear.stats.x + step)[free], w, rtol=1e-8)
    np.testing.assert_allclose((linear.stats.x + step)[[3, 4]], 0.0, atol=1e-12)


def test_without_leaves_one_part_out_of_the_choice(linear):
    fewer = linear.stats.without(3)  # the only part that needs f
    found = choose(fewer, TABLE)
    assert len(fewer.value) == PARTS - 1
    assert found.kept[0]
    assert not found.kept[2]
    assert found.excess[list(found.order).index("once") + 1] < 1e-3


def test_a_table_knows_its_terms():
    assert TABLE.terms == ("real", "idle", "once")
    fewer = TABLE.with_terms(["real"])
    assert fewer.terms == ("real",)
    assert [p.name for p in fewer if not p.free] == ["d", "e", "f"]
    assert fewer["f"].nominal == 0.5
    with pytest.raises(UsageError, match="unknown term 'gone'"):
        TABLE.with_terms(["gone"])
    kept = TABLE.of_terms(np.array([True, False, False]))
    assert kept.tolist() == [n in "abc" for n in TABLE.names]
    values = TABLE.decode(np.ones(6), kept)
    assert [round(float(values[n]), 3) for n in "def"] == [0.0, 0.0, 0.5]
    assert float(values["c"]) == pytest.approx(float(TABLE.decode(np.ones(6))["c"])) != 0.0
    with pytest.raises(UsageError, match="its value without a term"):
        row("g", off=1.0)


def test_a_model_that_other_recordings_would_choose_is_kept_with_how_often(linear):
    found = choose(linear.stats, TABLE)
    np.testing.assert_array_equal(found.near[0], found.kept)
    assert found.weight.sum() == pytest.approx(1.0)
    assert found.weight[0] > 0.5, "what all parts need"
    assert found.near[:, 0].all(), "without it all parts are worse"
    assert len(np.unique(found.near, axis=0)) == len(found.near)


def test_a_term_that_half_of_the_parts_need_is_open(linear):
    X, rng = linear.X, np.random.default_rng(0)
    y = X @ np.array([1.0, -2.0, 0.0, 0.0, 0.0, 0.5]) + NOISE * rng.normal(size=(PARTS, ROWS))
    y[:3] += 0.05 * X[:3, :, 2]
    r = np.einsum("krp,p->kr", X, linear.stats.x) - y
    stats = replace(linear.stats, value=np.sum(r**2, axis=1), gradient=np.einsum("krp,kr->kp", X, r))
    found = choose(stats, TABLE)
    with_it = found.weight[found.near[:, 0]].sum()
    assert 0.1 < with_it < 0.9


def test_votes_are_those_of_scores_that_differ_by_part():
    scores = np.array([[1.0, 1.0, 1.0, 1.0], [0.0, 2.0, 0.0, 2.0], [3.0, 3.0, 3.0, 3.0]])
    share = votes(scores, np.array([2, 2, 1]))
    assert share[:2] == pytest.approx([0.5, 0.5], abs=0.05), "either is better in half of all weightings"
    assert share[2] == 0.0, "worse everywhere"
    smaller = votes(scores, np.array([2, 1, 1]))
    assert smaller[1] > 0.7, "the smaller of two that cannot be told apart"


def test_a_bounded_step_is_that_of_a_solver_with_bounds():
    """Parameters that would leave their bounds stop there, and the others go where the loss is least then."""
    rng = np.random.default_rng(5)
    table = ParameterTable([Parameter(n, "1", 0.5, 0.0, 1.0, "linear") for n in "abcd"])
    J, r = rng.normal(size=(40, 4)), rng.normal(size=40)
    r = r + J @ np.array([1.5, -0.2, 0.1, 0.0])  # a would go far below 0
    x = np.array([0.3, 0.5, 0.5, 0.5])
    whole = Statistics(x, np.array([r @ r]), (J.T @ r)[None], (J.T @ J)[None], np.zeros((4, 4)), np.array([40]))
    step = whole.step(table, np.ones(0, bool), bounded=True)
    best = lsq_linear(J, -r, (0.0 - x, 1.0 - x), method="bvls").x
    np.testing.assert_allclose(step, best, atol=1e-9)
    assert step[0] == pytest.approx(-0.3)
    assert whole.step(table, np.ones(0, bool))[0] < -0.3


def three_terms():
    """All three terms chosen, with the order in which they would go: idle, once, real."""
    one = np.ones(3, bool)
    return Selection(one, ("idle", "once", "real"), np.zeros(4), np.zeros(4), one[None], np.ones(1))


def test_the_sets_below_a_choice_go_down_to_none():
    assert [m.tolist() for m in below(three_terms(), TABLE)] == [
        [False, False, False], [True, False, False], [True, False, True], [True, True, True],
    ]  # fmt: skip
    none = replace(three_terms(), kept=np.zeros(3, bool))
    assert [m.tolist() for m in below(none, TABLE)] == [[False, False, False]]


@pytest.mark.parametrize(
    ("scores", "errors", "kept"),
    [
        # Mean squares of each set on three parts, the smallest set first; errors up to the horizon and in one go.
        (([9, 9, 9], [4, 4, 4], [2, 2, 2], [1, 1, 1]), None, 3),
        (([9, 9, 9], [1.1, 0.9, 1.1], [2, 0.4, 1], [1, 1, 1]), None, 1),  # within a standard error of the best
        (([9, 9, 9], [1, 1, 1], [100, 100, 100], [400, 1, 400]), None, 1),  # refits that ended anywhere
        (([9, 9, 9], [1, 1, 1], [np.nan, 1, 1], [np.inf, 1, 1]), None, 1),  # refits that diverged
        # Ahead the largest is best; in one go it is far off, and a smaller one is not.
        (([9, 9, 9], [4, 4, 4], [2, 2, 2], [1, 1, 1]), ((3, 30), (2, 2), (1.4, 25), (1, 25)), 1),
        (([9, 9, 9], [4, 4, 4], [2, 2, 2], [1, 1, 1]), ((3, 30), (2, 9), (1.4, 25), (1, 25)), 3),
        (([9, 9, 9], [4, 4, 4], [2, 2, 2], [1, 1, 1]), ((3, 30), (2, 2), (1.4, 1), (1, np.inf)), 2),
    ],
)
def test_a_choice_is_narrowed_to_what_refits_on_other_parts_bear_out(scores, errors, kept):
    scores = np.array(scores, float)
    errors = np.sqrt(scores.mean(axis=1))[:, None] if errors is None else np.array(errors, float)
    found = narrowed(three_terms(), TABLE, scores, errors)
    assert found.kept.sum() == kept
    np.testing.assert_array_equal(found.near[0], found.kept)
    assert found.weight.sum() == pytest.approx(1.0)
