"""Each recording by itself: as if it were the only one."""

import numpy as np
import pytest
from test_folds import BIAS, CONFIG, LENGTH_S, Model, lag_log, spans

from sim2real.identify.fit import fit
from sim2real.identify.uncertainty import per_recording
from sim2real.identify.uncertainty.per_recording import identify_each


@pytest.mark.night
def test_each_recording_says_what_it_says_alone():
    episodes = [lag_log(1), lag_log(2, 2 * BIAS)]
    whole = fit(Model(), episodes, [*spans(0), *spans(1)], LENGTH_S, CONFIG)
    each = list(zip(episodes, identify_each(whole), strict=True))
    for episode, (values, spread) in each[-1:]:
        alone = fit(Model(), [episode], spans(0), LENGTH_S, CONFIG)
        errors = alone.uncertainty().standard_error
        for name, error in zip(whole.problem.table.names, errors, strict=True):
            assert values[name] == pytest.approx(alone.values[name], abs=0.05 * error)
        np.testing.assert_allclose(spread.standard_error, errors, rtol=0.02)


def test_the_errors_of_a_recording_are_computed_from_its_own_segments(monkeypatch):
    """With all segments for each recording, K recordings cost K^2 simulations."""
    episodes = [lag_log(1), lag_log(2, 2 * BIAS)]
    whole = fit(Model(), episodes, [*spans(0), *spans(1)], LENGTH_S, CONFIG)
    live, linearise = [], per_recording.linearise

    def counted(problem, z, data=None):
        live.append(int(np.sum(np.asarray((data or problem.data).weight))))
        return linearise(problem, z, data)

    monkeypatch.setattr(per_recording, "linearise", counted)
    identify_each(whole)
    assert live == [len(spans(0)) + len(spans(1)), len(spans(0)), len(spans(1))]


def test_each_of_many_recordings_takes_two_steps(monkeypatch):
    """As descents would, and without one: a descent for each of 120 recordings had not ended after minutes."""
    episodes = [lag_log(1), lag_log(2, 1.01 * BIAS), lag_log(3)]
    whole = fit(Model(), episodes, [span for r in range(3) for span in spans(r)], LENGTH_S, CONFIG)
    descents = identify_each(whole)
    monkeypatch.setattr(per_recording, "MOST", 2)
    monkeypatch.delattr(per_recording, "refine")
    for (values, spread), (expected, errors) in zip(identify_each(whole), descents, strict=True):
        for name, error in zip(whole.problem.table.names, errors.standard_error, strict=True):
            assert values[name] == pytest.approx(expected[name], abs=0.1 * error)
        np.testing.assert_allclose(spread.standard_error, errors.standard_error, rtol=0.1)
