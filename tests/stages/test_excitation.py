"""Command signals for recording."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.stages.config import RecordConfig
from sim2real.stages.session.excitation import excitation


def test_frequencies_beyond_the_rate_are_refused():
    with pytest.raises(UsageError, match="above half the command rate"):
        excitation(RecordConfig(high_hz=26.0), 50.0)


@pytest.mark.parametrize("kind", ["multisine", "chirp", "steps"])
def test_several_commands_are_independent_and_each_keeps_to_the_limits(kind):
    config = RecordConfig(excitation=kind, duration_s=30.0, amplitude=1.5, low_hz=0.7, high_hz=2.0, seed=3)
    signals = excitation(config, 50.0, commands=3)
    assert signals.shape == (1500, 3)
    np.testing.assert_array_equal(signals[0], np.zeros(3))
    ramp = 1.5 * np.minimum(1.0, np.arange(1500) / 25.0)
    assert (np.abs(signals) <= ramp[:, None] + 1e-12).all()
    assert (np.abs(signals).max(axis=0) > 1.3).all()
    power, hz = np.abs(np.fft.rfft(signals[:, 0])) ** 2, np.fft.rfftfreq(1500, 0.02)
    if kind != "steps":  # steps have edges
        assert power[(hz > 0.4) & (hz < 2.5)].sum() > 0.9 * power.sum()
    assert np.abs(signals - excitation(replace(config, seed=4), 50.0, commands=3)).max() > 0.5
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(signals[:, one] - signals[:, other]).max() > 0.5
        if kind != "chirp":  # two sweeps differ by a phase alone
            assert abs(np.corrcoef(signals[:, one], signals[:, other])[0, 1]) < 0.5
    np.testing.assert_array_equal(signals[:, 0], excitation(config, 50.0), "the first is what one command gets")
    np.testing.assert_array_equal(signals, excitation(config, 50.0, commands=3))
