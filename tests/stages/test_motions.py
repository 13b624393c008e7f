"""Motions that designs are made of."""

import numpy as np
import pytest

from sim2real.stages.motions import motions

LOW, HIGH = np.array([-1.0, -0.2]), np.array([0.5, 2.0])


def drawn(seed=0, slew_per_s=8.0):
    others = 3.0 * np.sin(np.arange(200) / 10)[None, :, None].repeat(2, axis=2)
    return motions(np.random.default_rng(seed), (40, 200), 50.0, (0.2, 5.0), (LOW, HIGH), slew_per_s, others)


@pytest.mark.parametrize("slew_per_s", [2.0, 8.0])
def test_they_stay_within_the_limits_and_begin_and_end_at_rest(slew_per_s):
    found = drawn(slew_per_s=slew_per_s)
    assert found.shape == (40, 200, 2)
    assert (found >= LOW - 1e-12).all()
    assert (found <= HIGH + 1e-12).all()
    np.testing.assert_array_equal(found[:, [0, -1]], 0.0)
    assert np.abs(np.diff(found, axis=1)).max() <= slew_per_s / 50.0 + 1e-12


def test_they_are_of_many_kinds_and_the_same_for_a_seed():
    found = drawn()
    reach = np.ptp(found, axis=1)
    assert (reach.max(axis=0) > 0.8 * (HIGH - LOW)).all()
    assert 0.05 < (reach == 0.0).mean() < 0.4, "some joints rest while the other moves"
    np.testing.assert_array_equal(found, drawn())
    assert np.corrcoef(found[0, :, 0], np.sin(np.arange(200) / 10))[0, 1] > 0.9, "the first is the one that was given"
    assert np.abs(found - drawn(seed=1)).max() > 0.5
