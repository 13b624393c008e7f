"""Segments of the last refinement: which configuration has them, and which samples they contain."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest

from sim2real.stages.estimation.segment_split import long_spans, with_length
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.robot_flags import MODEL_IDENTIFY

CONFIG = IdentifyConfig(initial_state="measured", held_out=0.25, long_s=5.0)


def lasting(*seconds):
    return [SimpleNamespace(duration_s=s) for s in seconds]


def test_they_contain_all_fitted_samples_of_each_fitted_log():
    spans = long_spans(lasting(24.8, 20.0, 30.0), 2, CONFIG)
    assert {s.recording for s in spans} == {0, 1}, "the third log is held out whole"
    for r, end in ((0, 18.6), (1, 15.0)):
        begins = [s.begin_s for s in spans if s.recording == r]
        assert begins[0] == 0.0
        assert begins[-1] + 5.0 == pytest.approx(end)
        assert all(later - begin <= 5.0 + 1e-9 for begin, later in pairwise(begins))
    assert len([s for s in spans if s.recording == 1]) == 3, "15 s are three segments without overlap"


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
