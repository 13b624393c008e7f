"""Sizes of programs: counts rounded up by little, to few sizes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sim2real.identification.segments import padded, rounded

counts, steps = st.integers(1, 10**6), st.sampled_from([1, 2, 4, 8])


@given(counts, steps)
def test_a_count_is_rounded_up_by_a_share_at_most(count, steps):
    assert count <= rounded(count, steps) <= (1.0 + 1.0 / steps) * count


@given(counts, counts, steps)
def test_more_is_never_rounded_to_less(one, other, steps):
    low, high = sorted((one, other))
    assert rounded(low, steps) <= rounded(high, steps)


@given(counts, steps)
def test_a_size_stays(count, steps):
    size = rounded(count, steps)
    assert rounded(size, steps) == size


@given(st.integers(4, 17), steps)
def test_there_are_few_sizes_between_powers_of_two(power, steps):
    assert len({rounded(n, steps) for n in range(2**power + 1, 2 ** (power + 1) + 1)}) == steps


def test_few_are_exact():
    assert [rounded(n) for n in range(1, 13)] == [1, 2, 3, 4, 5, 6, 7, 8, 10, 10, 12, 12]


@given(st.integers(1, 5), st.integers(0, 4), st.integers(0, 1))
def test_what_is_padded_repeats_the_last_entry(count, more, axis):
    rng = np.random.default_rng(count)
    shape = (count, 3) if axis == 0 else (3, count)
    tree = {"one": rng.normal(size=shape), "other": (rng.integers(0, 9, shape),)}
    made = padded(tree, count + more, axis)
    for leaf, own in ((made["one"], tree["one"]), (made["other"][0], tree["other"][0])):
        rows, old = np.moveaxis(leaf, axis, 0), np.moveaxis(own, axis, 0)
        assert leaf.dtype == own.dtype
        np.testing.assert_array_equal(rows[:count], old)
        np.testing.assert_array_equal(rows[count:], np.repeat(old[-1:], more, axis=0))
