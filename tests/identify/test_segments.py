"""Segments: what held-out data does that fitted data did not."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.graph.episode import Episode, Steps
from sim2real.identification.model import Channel
from sim2real.identification.segments import Span, beyond, ranges

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


def both(logs):
    """The ranges of fitted and of held-out segments."""
    return [ranges(MODEL, logs, [s for s in SPANS if s.fitted == fitted], 0.9) for fitted in (True, False)]


def test_a_gain_in_between_is_no_extrapolation():
    logs = [recording(100.0, 1.0), recording(800.0, 1.0), recording(200.0, 1.0)]
    assert beyond(*both(logs)) == []


@pytest.mark.parametrize(
    ("kp", "reach", "words"),
    [(800.0, 1.0, ["'kp' of 'actuator' reaches [800, 800], fitted was [100, 200]"]),
     (150.0, 1.5, ["'goal[0]' of 'actuator' reaches [-1.5, 1.5]", "'position' of 'sensor' reaches",
                      "the speed of 'position' of 'sensor' reaches"])],
)  # fmt: skip
def test_what_goes_beyond_is_named(kp, reach, words):
    logs = [recording(100.0, 1.0), recording(200.0, 1.0), recording(kp, reach)]
    said = beyond(*both(logs))
    assert len(said) == len(words)
    assert all(any(w in s for s in said) for w in words)


def test_with_nothing_held_out_nothing_is_said():
    assert beyond(ranges(MODEL, [recording(1.0, 1.0)], [Span(0, 0.0)], 0.5), {}) == []


def test_a_faster_motion_within_the_same_range_goes_beyond():
    slow, fast = recording(1.0, 1.0), recording(1.0, 1.0)
    at = fast.steps["sensor"].begun_s
    fast.outputs["sensor"]["position"] = 0.9 * np.sin(2e1 * at)
    (said,) = beyond(ranges(MODEL, [slow], [Span(0, 0.0)], 0.9), ranges(MODEL, [fast], [Span(0, 0.0)], 0.9))
    assert said.startswith("the speed of 'position' of 'sensor' reaches [-1")
