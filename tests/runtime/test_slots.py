"""Which slots a row has: tables alone, nothing is compiled."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.hash_nodes import hash_node, jax_hash_node, random_graph

from sim2real.errors import UsageError
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.runtime.compiled.wiring import wire

RATES = [(100, 100, 50, 50), (200, 200, 50, 50), (500, 100, 50, 50), (200, 100, 50, 50), (500, 500, 100, 100)]
"""Of world, sensor, agent and actuator [Hz]."""


def robot(rates, shares, blocking=(), make=hash_node):
    """World, sensor, agent and actuator; delays as shares of periods, so that nobody overruns."""
    world, sensor, agent, actuator = (
        make(n, rate, n == "world", **({} if n == "world" else {"delay_dist": share / rate}))
        for n, rate, share in zip(("world", "sensor", "agent", "actuator"), rates, (0.0, *shares[:3]), strict=True)
    )
    sensor.connect(world, delay_dist=shares[3] / rates[0])
    agent.connect(sensor, blocking="agent" in blocking, window=2, delay_dist=shares[4] / rates[1])
    actuator.connect(agent, blocking="actuator" in blocking, delay_dist=shares[5] / rates[2])
    world.connect(actuator, skip=True, delay_dist=shares[6] / rates[0])
    return {n.name: n for n in (world, sensor, agent, actuator)}


def steps_in_a_row(wiring, name):
    """Return the most steps that a node makes in one row."""
    made = [t.seq >= 0 for t, n in zip(wiring.tables, wiring.slots, strict=True) if n == name]
    return int(np.sum(made, axis=0).max())


def test_such_a_robot_can_be_trained_row_by_row():
    twins = robot(RATES[0], [0.1, 0.1, 0.05, 0.1, 0.1, 0.05, 0.2], make=jax_hash_node)
    graph = CompiledGraph(twins, "agent", draw(twins, 1.0))
    gs, step_state, acts = jax.eval_shape(lambda: graph.observe(graph.init(jax.random.key(0))))
    assert (acts.shape, step_state.seq.shape, set(gs.seq)) == ((), (), {"agent"})


@pytest.mark.parametrize("rates", RATES, ids=str)
def test_the_first_rows_of_an_episode_cost_no_slots(rates):
    """A sensor's first step comes alone and later ones in pairs: the policy behind them has one slot all the same."""
    for seed in range(4):
        shares = np.random.default_rng(seed).uniform(0.05, 0.45, 7)
        nodes = robot(rates, shares)
        wiring = wire(nodes, "agent", draw(nodes, 1.0))
        assert wiring.slots.count("agent") == wiring.slots.count("actuator") == 1
        assert wiring.slots.count("sensor") == steps_in_a_row(wiring, "sensor")


@settings(max_examples=60)
@given(
    st.sampled_from([50, 60, 100, 125, 200, 250, 500, 1000]),
    st.tuples(*[st.sampled_from([0.1, 0.2, 1 / 3, 0.4, 0.5, 0.6, 1.0])] * 3),
    st.lists(st.floats(0.0, 0.9), min_size=7, max_size=7),
    st.sets(st.sampled_from(["agent", "actuator"])),
)
def test_with_fixed_delays_the_policy_has_one_slot_at_any_rates(world_hz, ratios, shares, blocking):
    nodes = robot((world_hz, *(r * world_hz for r in ratios)), shares, blocking=blocking)
    assert wire(nodes, "agent", draw(nodes, 60 / (ratios[1] * world_hz))).slots.count("agent") == 1


@settings(max_examples=40)
@given(st.integers(0, 10**6))
def test_the_supervisor_has_as_many_slots_as_it_makes_steps_in_a_row(seed):
    nodes = random_graph(seed)
    wiring = wire(nodes, "n0", draw(nodes, 0.5, 2, seed))
    assert wiring.slots.count("n0") == steps_in_a_row(wiring, "n0")


def test_more_steps_in_a_row_than_anyone_can_compile_are_refused():
    fast, slow = hash_node("imu", 1000, False), hash_node("planner", 2, False)
    slow.connect(fast, window=5)
    nodes = {"imu": fast, "planner": slow}
    with pytest.raises(UsageError, match="'imu' makes more than 256 steps while the supervisor 'planner' makes one"):
        wire(nodes, "planner", draw(nodes, 2.0))
