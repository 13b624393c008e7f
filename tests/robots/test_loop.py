"""How late messages are: what is identified, what training draws, and the connections that must bear it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.graph import BaseNode, EmpiricalDist, Scheduling, TrainableDist
from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseWorld
from sim2real.graph.schedule import derive, draw
from sim2real.graph.windows import bursty_episodes, make_room, newest_message
from sim2real.identification.parameters import ParameterTable
from sim2real.robots.loop import (
    BURST,
    DELAYS,
    control_nodes,
    delay_bounds,
    delay_parameters,
    recorded_loop,
    simulated_loop,
    split_delay,
    split_drawn_delay,
)
from sim2real.robots.training import draw_values
from sim2real.worlds.recorded import DelayParams, delay_of

TICK_S, SPREAD_S, LEAD_S = 0.01, 0.002, 0.00125
VALUES = {"gain": 2.0, "damping": 0.3, "friction": 0.1, "sensor_delay": 0.013, "actuator_delay": 0.001}
DRAWS = {"gain": jnp.arange(10.0), "damping": 10.0 * jnp.arange(10.0)}
LATE = {"sensor_delay": np.array([0.010, 0.020, 0.004]), "actuator_delay": np.array([0.006, 0.003, 0.001])}
"""Samples of both delays [s]."""


@pytest.fixture
def nodes():
    return [*(BaseNode(name, 50.0) for name in ("sensor", "agent", "actuator")), BaseWorld("world", 1 / TICK_S)]


def many(draws, count):
    draw = jax.jit(jax.vmap(lambda key: draw_values(key, VALUES, draws)))
    return {name: np.asarray(v) for name, v in draw(jax.random.split(jax.random.key(0), count)).items()}


@pytest.fixture(scope="module")
def drawn():
    """Many episodes' parameters."""
    return many(DRAWS, 500)


def test_delays_to_identify_may_be_as_short_as_any_robots():
    sensor, actuator = delay_parameters(0.06)
    rows = [(p.name, p.low, p.high, p.nominal, p.free, p.side, p.leaf) for p in (sensor, actuator)]
    assert rows[0] == ("sensor_delay", 0.0, 0.06, 0.0, False, "measurement", "sensor.delay")
    assert rows[1] == ("actuator_delay", 0.0, 0.12, 0.0, True, "command", "actuator.delay")
    table = ParameterTable([sensor, actuator])
    for x in (-30.0, 0.0, 30.0):
        found = table.decode(table.within(np.full(1, x)))
        assert 0.0 <= float(found["actuator_delay"]) <= 0.12 * (1 + 1e-6)


@pytest.mark.parametrize(
    ("delays", "expected"),
    [
        ((0.0047, 0.0119), (0.012, 0.0046)),  # moved: a tick and the spread are for the sensor
        ((0.02, 0.025), (0.02, 0.025)),
        ((0.001, 0.002), (0.003, 0.0)),  # all that there is
    ],
)
def test_a_closed_loop_gets_the_round_trip_as_it_can_simulate_it(delays, expected):
    values = dict(zip(DELAYS, delays, strict=True)) | {"gain": 2.0}
    found = split_delay(values, TICK_S, SPREAD_S)
    assert [found[n] for n in DELAYS] == pytest.approx(expected)
    assert sum(found[n] for n in DELAYS) == pytest.approx(sum(delays))
    assert found["gain"] == 2.0
    assert split_delay({"gain": 2.0}, TICK_S, SPREAD_S) == {"gain": 2.0}


def test_a_delay_comes_from_the_nodes_parameters_where_they_have_one():
    gs = GraphState(params={"sensor": DelayParams(delay=0.02), "actuator": DelayParams(), "world": object()})
    assert delay_of("sensor", "world", gs) == {"world": 0.02}
    for name in ("actuator", "world", "nobody"):
        assert delay_of(name, "world", gs) == {}
    assert delay_of("sensor", "world", None) == {}


def test_delays_are_drawn_with_the_dynamics_and_their_sum_is_kept():
    found = split_drawn_delay(VALUES, {"gain": np.arange(3.0), **LATE}, TICK_S, SPREAD_S)
    np.testing.assert_allclose(found["sensor_delay"] + found["actuator_delay"], [0.016, 0.023, 0.005])
    # What the loop's sensor needs, as long as the sum has it.
    np.testing.assert_allclose(found["sensor_delay"], [0.013, 0.013, 0.005])
    np.testing.assert_array_equal(found["gain"], np.arange(3.0))
    rows = {n: jnp.asarray(v, jnp.float32) for n, v in found.items()}
    drawn = many(rows, 60)
    row = drawn["gain"].astype(int)
    for name in DELAYS:
        np.testing.assert_allclose(drawn[name], found[name][row], rtol=1e-6)
    assert split_drawn_delay(VALUES, {"gain": np.arange(3.0)}, TICK_S, SPREAD_S).keys() == {"gain"}


@pytest.mark.parametrize("draws", [{}, LATE])
def test_the_bounds_hold_whatever_is_drawn_and_interpolated(draws):
    bounds = delay_bounds(VALUES, TICK_S, SPREAD_S, LEAD_S, draws)
    for name, lead in zip(DELAYS, (0.0, LEAD_S), strict=True):
        value, low, high = bounds[name]
        assert value == pytest.approx(VALUES[name] + lead)
        assert 0.0 <= low < value < high
        used = np.append(draws.get(name, []), VALUES[name]) + lead
        assert low <= used.min()
        assert used.max() <= high
    assert bounds["sensor_delay"][1] == pytest.approx(0.0 if draws else 0.013 - TICK_S - SPREAD_S)
    assert bounds["actuator_delay"][1] == 0.0


