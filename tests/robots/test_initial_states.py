"""Initial states of segments on C MuJoCo: joints of separate trees share rollouts, with the same derivatives."""

from types import SimpleNamespace

import jax.numpy as jnp
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


def test_a_point_is_evaluated_once(problem):
    z, asked = problem.table.start(), []
    states = problem.evaluator._initial
    errors = states._errors
    states._errors = lambda *given: (asked.append(1), errors(*given))[1]
    first = states.fitted(z, problem.evaluator._decoded(z[None], problem.data), problem.data)
    count = len(asked)
    assert states.fitted(z.copy(), {}, problem.data) is first
    assert len(asked) == count > 0


def test_a_search_is_of_the_segments_that_move_most(problem):
    evaluator, data = problem.evaluator, problem.data
    moved = np.zeros((20, data.ts.shape[1], 2))
    moved[7, 1:, 0], moved[3, 1:, 1], moved[11, 1:, 0] = 3.0, 2.0, 1.0
    recording = np.zeros(20, np.int32)
    recording[19] = 1
    many = data._replace(
        fitted=jnp.arange(20),
        weight=jnp.array([1.0] * 20).at[5].set(0.0),
        recording=jnp.asarray(recording),
        ts=jnp.zeros((20, data.ts.shape[1])),
        measured={**data.measured, "position": jnp.asarray(moved)},
    )
    picked = np.flatnonzero(evaluator.lively(many).weight).tolist()
    assert len(picked) == 8
    assert {19, 7, 3, 11} <= set(picked)  # the best of each recording, and those that move
    assert 5 not in picked
    few = data._replace(weight=jnp.ones(len(data.fitted)))
    assert np.all(evaluator.lively(few).weight == 1.0)


def test_a_descent_from_a_differentiated_point_needs_no_jacobian_of_its_own(problem, monkeypatch):
    evaluator, z, size = problem.evaluator, problem.table.start(), len(problem.table)
    known = evaluator.linearised(z, problem.data)
    present = np.arange(size) < size - 1
    rest = problem.part([0], present)
    rolled_out, raw = [], evaluator._raw
    monkeypatch.setattr(evaluator, "_raw", lambda y, *given: (rolled_out.append(len(y)), raw(y, *given))[1])
    # Without a segment and a parameter: their rows and columns are 0, the others those of the point.
    J = evaluator.around(z, rest)[1](z)
    assert rolled_out == [1]
    kept = (np.asarray(rest.weight) > 0.0)[:, None, None, None] & present
    expected = np.where(kept, known.jacobian, 0.0).reshape(-1, size)
    np.testing.assert_array_equal(J[: len(expected)], expected)
    # A point that was differentiated without them is no base for a descent with them.
    evaluator._last = [(z, rest, known)]
    evaluator.around(z, problem.data)[1](z)
    groups = evaluator._together.groups(np.asarray(problem.data.present))
    assert rolled_out == [1, 1, 1 + len(groups)]  # the friction of both trees shares a rollout
    assert len(groups) == size - 1


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
