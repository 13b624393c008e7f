"""Where segments begin: those of the last refinement, and held-out ones beside fitted ones."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2real.stages.config import MODEL_IDENTIFY
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.shared.identification import covering, long_spans, spans, split_of, usable, with_length

CONFIG = IdentifyConfig(initial_state="measured", held_out=0.25, long_s=5.0)


def lasting(*seconds):
    return [SimpleNamespace(duration_s=s) for s in seconds]


def test_they_contain_all_fitted_samples_of_each_fitted_log():
    longer = long_spans(lasting(24.9, 20.1, 30.0), 2, CONFIG)
    assert {s.recording for s in longer} == {0, 1}, "the third log is held out whole"
    for r, end in ((0, 18.6), (1, 15.0)):
        begins = [s.begin_s for s in longer if s.recording == r]
        assert begins[0] == 0.0
        assert begins[-1] + 5.0 == pytest.approx(end)
        assert all(later - begin <= 5.0 + 1e-9 for begin, later in pairwise(begins))
    assert len([s for s in longer if s.recording == 1]) == 3, "15 s are three segments without overlap"


@given(st.floats(8.0, 100.0), st.sampled_from(["measured", "free"]))
def test_fitted_and_held_out_segments_begin_on_one_grid(seconds, initial_state):
    config = replace(CONFIG, initial_state=initial_state, long_s=0.0)
    (episode,) = lasting(seconds)
    some = [*spans([episode], 1, config, 1.3), *long_spans([episode], 1, replace(config, long_s=5.0))]
    steps = [(s.begin_s - usable(episode, config)[0]) / 0.01 for s in some]
    assert steps == pytest.approx(np.round(steps), abs=1e-3)
    begin, end = usable(episode, config)
    earlier = begin + 0.75 * (end - begin) - split_of(episode, True, config)
    assert -1e-6 <= earlier < 0.1, "a rounding of the share below a multiple counts as the multiple"
    left = seconds - (0.2 if initial_state == "free" else 0.0) - end
    assert 0.05 - 1e-6 <= left < 0.15 + 1e-6


@given(st.integers(90, 1000), st.floats(-0.049, 0.049), st.floats(-0.049, 0.049), st.sampled_from(["measured", "free"]))
def test_logs_of_nearly_one_length_have_the_same_segments(tenths, one, other, initial_state):
    """So they share compiled programs, whose sizes are those of the segments and of the held-out part."""
    config = replace(CONFIG, initial_state=initial_state)
    a, b = lasting(tenths / 10 + one, tenths / 10 + other)
    assert spans([a], 1, config, 1.3) == spans([b], 1, config, 1.3)
    assert long_spans([a], 1, config) == long_spans([b], 1, config)
    assert (usable(a, config), split_of(a, True, config)) == (usable(b, config), split_of(b, True, config))


@given(st.floats(10.0, 200.0), st.integers(10, 80))
def test_long_segments_leave_nothing_out(end_s, tenths):
    longer = covering([(0.0, end_s)], length_s := tenths / 10)
    begins = [s.begin_s for s in longer]
    assert begins[0] == 0.0
    assert begins[-1] + length_s == pytest.approx(end_s)
    assert all(0.0 < later - begin <= length_s + 1e-6 for begin, later in pairwise(begins))


def test_a_log_shorter_than_two_segments_has_none():
    assert long_spans(lasting(6.0), 1, CONFIG) == []
    assert long_spans(lasting(24.8), 1, replace(CONFIG, long_s=0.0)) == []


@pytest.mark.parametrize(
    ("goal", "given", "expected"), [(None, None, 5.0), ("goal", None, 0.0), (None, 0.0, 0.0), ("goal", 7.0, 7.0)]
)
def test_a_robot_without_goals_gets_them_unless_the_flag_says_otherwise(goal, given, expected):
    model = SimpleNamespace(channels=(SimpleNamespace(goal=goal),))
    assert MODEL_IDENTIFY.long_s is None
    assert with_length(replace(MODEL_IDENTIFY, long_s=given), model).long_s == expected
