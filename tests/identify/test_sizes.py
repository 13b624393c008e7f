"""Sizes of programs: counts rounded up by little, to few sizes."""

import numpy as np
import pytest

from sim2real.identification.segments import padded, rounded


@pytest.mark.parametrize("steps", [1, 4, 8])
def test_counts_are_rounded_up_by_a_share_at_most_to_few_sizes_in_their_order(steps):
    counts = np.array([*range(1, 3000), 10**6])
    sizes = np.array([rounded(int(n), steps) for n in counts])
    assert (counts <= sizes).all()
    assert (sizes <= (1.0 + 1.0 / steps) * counts).all()
    assert (np.diff(sizes) >= 0).all()
    assert [rounded(int(n), steps) for n in sizes] == sizes.tolist()
    assert len(set(sizes[1024:2048])) == steps
    assert [rounded(n) for n in range(1, 13)] == [1, 2, 3, 4, 5, 6, 7, 8, 10, 10, 12, 12]


@pytest.mark.parametrize(("axis", "shape", "whole"), [(0, (2, 3), (5, 3)), (1, (3, 2), (3, 5))])
def test_what_is_padded_repeats_the_last_entry(axis, shape, whole):
    tree = {"one": np.arange(6.0).reshape(shape), "other": (np.arange(6).reshape(shape),)}
    made = padded(tree, 5, axis)
    for leaf, own in ((made["one"], tree["one"]), (made["other"][0], tree["other"][0])):
        assert (leaf.shape, leaf.dtype) == (whole, own.dtype)
        np.testing.assert_array_equal(np.take(leaf, [0, 1], axis), own)
        np.testing.assert_array_equal(np.take(leaf, [2, 4], axis), np.take(own, [1, 1], axis))