def test_draws_of_unequal_length_use_rows_that_all_have():
    draws = {"gain": jnp.arange(3.0), "damping": jnp.arange(100.0)}
    drawn = many(draws, 60)
    np.testing.assert_array_equal(drawn["gain"], drawn["damping"])
    assert set(drawn["gain"].tolist()) == {0.0, 1.0, 2.0}


def test_the_loop_in_simulation_has_trainable_delays_at_the_world_alone(nodes):
    sensor, agent, actuator, world = nodes
    bounds = delay_bounds(VALUES, TICK_S, SPREAD_S, LEAD_S)
    found = simulated_loop(sensor, agent, actuator, world, bounds)
    assert list(found) == ["sensor", "agent", "actuator", "world"]
    assert [agent.inputs["sensor"].blocking, actuator.inputs["agent"].blocking] == [True, True]
    for connection, name, interp in (
        (world.inputs["actuator"], "actuator_delay", "zoh_mean"),
        (sensor.inputs["world"], "sensor_delay", "linear"),
    ):
        dist = connection.delay_dist
        assert (dist.min, dist.max, dist.interp) == (*bounds[name][1:], interp)
        assert float(dist.delay) == pytest.approx(bounds[name][0], rel=1e-5)
        assert connection.skip
        assert not connection.blocking


def test_a_recorded_loop_bears_every_delay_that_may_be_identified(nodes):
    sensor, _, actuator, world = nodes
    found = recorded_loop(sensor, actuator, world, 0.06, TICK_S, LEAD_S)
    assert list(found) == ["sensor", "actuator", "world"]
    assert (world.inputs["actuator"].delay_dist.min, world.inputs["actuator"].delay_dist.max) == (0.0, 0.12 + LEAD_S)
    # A tick more than the largest delay: the sensor's steps are simulated that much later.
    from_world = sensor.inputs["world"].delay_dist
    assert (from_world.min, from_world.max) == (0.0, pytest.approx(0.07))
    assert actuator.inputs == {}, "what it sent was recorded"


def ages(nodes, timeline, reader):
    """Return how old the newest message of each step of a reader is [ticks], ``(N,)``."""
    (name,) = nodes[reader].inputs
    edge, vertex = timeline.edges[reader, name], timeline.vertices[reader]
    age = vertex.start - np.take_along_axis(timeline.vertices[name].end, newest_message(edge, vertex), axis=1)
    return age[0, : vertex.count[0]]


def played(nodes, busy, steps=100):
    """Return the timeline of a loop whose steps take ``busy`` [ticks], by node ``(steps,)``."""
    delays = {name: np.asarray(busy[name])[None] for name in nodes}
    transfers = {(n, i): np.zeros((1, steps), np.int64) for n, node in nodes.items() for i in node.inputs}
    return derive(nodes, delays, transfers, 20_000 * steps)


@pytest.mark.parametrize("slow", ["sensor", "agent", "actuator"])
def test_after_a_hiccup_nobody_goes_on_with_old_data(nodes, slow):
    loop = control_nodes(*nodes[:3])
    busy = {name: np.full(100, 1000) for name in loop}
    busy[slow][30] = 100_000
    timeline = played(loop, busy)
    for reader in ("agent", "actuator"):
        before, after = ages(loop, timeline, reader)[:30], ages(loop, timeline, reader)[38:]
        assert after.max() <= before.max() == 0
    sampled = np.diff(timeline.vertices["sensor"].start[0])
    assert sampled.min() == 20_000, "no burst of samples"


def test_without_overruns_the_timelines_are_those_of_a_kept_frequency(nodes):
    rng = np.random.default_rng(0)
    loop = control_nodes(*nodes[:3])
    assert [n.scheduling for n in nodes[:3]] == [Scheduling.FREQUENCY, Scheduling.PHASE, Scheduling.PHASE]
    busy = {name: rng.integers(500, 6_000, 100) for name in loop}  # three in a row: less than a period
    found = played(loop, busy)
    for node in loop.values():
        node.scheduling = Scheduling.FREQUENCY
    kept = played(loop, busy)
    for name in loop:
        np.testing.assert_array_equal(found.vertices[name].start, kept.vertices[name].start)
    for key, edge in found.edges.items():
        np.testing.assert_array_equal(edge.seq_in, kept.edges[key].seq_in)


def test_a_recording_with_a_hiccup_fits_the_window_of_its_commands(nodes):
    """Commands that leave at once after a hiccup may be more than the loop expects: the window grows, nothing else."""
    sensor, _, actuator, world = nodes
    actuator.scheduling = Scheduling.PHASE
    found = recorded_loop(sensor, actuator, world, 0.06, TICK_S)
    calm = draw(found, 2.0)
    assert make_room(found, calm) == {}
    assert world.inputs["actuator"].delay_dist.burst == BURST
    busy = np.full(100, 0.001)
    busy[30] = 0.2
    actuator.delay_dist = EmpiricalDist(busy, block=100)
    hiccup = draw(found, 2.0)
    assert bursty_episodes(found, hiccup).all()
    grown = make_room(found, hiccup)
    assert set(grown) == {("world", "actuator")}
    assert not bursty_episodes(found, hiccup).any()
    dist = world.inputs["actuator"].delay_dist
    assert isinstance(dist, TrainableDist)
    assert dist.burst == BURST + grown["world", "actuator"] <= 10  # a hiccup of ten periods
