"""Each recording by itself: as if it were the only one."""

import numpy as np
import pytest
from test_folds import BIAS, CONFIG, LENGTH_S, Model, lag_log, spans

from sim2real.identify.fit import fit
from sim2real.identify.uncertainty.per_recording import identify_each


def test_each_recording_says_what_it_says_alone(repetitions):
    episodes = [lag_log(1), lag_log(2, 2 * BIAS)]
    whole = fit(Model(), episodes, [*spans(0), *spans(1)], LENGTH_S, CONFIG)
    each = list(zip(episodes, identify_each(whole), strict=True))
    for episode, (values, spread) in each[-repetitions(1, 2) :]:
        alone = fit(Model(), [episode], spans(0), LENGTH_S, CONFIG)
        errors = alone.uncertainty().standard_error
        for name, error in zip(whole.problem.table.names, errors, strict=True):
            assert values[name] == pytest.approx(alone.values[name], abs=0.05 * error)
        np.testing.assert_allclose(spread.standard_error, errors, rtol=0.02)
