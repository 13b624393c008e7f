"""Initial states of segments on C MuJoCo: joints of separate trees share rollouts, with the same derivatives."""

import numpy as np
import pytest
from small_robot import VALUES
from test_engines import MAX_DELAY_S, SEGMENT_S, converged_robot, pair_log

from sim2real.identification.config import FitConfig
from sim2real.identification.problem import Problem
from sim2real.identification.segments import Span


@pytest.fixture(scope="module")
def problem():
    config = FitConfig(max_delay_s=MAX_DELAY_S, initial_state="free", engine="c")
    spans = [Span(0, begin) for begin in (0.2, 0.3, 0.5, 0.55)]
    return Problem(converged_robot().identifiable(MAX_DELAY_S), [pair_log()], spans, SEGMENT_S, config)


@pytest.mark.night
def test_trees_share_rollouts_with_the_same_derivatives(problem, monkeypatch):
    residuals, rolled_out = problem.residuals, []
    errors = residuals.errors
    monkeypatch.setattr(residuals, "errors", lambda *args: rolled_out.append(len(args[1])) or errors(*args))
    values = {p.name: np.full(2, VALUES.get(p.name, p.nominal)) for p in problem.table}
    ask = lambda: residuals._slopes(values, np.array([0, 2]), np.full((2, 4), 0.1))  # noqa: E731
    alone, at = ask()
    together, again = ask()
    assert sorted(residuals._state_groups.members(range(4))) == [[0, 1], [2, 3]]  # both positions, both velocities
    assert rolled_out == [2 * (1 + 2 * 4), 2 * (1 + 2 * 2)]
    assert np.abs(alone).max() > 1.0
    np.testing.assert_allclose(together, alone, atol=1e-4 * np.abs(alone).max())
    np.testing.assert_array_equal(at, again)
