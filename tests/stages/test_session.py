"""What a session watches for, and how it judges itself afterwards."""

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
    watch = session.Watch(recorder)
    watch.start(5, 7)
    fine = {"range_m": np.inf, "flag": True, "n": np.int64(3), "image": np.zeros((2, 2), np.uint8)}
    watch.step(step(0), {"th": np.zeros(np.shape(bad)), "count": 3, **fine})
    watch.message(MessageRecord("agent", "sensor", 0, 0, 1, 2))
    with pytest.raises(SafetyStop, match="node 'sensor' stopped: its output 'th' is NaN in step 1"):
        watch.step(step(1), {"th": bad, "count": 3, **fine})
    episode = recorder.episode()
    assert len(episode.steps["sensor"]) == 2
    assert len(episode.messages["agent", "sensor"]) == 1
    assert watch.monotonic_ns == 7


def node(overruns, steps=200):
    return {"steps": steps, "overruns": overruns}


def test_deadlines():
    session.check_deadlines({"timing": {"a": node(2), "b": node(0, 0)}})
    with pytest.raises(DeadlineExceeded, match="b 3 of 200") as caught:
        session.check_deadlines({"timing": {"a": node(2), "b": node(3)}})
    assert caught.value.exit_code == 5
    assert "a 2" not in str(caught.value)
