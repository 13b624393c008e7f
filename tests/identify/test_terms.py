"""Terms are chosen on held-out parts: what helps there, and nothing else."""

from types import SimpleNamespace

import numpy as np
import pytest
from lag import BIAS, CONFIG, LENGTH_S, Model, lag_log, spans

from sim2real.identification.fit import fit
from sim2real.identification.held_out import folds_of
from sim2real.identification.residuals import Problem
from sim2real.identification.terms import Selection, TermSearch, Trial, gains


@pytest.fixture(scope="module")
def search():
    """The search of three logs' terms: their input has a bias and no square."""
    episodes = [lag_log(seed) for seed in (1, 2, 3)]
    whole = fit(Problem(Model(), episodes, [s for r in range(3) for s in spans(r)], LENGTH_S, CONFIG))
    return SimpleNamespace(
        fit=whole, table=whole.problem.table,
        search=TermSearch(whole, folds_of(whole.problem, 3), 0.2, 2.0),
    )  # fmt: skip


def test_the_term_that_the_logs_have_is_chosen_and_no_other(search):
    selection = search.search.select()
    chosen, table = selection.chosen, search.table
    assert chosen.names(table) == ("bias",)
    values = table.decode(chosen.x, table.of_terms(chosen.present))
    assert float(values["bias"]) == pytest.approx(BIAS, abs=0.005)
    assert float(values["square"]) == 0.0
    # The errors are those of refits, in which the part was held out.
    assert [r.name for r in chosen.rows] == ["recording 1", "recording 2", "recording 3"]
    assert all(float(r.values["square"]) == 0.0 for r in chosen.rows)
    assert chosen.error == pytest.approx(1.0, abs=0.15)
    assert chosen.above < 1.2
    rows = {r.name: r for r in gains(selection, table)}
    assert (rows["bias"].used, rows["square"].used) == (True, False)
    assert (rows["square"].gain or 0.0) < 0.1
    assert rows["bias"].gain > 0.5


def test_what_a_model_lacks_is_found_by_the_same_round(search):
    none = np.zeros(2, bool)
    selection = search.search.further(search.fit.x, none)
    assert selection.chosen.names(search.table) == ("bias",)
    assert selection.chosen.error < 0.5 * selection.trials[0].error
    rows = {r.name: r for r in gains(Selection(selection.trials[0], selection.trials), search.table)}
    assert not rows["bias"].used
    assert rows["bias"].gain > 0.5
    assert (rows["square"].gain or 0.0) < rows["bias"].gain
    with_bias = search.search.further(search.search.select().chosen.x, np.array([True, False]))
    assert with_bias.chosen is with_bias.trials[0]
    assert all((r.gain or 0.0) < 0.1 for r in gains(with_bias, search.table) if not r.used)


def trial(present, ahead, free=1.0):
    return Trial(np.array(present, bool), np.zeros(0), 1.0, (), np.full(3, ahead), np.full(3, free))


@pytest.mark.parametrize(
    ("ahead", "free", "better"),
    [(0.5, 1.0, True), (0.9, 1.0, False), (0.5, 4.0, False), (np.nan, 1.0, False), (0.5, np.nan, False)],
)
def test_a_set_is_better_by_a_tenth_ahead_if_its_free_runs_are_not_far_worse(ahead, free, better):
    assert trial([True], ahead, free).is_better_than(trial([False], 1.0)) == better


def test_the_gain_of_a_term_is_that_of_the_pair_nearest_to_the_chosen_set():
    sets = [trial([0, 0], 4.0), trial([1, 0], 1.0), trial([0, 1], 3.9), trial([1, 1], 0.99)]
    table = SimpleNamespace(terms=("load", "drag"), of_limits=lambda: np.zeros(2, bool))
    rows = {r.name: r for r in gains(Selection(sets[1], tuple(sets)), table)}
    assert (rows["load"].used, rows["load"].gain) == (True, 0.5)
    assert (rows["drag"].used, rows["drag"].gain) == (False, pytest.approx(0.005, abs=1e-3))
