"""Initial states of segments on C MuJoCo: joints of separate trees share rollouts, with the same derivatives."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_robot import VALUES
from test_engines import MAX_DELAY_S, SEGMENT_S, converged_robot, pair_log

from sim2real.identify.config import FitConfig
from sim2real.identify.problem.initial_states import separated
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span


@pytest.fixture(scope="module")
def problem():
    config = FitConfig(max_delay_s=MAX_DELAY_S, initial_state="free", engine="c")
    spans = [Span(0, begin) for begin in (0.2, 0.3, 0.5, 0.55)]
    return Problem(converged_robot().identifiable(MAX_DELAY_S), [pair_log()], spans, SEGMENT_S, config)


@pytest.mark.night
def test_trees_share_rollouts_with_the_same_derivatives(problem):
    states, rolled_out = problem.evaluator._initial, []
    errors = states._errors
    states._errors = lambda values, eps, shift, data: (rolled_out.append(len(eps)), errors(values, eps, shift, data))[1]
    values = {p.name: np.full(2, VALUES.get(p.name, p.nominal), np.float32) for p in problem.table}
    ask = lambda: states._slopes(values, np.array([0, 2]), np.full((2, 4), 0.1), problem.data)  # noqa: E731
    alone, at = ask()
    together, again = ask()
    assert sorted(states._groups) == [(0, 1), (2, 3)]  # both positions, both velocities
    assert rolled_out == [2 * (1 + 2 * 4), 2 * (1 + 2 * 2)]
    assert np.abs(alone).max() > 1.0
    np.testing.assert_allclose(together, alone, atol=1e-4 * np.abs(alone).max())
    np.testing.assert_array_equal(at, again)


@pytest.mark.parametrize(
    "case",
    [
        # Two trees of two columns each; residuals 0 and 1 are of the first.
        SimpleNamespace(slope=[[1, 1, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 1, 3]], groups=[(0, 2), (1, 3)]),
        # A residual on which all depend: no column shares a rollout.
        SimpleNamespace(slope=[[1, 0], [1, 1], [0, 1]], groups=[(0,), (1,), (2,)]),
        # Nothing depends on the second column here; elsewhere anything may.
        SimpleNamespace(slope=[[1, 0], [0, 0], [0, 1]], groups=[(0, 2), (1,)]),
    ],
    ids=["trees", "coupled", "idle"],
)
def test_columns_are_moved_together_where_no_residual_depends_on_two(case):
    groups, own = separated(np.array(case.slope, float))
    assert groups == case.groups
    for group in groups:
        if len(group) > 1:
            assert np.all(own[list(group)].sum(axis=0) <= 1)
    assert np.all(own[np.array(case.slope) != 0])
