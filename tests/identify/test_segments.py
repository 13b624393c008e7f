"""Segments: what held-out data does that fitted data did not."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.graph.episode import Episode, Steps
from sim2real.identify.model import Channel
from sim2real.identify.problem.segments import Span, beyond

MODEL = SimpleNamespace(
    sensor="sensor", given={"actuator": {"goal": "goal", "kp": "kp"}}, channels=(Channel("position", None, 0.01, 0.1),)
)


def recording(kp, reach):
    at = np.arange(100) * 10_000
    steps = Steps(at, at, at, np.full(100, -1), at, 0 * at)
    goal = reach * np.sin(at / 1e5)
    outputs = {
        "actuator": {"goal": np.stack([goal, 0 * goal], axis=1), "kp": np.full(100, kp)},
        "sensor": {"position": 0.9 * goal},
    }
    return Episode(steps={"sensor": steps, "actuator": steps}, messages={}, outputs=outputs)


SPANS = [Span(0, 0.0), Span(1, 0.0), Span(2, 0.0, False)]


def test_a_gain_in_between_is_no_extrapolation():
    logs = [recording(100.0, 1.0), recording(800.0, 1.0), recording(200.0, 1.0)]
    assert beyond(MODEL, logs, SPANS, 0.9) == []


@pytest.mark.parametrize(
    ("kp", "reach", "words"),
    [(800.0, 1.0, ["'kp' of 'actuator' reaches [800, 800], fitted was [100, 200]"]),
     (150.0, 1.5, ["'goal[0]' of 'actuator' reaches [-1.5, 1.5]", "'position' of 'sensor'"])],
)  # fmt: skip
def test_what_goes_beyond_is_named(kp, reach, words):
    logs = [recording(100.0, 1.0), recording(200.0, 1.0), recording(kp, reach)]
    said = beyond(MODEL, logs, SPANS, 0.9)
    assert len(said) == len(words)
    assert all(w in s for w, s in zip(words, said, strict=True))


def test_with_nothing_held_out_nothing_is_said():
    assert beyond(MODEL, [recording(1.0, 1.0)], [Span(0, 0.0)], 0.5) == []
