"""Segments: how far and how fast joints move in them, and how few sizes they have."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.graph.episode import Episode, Steps
from sim2real.identification.model import Channel
from sim2real.identification.segments import Span, extents, padded, rounded


def recording(reach, rad_s=10.0):
    at = np.arange(200) * 10_000
    steps = Steps(at, at, at, np.full(200, -1), at, 0 * at)
    position = np.stack([reach * np.sin(rad_s * at / 1e6), 0.3 + 0.0 * at], axis=1)
    return Episode(steps={"sensor": steps}, messages={}, outputs={"sensor": {"position": position}})


def test_extents_are_of_the_segments_alone_and_of_each_joint():
    channels = tuple(Channel("position", None, 0.01, 0.1, i) for i in range(2))
    model, logs = SimpleNamespace(sensor="sensor", channels=channels), [recording(1.0), recording(0.5, 40.0)]
    found = extents(model, logs, [Span(0, 0.0), Span(1, 0.5)], 0.9)
    assert found["position[0]"] == pytest.approx((-1.0, 1.0, 16.8), rel=0.05)  # 20 rad/s, averaged over 50 ms
    assert found["position[1]"] == pytest.approx((0.3, 0.3, 0.0))
    assert extents(model, logs, [Span(0, 0.0)], 0.1)["position[0]"] == pytest.approx((0.0, 0.84, 9.6), rel=0.05)
    assert extents(model, logs, [Span(0, 9.0)], 0.9) == {}


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
