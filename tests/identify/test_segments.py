"""Segments: how far and how fast joints move in them."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.graph.episode import Episode, Steps
from sim2real.identification.model import Channel
from sim2real.identification.segments import Span, extents


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
