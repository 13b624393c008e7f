"""Terms chosen by what is left out, on a linear model: there the statistics are exact, and numpy can do it all over."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from sim2real.errors import UsageError
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.validation.optional_terms import (
    Statistics,
    Trial,
    on_held_out_parts,
    select,
    selected,
    votes,
)
from sim2real.identify.validation.term_trials import grown

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
    return SimpleNamespace(X=X, y=y, stats=statistics_at(X, y, x))


def statistics_at(X, y, x):
    r = np.einsum("krp,p->kr", X, x) - y
    return Statistics(
        x=x,
        value=np.sum(r**2, axis=1),
        gradient=np.einsum("krp,kr->kp", X, r),
        information=np.einsum("krp,krq->kpq", X, X),
        prior=np.zeros((6, 6)),
        count=np.full(PARTS, float(ROWS)),
    )


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


HELD = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
SETS = {(): [0, 1], ("real",): [0, 1, 2], ("idle",): [0, 1, 3, 4], ("real", "once"): [0, 1, 2, 5]}


def terms(*names):
    return np.isin(TABLE.terms, names)


@pytest.mark.parametrize(("names", "free"), SETS.items())
def test_predicted_errors_of_a_set_are_those_of_fits_by_numpy(linear, names, free):
    held = np.where(np.isin(np.arange(6), free), 0.0, HELD)
    np.testing.assert_allclose(
        on_held_out_parts(linear.stats, TABLE, terms(*names)), by_numpy(linear, free, held), rtol=1e-6
    )


class Fits:
    """Fits sets to the linear model by numpy; fits of ``stuck`` sets end anywhere, with twenty times the error."""

    def __init__(self, linear, stuck=lambda present: False):
        self.linear, self.stuck, self.tried = linear, stuck, []

    def attempt(self, present, starts, most):
        self.tried.append(tuple(n for n, there in zip(TABLE.terms, present, strict=True) if there))
        assert all(len(z) == 6 for z in starts)
        free = np.flatnonzero(TABLE.of_terms(present))
        held = np.where(np.isin(np.arange(6), free), 0.0, HELD)
        errors = by_numpy(self.linear, free, held) * (400.0 if self.stuck(present) else 1.0)
        X, y = self.linear.X.reshape(-1, 6), self.linear.y.reshape(-1)
        w = held.copy()
        w[free] = np.linalg.lstsq(X[:, free], y - X @ held, rcond=None)[0]
        stats = statistics_at(self.linear.X, self.linear.y, w)
        return Trial(present, TABLE.at_scale(w), float(errors.mean()), stats, (), errors, 4.0 * errors)

    def grown(self, wider=lambda trial: trial.stats, **options):
        return grown(self.attempt, wider, TABLE, [np.zeros(6)], **options)


def test_a_term_that_all_parts_need_stays_and_one_that_none_or_one_needs_goes(linear):
    fits = Fits(linear)
    assert select(fits.grown()).names(TABLE) == ("real",)
    assert len(fits.tried) == len(set(fits.tried)) < 8, "no set is fitted twice, and not all are"


def test_the_choice_for_a_part_does_not_depend_on_its_errors(linear):
    trials = Fits(linear).grown()
    spoilt = [
        SimpleNamespace(**{**vars(t), "ahead": t.ahead * np.where(np.arange(PARTS) == 2, 1e6, 1.0)}) for t in trials
    ]
    assert select(spoilt).by_part[2].present.tolist() == select(trials).by_part[2].present.tolist()


def test_a_set_whose_fit_did_not_converge_is_not_chosen_before_its_subset(linear):
    """The widest model ends anywhere, as do all sets of two terms and more: one term remains."""
    fits = Fits(linear, stuck=lambda present: present.sum() > 1)
    assert select(fits.grown()).names(TABLE) == ("real",)


def test_a_set_that_no_prediction_proposed_is_fitted_if_it_is_a_subset_of_the_chosen_one(linear):
    """The predictions call for idle, then for idle and real together, so real alone is off the path."""
    fits, x = Fits(linear), linear.stats.x
    with_idle = statistics_at(linear.X, linear.y + linear.X[..., 3], x)
    found = select(fits.grown(lambda trial: trial.stats if trial.present.any() else with_idle))
    assert fits.tried[1:3] == [("idle",), ("real", "idle")]
    assert found.names(TABLE) == ("real",)


def test_a_needed_term_is_tried_before_those_that_predictions_propose(linear):
    fits, with_idle = Fits(linear), statistics_at(linear.X, linear.y + linear.X[..., 3], linear.stats.x)
    needed = [TABLE.terms.index("real")]
    grown(fits.attempt, lambda trial: with_idle, TABLE, [np.zeros(6)], needed=needed)
    assert fits.tried[1] == ("real",)
    assert ("idle",) not in fits.tried[:2]


@pytest.mark.parametrize(("share", "tried"), [(0.4, ("real", "once")), (0.6, ("real",))])
def test_a_model_that_is_clearly_worse_is_tried_with_all_needed_terms_at_a_time(linear, share, tried):
    fits, needed = Fits(linear), [TABLE.terms.index(n) for n in ("real", "once")]
    worst = fits.attempt(terms(), [np.zeros(6)], np.inf).loss
    fits.tried.clear()
    assert select(fits.grown(needed=needed, least=share * worst)).names(TABLE) == ("real",)
    assert fits.tried[1] == tried
    assert ("real",) in fits.tried


@pytest.mark.parametrize("optimism", [0.1, 1.0, 10.0])
def test_the_selected_set_is_judged_however_far_off_its_first_errors_are(linear, optimism):
    """First errors of ``real`` are too low or too high; those of refits decide, and no set is judged twice."""
    fits, judged = Fits(linear), []

    def attempt(present, starts, most):
        trial = fits.attempt(present, starts, most)
        return replace(trial, ahead=trial.ahead * (optimism if trial.names(TABLE) == ("real",) else 1.0), judged=False)

    def judge(trial):
        judged.append(trial.names(TABLE))
        return replace(fits.attempt(trial.present, [np.zeros(6)], np.inf), judged=True)

    trials = grown(attempt, lambda trial: trial.stats, TABLE, [np.zeros(6)], judge=judge)
    assert select(trials).names(TABLE) == ("real",)
    assert select(trials).near[0].judged
    assert len(judged) == len(set(judged)) <= len(trials)


def test_only_the_best_set_of_a_round_is_judged(linear):
    fits, judged = Fits(linear), []

    def judge(trial):
        judged.append(trial.names(TABLE))
        return replace(trial, judged=True)

    unjudged = lambda *of: replace(fits.attempt(*of), judged=False)  # noqa: E731
    trials = grown(unjudged, lambda trial: trial.stats, TABLE, [np.zeros(6)], judge=judge)
    assert 0 < len(judged) < len(trials)


def test_no_term_is_added_to_a_set_that_leaves_only_noise(linear):
    fits = Fits(linear)
    noise = lambda *of: replace(fits.attempt(*of), above=1.05)  # noqa: E731
    grown(noise, lambda trial: trial.stats, TABLE, [np.zeros(6)])
    assert fits.tried == [()]


class WithLimit(ParameterTable):
    """The table, in which ``once`` is a limit."""

    def of_limits(self):
        return terms("once")


def test_limits_are_not_tried_where_residuals_are_near_the_noise(linear):
    fits = Fits(linear)
    near = lambda *of: replace(fits.attempt(*of), above=1.9)  # noqa: E731
    grown(near, lambda trial: trial.stats, WithLimit(TABLE), [np.zeros(6)], lambda trial, present: [np.zeros(6)])
    assert not any("once" in names for names in fits.tried)


def test_limits_are_tried_once_no_other_term_helps(linear):
    fits = Fits(linear)
    limited = lambda trial, present: [np.zeros(6)]  # noqa: E731
    grown(fits.attempt, lambda trial: trial.stats, WithLimit(TABLE), [np.zeros(6)], limited)
    first = fits.tried.index(("real", "once"))
    assert ("once",) not in fits.tried[:first]
    assert ("real",) in fits.tried[:first]


def test_steps_are_least_squares_without_the_part(linear):
    step = linear.stats.step(TABLE, np.array([True, False, True]), np.arange(PARTS) == 2)
    rest = np.delete(np.arange(PARTS), 2)
    free = [0, 1, 2, 5]
    w = np.linalg.lstsq(linear.X[rest].reshape(-1, 6)[:, free], linear.y[rest].reshape(-1), rcond=None)[0]
    np.testing.assert_allclose((linear.stats.x + step)[free], w, rtol=1e-8)
    np.testing.assert_allclose((linear.stats.x + step)[[3, 4]], 0.0, atol=1e-12)


def test_a_table_knows_its_terms():
    assert TABLE.terms == ("real", "idle", "once")
    fewer = TABLE.with_terms(["real"])
    assert fewer.terms == ("real",)
    assert [p.name for p in fewer if not p.free] == ["d", "e", "f"]
    assert fewer["f"].nominal == 0.5
    with pytest.raises(UsageError, match="unknown term 'gone'"):
        TABLE.with_terms(["gone"])
    present = TABLE.of_terms(np.array([True, False, False]))
    assert present.tolist() == [n in "abc" for n in TABLE.names]
    values = TABLE.decode(np.ones(6), present)
    assert [round(float(values[n]), 3) for n in "def"] == [0.0, 0.0, 0.5]
    assert float(values["c"]) == pytest.approx(float(TABLE.decode(np.ones(6))["c"])) != 0.0
    with pytest.raises(UsageError, match="its value without a term"):
        row("g", off=1.0)


def test_a_model_that_other_recordings_would_choose_is_kept_with_how_often(linear):
    found = select(Fits(linear).grown())
    assert found.weight.sum() == pytest.approx(1.0)
    assert found.weight[0] > 0.5, "what all parts need"
    assert all(t.present[0] for t in found.near), "without it all parts are worse"
    assert len({t.present.tobytes() for t in found.near}) == len(found.near)


def test_a_term_that_half_of_the_parts_need_is_open(linear):
    X, rng = linear.X, np.random.default_rng(0)
    y = X @ np.array([1.0, -2.0, 0.0, 0.0, 0.0, 0.5]) + NOISE * rng.normal(size=(PARTS, ROWS))
    y[:3] += 0.1 * X[:3, :, 2]
    found = select(Fits(SimpleNamespace(X=X, y=y, stats=None)).grown())
    with_it = sum(w for t, w in zip(found.near, found.weight, strict=True) if t.present[0])
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


def trial(names, ahead, free=None):
    errors = np.array(ahead, float), np.array(ahead if free is None else free, float)
    return Trial(terms(*names), np.zeros(6), 0.0, None, (), *errors)


ONE, TWO, ALL = ("real",), ("real", "once"), ("real", "idle", "once")


@pytest.mark.parametrize(
    ("two", "every", "chosen"),
    [
        # Mean squares on three parts; without terms it is 9, with one term 4.
        (([2, 2, 2],), ([1, 1, 1],), ALL),
        (([4, 4, 4],), ([4, 4, 4],), ONE),  # equal
        (([3.9, 3.9, 3.9],), ([3.8, 3.8, 3.8],), ONE),  # better by less than five percent
        (([1.1, 0.9, 1.1],), ([2, 0.4, 0.5],), TWO),  # within a standard error of the best
        (([100, 100, 100],), ([400, 1, 400],), ONE),  # refits that ended anywhere
        (([np.nan, 1, 1],), ([np.inf, 1, 1],), ONE),  # refits that diverged
        # Up to the horizon the largest is best; in a free run it is far off, and a smaller one is not.
        (([2, 2, 2], [100, 100, 100]), ([1, 1, 1], [100, 100, 100]), ONE),
        (([2, 2, 2], [4, 4, 4]), ([1, 1, 1], [np.inf, 4, 4]), TWO),
    ],
)
def test_the_smallest_of_equal_sets_is_chosen_and_none_that_a_subset_beats(two, every, chosen):
    trials = [trial((), [9, 9, 9]), trial(ONE, [4, 4, 4]), trial(TWO, *two), trial(ALL, *every)]
    found = select(trials)
    assert found.names(TABLE) == selected(trials).names(TABLE) == chosen
    assert found.weight.sum() == pytest.approx(1.0)


def test_a_subset_that_is_far_better_wins_whatever_the_order():
    trials = [
        trial(ALL, [4, 4, 4]),
        trial(("idle",), [400, 400, 400]),
        trial((), [900, 900, 900]),
        trial(ONE, [0.04] * 3),
    ]
    assert selected(trials).names(TABLE) == selected(trials[::-1]).names(TABLE) == ONE


def test_a_set_with_the_loss_of_a_smaller_one_has_its_errors(linear):
    """Without refits its errors would be those of linear steps, which may be smaller by chance."""
    fits = Fits(linear)
    usual = fits.attempt
    with_real = usual(terms("real"), [np.zeros(6)], np.inf)

    def attempt(present, starts, most):
        trial = usual(present, starts, most)
        if trial.names(TABLE) == ("real", "idle"):
            return replace(trial, loss=with_real.loss, ahead=0.1 * trial.ahead)
        return trial

    trials = grown(attempt, lambda trial: trial.stats, TABLE, [np.zeros(6)])
    assert select(trials).names(TABLE) == ("real",)
