"""Timelines: stacking, and those of records."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.hash_nodes import random_graph

from sim2real.errors import UsageError
from sim2real.graph import BaseNode, Timeline
from sim2real.graph.episode import MemoryRecorder, MessageRecord, StepRecord
from sim2real.graph.schedule import draw
from sim2real.graph.times import NEVER, search_rows
from sim2real.identification.segments import cut_timeline


def same(a: Timeline, b: Timeline):
    assert set(a.vertices) == set(b.vertices)
    assert set(a.edges) == set(b.edges)
    for n, v in a.vertices.items():
        for f in ("start", "end", "count"):
            np.testing.assert_array_equal(getattr(v, f), getattr(b.vertices[n], f))
    for k, e in a.edges.items():
        assert e.sender == b.edges[k].sender
        np.testing.assert_array_equal(e.received, b.edges[k].received)
        np.testing.assert_array_equal(e.seq_in, b.edges[k].seq_in)


@settings(max_examples=200)
@given(st.data(), st.sampled_from(["left", "right"]))
def test_search_rows_is_searchsorted_in_each_row(data, side):
    episodes, n, m = (data.draw(st.integers(low, 6)) for low in (1, 0, 0))
    time = st.one_of(st.integers(-50, 50), st.just(int(NEVER)), st.integers(0, 2**40))
    rows = np.sort(np.array(data.draw(st.lists(time, min_size=episodes * n, max_size=episodes * n)), np.int64))
    rows = np.sort(rows.reshape(episodes, n), axis=1)
    values = np.array(data.draw(st.lists(time, min_size=episodes * m, max_size=episodes * m)), np.int64)
    values = values.reshape(episodes, m)
    found = search_rows(rows, values, side)
    for e in range(episodes):
        np.testing.assert_array_equal(found[e], np.searchsorted(rows[e], values[e], side=side))


def test_stack_pads_and_indexing_takes_apart():
    nodes = random_graph(4, size=3, worlds=1)
    short, long = draw(nodes, 0.3, rng=1), draw(nodes, 0.5, 2, rng=2)
    both = Timeline.stack([short, long])
    assert both.episodes == 3
    for n, v in both.vertices.items():
        assert v.count.tolist() == [*short.vertices[n].count, *long.vertices[n].count]
        assert (np.diff(v.start) >= 0).all()
        width = short.vertices[n].start.shape[1]
        np.testing.assert_array_equal(v.start[0, :width], short.vertices[n].start[0])
        assert (v.start[0, width:] == NEVER).all()
    same(Timeline.stack([both[:1], both[1:]]), both)
    same(both[[2, 1]][::-1], both[[1, 2]])
    with pytest.raises(UsageError, match="no timelines"):
        Timeline.stack([])
    with pytest.raises(UsageError, match="same nodes"):
        Timeline.stack([short, draw(chain(), 0.3)])


def chain():
    """50 Hz sensor, 50 Hz reader; the reader's step k takes message k, 6 ms after the sensor's start."""
    sensor, reader = BaseNode("s", 50, delay_dist=0.004), BaseNode("r", 50, delay_dist=0.001)
    reader.connect(sensor, delay_dist=0.002, window=2)
    return {"s": sensor, "r": reader}


def record(messages, steps=3):
    recorder = MemoryRecorder()
    for k in range(steps):
        for name, begin in (("s", 20_000 * k), ("r", 20_000 * k + 6_000)):
            recorder.step(StepRecord(name, k, begin, begin, begin, -1, begin + 1_000, 0), {"x": np.float32(k)})
    for seq_out, seq_in in messages:
        recorder.message(MessageRecord("r", "s", seq_out, seq_in, 20_000 * seq_out, 20_000 * seq_out + 6_000))
    return recorder.episode()


def test_a_record_becomes_a_timeline():
    timeline = Timeline.from_episode(record([(0, 0), (1, 1), (2, -1)]), chain())
    assert timeline.vertices["s"].start.tolist() == [[0, 20_000, 40_000]]
    assert timeline.edges["r", "s"].seq_in.tolist() == [[0, 1, -1]]


def test_a_damaged_record_still_has_one_message_a_step():
    edge = Timeline.from_episode(record([(0, 0), (2, 2), (5, 5)]), chain()).edges["r", "s"]
    assert edge.seq_in.tolist() == [[0, -1, -1]]  # 1 is lost, so 2 cannot have been read
    assert edge.received[0, 1] == NEVER
    edge = Timeline.from_episode(record([(0, 0), (1, 1), (2, 7)]), chain()).edges["r", "s"]
    assert edge.seq_in.tolist() == [[0, 1, -1]]  # the reader's step 7 is not in the record


def test_a_record_of_other_nodes_is_refused():
    with pytest.raises(UsageError, match=r"none of x\. Available: s, r"):
        Timeline.from_episode(record([]), {"x": BaseNode("x", 1)})


def test_segments_start_at_0_with_steps_numbered_from_0():
    timeline = draw(chain(), 1.0)
    parts, firsts = cut_timeline(timeline, [100_000, 305_000], 100_000, {})
    assert parts.episodes == 2
    assert (firsts["s"].tolist(), firsts["r"].tolist()) == ([5, 16], [5, 15])
    assert parts.vertices["s"].start[0, :5].tolist() == [0, 20_000, 40_000, 60_000, 80_000]
    assert parts.vertices["r"].start[1, 0] == 1_000
    assert parts.edges["r", "s"].seq_in[0].tolist() == [0, 1, 2, 3, 4]
    # The message of sensor step 15 was sent before the second segment: its reader's first step lacks it.
    assert parts.edges["r", "s"].seq_in[1].tolist() == [1, 2, 3, 4, -1]


def test_with_lead_the_first_step_of_a_segment_sees_what_came_before():
    parts, firsts = cut_timeline(draw(chain(), 1.0), [305_000], 100_000, {"s": 60_000})
    assert (firsts["s"].tolist(), firsts["r"].tolist()) == ([13], [15])
    assert parts.vertices["s"].start[0, 0] == -45_000
    assert parts.edges["r", "s"].seq_in[0, :5].tolist() == [0, 0, 0, 1, 2]
