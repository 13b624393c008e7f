"""The timing rules against a second implementation, by the letter; what it does not draw, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.hash_nodes import random_graph
from oracles.reference import Reference

from sim2real.errors import UsageError
from sim2real.graph import BaseNode, BaseWorld, Timeline, TrainableDist
from sim2real.graph.rules import eligible, quota, slot
from sim2real.graph.schedule import draw
from sim2real.graph.times import NEVER, Vertex

MS = 1000


def ms(*values):
    return np.array([values]) * MS


def by_name(*nodes):
    return {n.name: n for n in nodes}


def test_a_loop_is_named():
    a, b, c = (BaseNode(n, 10) for n in "abc")
    a.connect(b)
    b.connect(c)
    c.connect(a, name="other")
    with pytest.raises(UsageError, match=r"algebraic loop: a -> c -> b -> a|b -> a -> c -> b|c -> b -> a -> c") as e:
        _ = a.phase
    assert "skip=True" in (e.value.hint or "")


def test_slots_are_rounded_one_by_one_so_that_errors_do_not_add_up():
    node = BaseNode("a", 30)
    assert slot(node, np.arange(4)).tolist() == [0, 33_333, 66_667, 100_000]
    assert int(slot(node, 30 * 3600)) == 3_600_000_000
    # Halves go up, for rates too that are no divisors of a million: 3e6 / 384 = 7812.5.
    assert slot(BaseNode("b", 384), np.array([3, 9])).tolist() == [7813, 23438]


def test_advance_needs_a_blocking_input():
    sender, reader = BaseNode("s", 10), BaseNode("r", 10, advance=True)
    reader.connect(sender)
    with pytest.raises(UsageError, match="needs a blocking input"):
        draw(by_name(sender, reader), 1.0)


rates = st.one_of(st.sampled_from([1, 3, 7, 30, 48, 60, 64, 100, 384, 1000]), st.floats(0.5, 2000))


@settings(max_examples=300)
@given(rates, rates, st.floats(0, 0.2), st.floats(0, 0.2), st.booleans(), st.integers(0, 5000))
def test_quota_counts_slots(rate_out, rate_in, phase_out, delay, skip, k):
    source, sender, reader = BaseNode("x", 1), BaseNode("s", rate_out), BaseNode("r", rate_in)
    sender.connect(source, delay=phase_out)
    connection = reader.connect(sender, blocking=True, skip=skip, delay=delay)
    limit = int(slot(reader, k))
    upper = max(0, int((limit - int(slot(sender, 0))) / 1e6 * rate_out)) + 3
    slots = slot(sender, np.arange(max(0, upper - 12), upper))
    assert slots[-1] > limit  # and those before the first one here are all below it
    below = (slots < limit) if skip else (slots <= limit)
    expected = max(0, upper - 12) + int(below.sum())
    assert int(quota(connection, k)) == expected


def test_a_world_that_averages_takes_what_arrives_before_its_tick_ends():
    sender, world = BaseNode("s", 100), BaseWorld("w", 100)
    connection = world.connect(sender, skip=True, delay_dist=TrainableDist.create(0.0, 0.0, 0.01, "zoh_mean"))
    end = round(0.999e4)
    assert eligible(connection, np.array([0, end - 1, end])).tolist() == [1 - end, 0, 1]


def test_a_recorded_sender_that_stops_leaves_its_blocking_reader_without_a_step():
    sender, reader = BaseNode("s", 100), BaseNode("r", 100, delay_dist=0.001)
    reader.connect(sender, blocking=True)
    recorded = Timeline({"s": Vertex(ms(0, 10, 20), ms(1, 11, 21), np.array([3]))}, {})
    timeline = draw(by_name(sender, reader), 0.1, recorded=recorded)
    assert timeline.vertices["r"].count.tolist() == [3]
    assert (timeline.vertices["r"].start[0, :3] / MS).tolist() == [1, 11, 21]
    assert timeline.vertices["r"].start[0, 3] >= NEVER
    assert timeline.edges["r", "s"].seq_in[0].tolist() == [0, 1, 2]


def test_what_is_recorded_stays_and_the_rest_is_drawn():
    nodes = random_graph(3, size=3, worlds=1)
    full = draw(nodes, 0.5, episodes=2, rng=1)
    partly = Timeline(
        {n: v for n, v in full.vertices.items() if n in ("n0", "n1")},
        {k: e for k, e in full.edges.items() if k[0] in ("n0", "n1") and e.sender in ("n0", "n1")},
    )
    again = draw(nodes, 0.5, rng=2, recorded=partly)
    assert set(again.edges) == set(full.edges)
    for name in ("n0", "n1"):
        np.testing.assert_array_equal(again.vertices[name].start, full.vertices[name].start)


def test_too_short_a_duration_is_an_error():
    sender, reader = BaseNode("s", 10, delay=0.5), BaseNode("r", 10)
    reader.connect(sender)
    with pytest.raises(UsageError, match="'r' makes no step within"):
        draw(by_name(sender, reader), 0.3)


def test_the_same_seed_draws_the_same_and_episodes_differ():
    nodes = random_graph(11)
    a, b = draw(nodes, 0.4, 3, rng=5), draw(nodes, 0.4, 3, rng=5)
    for name, v in a.vertices.items():
        np.testing.assert_array_equal(v.end, b.vertices[name].end)
    assert any((v.end[0] != v.end[1]).any() for v in a.vertices.values())


@settings(max_examples=60)
@given(st.integers(0, 10**6))
def test_the_rules_by_the_letter_give_the_same_timeline(seed):
    nodes = random_graph(seed)
    timeline = draw(nodes, 0.4, 2, seed)
    for episode in range(2):
        reference = Reference(nodes, timeline, episode)
        for name, v in timeline.vertices.items():
            count = v.count[episode]
            assert v.start[episode, :count].tolist() == reference.starts[name][:count]
            assert v.end[episode, :count].tolist() == reference.ends[name][:count]
        for key, seq_in in reference.seq_in.items():
            assert timeline.edges[key].seq_in[episode][: len(seq_in)].tolist() == seq_in
