"""Timelines for training: what the robot's computer did, at its rate and at the same moments for all nodes."""

import numpy as np
import pytest

from sim2real.artifacts.timing import NodeTiming, Spread, Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.node import TICKS_PER_S, BaseNode, BaseWorld
from sim2real.graph.schedule import draw
from sim2real.robots.loop import delay_bounds, simulated_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.runtime.compiled.wiring import wire
from sim2real.training.environment.timelines import RecordedTiming, Stretches, draw_timelines

RATE_HZ, SECONDS, CALM_S = 50.0, 40, 0.001
COUNT = int(RATE_HZ * SECONDS)
NAMES = ("sensor", "agent", "actuator")


def recorded(every, long_s, pauses=True):
    """Return a recording in which sensor and agent take ``long_s`` at the same moments, ``every`` so many steps."""
    rng = np.random.default_rng(0)
    steps = {n: CALM_S * rng.uniform(0.9, 1.1, COUNT) for n in NAMES}
    for name in ("sensor", "agent"):
        steps[name][7::every] = long_s
    period = Spread.of(np.full(3, 1 / RATE_HZ))
    nodes = {n: NodeTiming(COUNT, period, period, Spread.of(s), {}) for n, s in steps.items()}
    transport = {"agent/sensor": np.full(COUNT, 2e-4), "actuator/agent": np.full(COUNT, np.nan)}
    return RecordedTiming.of(Timing(nodes, steps_s=steps, transport_s=transport), RATE_HZ, 0, pauses)


@pytest.fixture
def loop():
    """A function that makes the loop with the computation times of a recording."""

    def make(times, sensor_s=0.02, actuator_s=0.02):
        bounds = delay_bounds({"sensor_delay": sensor_s, "actuator_delay": actuator_s}, 0.01, 0.002)
        own = [BaseNode(n, RATE_HZ, delay=0.002, delay_dist=times.computation[n]) for n in NAMES]
        nodes = simulated_loop(*own, BaseWorld("world", 100.0), bounds)
        times.set_transport(nodes)
        return nodes

    return make


def computed(drawn, name):
    vertex = drawn.timeline.vertices[name]
    return (vertex.end - vertex.start) / TICKS_PER_S


def test_hiccups_keep_their_rate_and_hit_all_nodes_at_once(loop):
    times = recorded(25, 0.009)
    drawn = draw_timelines(loop(times), "agent", 5.0, 16, 3, times)
    sensor, agent = (computed(drawn, n) > 0.005 for n in ("sensor", "agent"))
    assert sensor.mean() == pytest.approx(1 / 25, rel=0.15)
    size = min(sensor.shape[1], agent.shape[1])
    np.testing.assert_array_equal(sensor[:, :size], agent[:, :size])
    assert (drawn.cut, drawn.redrawn) == (0, 0)
    assert drawn.longest_pause_s > 1.3 / RATE_HZ


def test_a_lost_period_is_played_and_not_cut(loop):
    times = recorded(200, 0.03)
    drawn = draw_timelines(loop(times), "agent", 5.0, 16, 3, times)
    assert drawn.cut == drawn.redrawn == 0
    assert drawn.longest_pause_s > 1.9 / RATE_HZ
    wiring = CompiledGraph(loop(times), "agent", drawn.timeline).wiring
    assert wiring.slots.count("agent") == 1


def test_an_episode_ends_before_a_pause_that_rows_do_not_hold(loop):
    times = recorded(300, 0.15)
    nodes = loop(times)
    drawn = draw_timelines(nodes, "agent", 5.0, 16, 3, times)
    whole = drawn.timeline.vertices["agent"].count
    assert 0 < drawn.cut == (drawn.steps < whole).sum() < 16
    assert drawn.redrawn > 0
    assert (drawn.steps >= whole // 2).all()
    assert computed(drawn, "sensor").max() < 0.15, "calm from the pause on"
    graph = CompiledGraph(nodes, "agent", drawn.timeline)
    assert graph.wiring.slots.count("agent") == 1
    last = graph.last_row(drawn.steps)
    assert (last[drawn.steps < whole] < last.max()).all()


def test_without_pauses_long_steps_are_left_out(loop):
    times = recorded(25, 0.03, pauses=False)
    drawn = draw_timelines(loop(times), "agent", 5.0, 4, 3, times)
    assert computed(drawn, "sensor").max() < 0.005
    assert drawn.longest_pause_s == pytest.approx(1 / RATE_HZ, rel=0.05)


def test_messages_are_as_late_as_they_were_and_phases_stay(loop):
    times = recorded(25, 0.002)
    nodes = loop(times)
    assert nodes["agent"].phase == pytest.approx(0.002)
    drawn = draw_timelines(nodes, "agent", 1.0, 2, 0, times)
    edge, sender = drawn.timeline.edges["agent", "sensor"], drawn.timeline.vertices["sensor"]
    np.testing.assert_array_equal(edge.received - sender.end, 200)
    assert ("actuator", "agent") not in times.transport, "nothing is known of it"


@pytest.mark.night
def test_a_computer_that_pauses_all_the_time_is_refused(loop):
    times = recorded(40, 0.2)
    with pytest.raises(Sim2RealError, match="nearly every timeline"):
        draw_timelines(loop(times), "agent", 5.0, 8, 0, times)
    with pytest.raises(Sim2RealError, match="took less than 5 ms"):
        recorded(1, 0.03)


def test_without_a_recording_timelines_are_as_the_nodes_say(loop):
    nodes = loop(recorded(25, 0.002))
    drawn = draw_timelines(nodes, "agent", 1.0, 2, 5, None)
    again = draw(nodes, 1.0, 2, 5)
    np.testing.assert_array_equal(drawn.timeline.vertices["agent"].start, again.vertices["agent"].start)
    np.testing.assert_array_equal(drawn.steps, again.vertices["agent"].count)


def test_longer_episodes_begin_like_shorter_ones():
    stretches = Stretches(4)
    np.testing.assert_array_equal(stretches.begins(3, 9)[:, :4], stretches.begins(3, 4))


def test_recordings_of_one_robot_have_rings_of_one_length(loop):
    """Whether the least delay is nothing or 0.2 ms: a program that is to serve both has room for both."""
    rings, times = [], recorded(25, 0.004)
    for delay_s in (0.012, 0.0122):
        nodes = loop(times, delay_s, 0.0104)
        timeline = draw_timelines(nodes, "agent", 1.0, 4, 3, times).timeline
        rings.append([wire(nodes, "agent", timeline, reusable=reusable).rings for reusable in (False, True)])
    (one, same), (other, again) = rings
    assert one != other
    assert same == again
