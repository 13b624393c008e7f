"""What a session watches for, and how it judges itself afterwards."""

import json

import numpy as np
import pytest

from sim2real.errors import DeadlineExceeded, SafetyStop
from sim2real.graph.episode import MemoryRecorder, MessageRecord, StepRecord
from sim2real.stages.session import episode as session


def step(seq, node="sensor"):
    return StepRecord(node, seq, 0, 0, 0, -1, 1, 0)


@pytest.mark.parametrize("bad", [np.float64("nan"), np.array([0.0, np.nan]), float("nan"), np.float32("nan")])
def test_a_nan_stops_the_graph_and_stands_in_the_log(bad):
    recorder = MemoryRecorder()
    watch = session.Watch(recorder, "actuator", "action")
    watch.start(5, 7)
    watch.step(step(0), {"th": np.zeros(np.shape(bad)), "count": 3})
    watch.message(MessageRecord("agent", "sensor", 0, 0, 1, 2))
    with pytest.raises(SafetyStop, match="node 'sensor' stopped: its output 'th' is NaN in step 1"):
        watch.step(step(1), {"th": bad, "count": 3})
    episode = recorder.episode()
    assert len(episode.steps["sensor"]) == 2
    assert len(episode.messages["agent", "sensor"]) == 1
    assert watch.monotonic_ns == 7


def test_infinity_and_other_types_are_none_of_its_business():
    watch = session.Watch(MemoryRecorder(), "actuator", "action")
    watch.step(step(0), {"range_m": np.inf, "flag": True, "n": np.int64(3), "image": np.zeros((2, 2), np.uint8)})


def test_commands_are_summarised_for_each_motor():
    watch = session.Watch(MemoryRecorder(), "actuator", "action")
    for seq, action in enumerate(([1.0, -2.0], [3.0, 0.5])):
        watch.step(step(seq, "actuator"), {"action": np.array(action, np.float32)})
        watch.step(step(seq), {"action": np.array([9.0, 9.0])})
    assert watch.commands == 2
    assert [x.tolist() for x in (watch.low, watch.total, watch.high)] == [[1.0, -2.0], [4.0, -1.5], [3.0, 0.5]]


def node(overruns, steps=200, **ages):
    times = {"period_s": [0.02, 0.021, None], "lateness_s": [None] * 3, "age_s": ages}
    return {"steps": steps, "overruns": overruns, **times}


def test_deadlines():
    session.check_deadlines({"timing": {"a": node(2), "b": node(0, 0)}})
    with pytest.raises(DeadlineExceeded, match="b 3 of 200") as caught:
        session.check_deadlines({"timing": {"a": node(2), "b": node(3)}})
    assert caught.value.exit_code == 5
    assert "a 2" not in str(caught.value)


def test_timing_tables_have_gaps_where_a_node_never_stepped():
    rows, headers = session.timing_rows({"timing": {"a": node(1), "b": node(0, x=[0.1, 0.2, 0.3], y=[0.0, 0.25, 0.3])}})
    assert rows[0] == ["a", 200, 20.0, 21.0, *[None] * 7, 1]
    assert rows[1][8:] == [100.0, 250.0, 300.0, 0], "of the inputs, the older one"
    assert len(headers) == len(rows[0])
    bus = {"transactions": 9, "late_replies": 2, "late_s": [0.001, 0.002, None]}
    assert session.timing_rows({"timing": {}, **bus})[0] == [
        ["answers", 9, *[None] * 3, 1.0, 2.0, None, *[None] * 3, 2]
    ]
    assert session._numbers([1.0, float("nan")]) == [1.0, None]
    json.dumps(rows, allow_nan=False)
