"""CompiledGraph, in XLA: a dozen topologies against the simulated clock, and everything that one can do with it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from asynchronous_nodes import simulate
from jax.extend.core import jaxprs_in_params
from oracles import topologies
from oracles.hash_nodes import HashInPython, Value, hash_node, jax_hash_node

from sim2real.errors import UsageError
from sim2real.graph import BaseNode, BaseWorld, EmpiricalDist, Timeline, TrainableDist
from sim2real.graph.schedule import draw
from sim2real.graph.times import Vertex
from sim2real.graph.windows import bursty_episodes
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.compiled.graph import CompiledGraph

KEY = jax.random.key(0)
DURATION_S = 0.45


@pytest.fixture(scope="module")
def compiled():
    """Return graph and nodes of a topology, each built once; hash nodes on two episodes."""
    cache = {}

    def get(topology):
        if topology not in cache:
            nodes, supervisor = topology(jax_hash_node)
            cache[topology] = CompiledGraph(nodes, supervisor, draw(nodes, DURATION_S, 2, 7))
        return cache[topology]

    return get


FEW = (topologies.loop, topologies.unequal_rates, topologies.policy_with_hiccups)
"""Of the gate: a loop, rates that do not divide, several steps in a row. Each program compiles for seconds."""


def some_at_night(topologies_, *few):
    """Return rows of a parametrisation; those not among the few run at night."""
    return [pytest.param(t, marks=() if t in few else pytest.mark.night, id=t.__name__) for t in topologies_]


def rolled(graph, eps, record=None, params=None):
    record = tuple(graph.nodes) if record is None else record
    return graph.rollout(graph.init(KEY, params, eps=eps), record=record)


def by_seq(record):
    """Return what a node put out, by seq; every step once, in order."""
    seq = np.asarray(record.seq)
    ran = seq >= 0
    assert seq[ran].tolist() == list(range(ran.sum()))
    return jax.tree.map(lambda x: np.asarray(x)[ran], record.output)


@pytest.mark.parametrize("topology", some_at_night(topologies.ALL, *FEW))
def test_compiled_equals_simulated_bit_by_bit(topology, compiled):
    graph = compiled(topology)
    final, records = jax.jit(jax.vmap(lambda e: rolled(graph, e)))(np.arange(2))
    twins, supervisor = topology(hash_node)
    for eps in range(2):
        initial, episode = simulate(twins, supervisor, graph.timeline, eps)
        start = graph.init(KEY, eps=eps)
        assert {n: int(x) for n, x in start.state.items()} == {n: int(x) for n, x in initial.state.items()}
        for name in graph.nodes:
            got = by_seq(jax.tree.map(lambda x, eps=eps: x[eps], records[name])).x
            assert len(got) > (1 if name == supervisor else 3)
            np.testing.assert_array_equal(got, episode.outputs[name]["x"][: len(got)], err_msg=name)
    assert np.asarray(final.step).tolist() == [graph.rows] * 2


# reset and step


GYM = [topologies.robot, topologies.unequal_rates, topologies.policy_with_hiccups, topologies.slow_world,
       topologies.slow_supervisor]  # fmt: skip


@pytest.mark.parametrize("topology", some_at_night(GYM, topologies.slow_supervisor, topologies.slow_world))
def test_steps_show_what_the_supervisor_would_have_seen(topology, compiled):
    graph = compiled(topology)
    supervisor = graph.supervisor
    own = by_seq(rolled(graph, 1, (supervisor,))[1][supervisor]).x
    reset, step = jax.jit(graph.reset), jax.jit(graph.step)
    gs, ss = reset(graph.init(KEY, eps=1))
    seen = []
    for k in range(graph.steps - 1):
        assert int(ss.seq) == int(gs.seq[supervisor]) == k
        after, output = graph.nodes[supervisor].step(ss)  # the caller's step: here the node's own
        seen.append(int(output.x))
        gs, ss = step(gs, after, output)
    assert seen == own[: len(seen)].tolist()
    assert len(seen) >= 5
    own_way, _ = reset(graph.init(KEY, eps=1))
    for _ in range(3):
        own_way = jax.jit(graph.run)(own_way)
    third = graph.init(KEY, eps=1)
    third, ss = reset(third)
    for _ in range(3):
        third, ss = step(third, *graph.nodes[supervisor].step(ss))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), own_way.state, third.state))


def test_a_caller_may_give_any_output(compiled):
    graph = compiled(topologies.pair)
    gs, ss = graph.reset(graph.init(KEY))
    for _ in range(2):
        gs, ss = jax.jit(graph.step)(gs, ss.replace(state=jnp.uint32(5)), Value(x=jnp.uint32(42)))
    assert int(gs.state["policy"]) == 5
    assert int(gs.buffer["policy"][-1].x) == 42
    for output, words in (
        (Value(x=jnp.zeros(2, jnp.uint32)), r"\.x is uint32\[2\] instead of uint32\[\]"),
        (Value(x=jnp.float32(1)), r"\.x is float32\[\] instead of uint32\[\]"),
        (jnp.uint32(1), "instead of PyTreeDef"),
    ):
        with pytest.raises(UsageError, match=f"'policy': the output of step differs .*: .*{words}"):
            jax.eval_shape(lambda gs, ss, o=output: graph.step(gs, ss, o), gs, ss)


def test_observe_and_advance_are_the_same_row_by_row(compiled):
    graph = compiled(topologies.unequal_rates)

    def row(gs, _):
        gs, ss, acts = graph.observe(gs)
        return graph.advance(gs, *graph.nodes["policy"].step(ss)), acts

    by_row, acts = jax.jit(lambda: jax.lax.scan(row, graph.init(KEY), length=graph.rows))()
    at_once, _ = jax.jit(lambda: rolled(graph, 0, ()))()
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), by_row.state, at_once.state))
    assert 0 < int(acts.sum()) < graph.rows  # in some rows the policy makes no step


def test_a_step_is_as_large_a_program_as_a_row():
    """A policy far slower than its world: the rows between two of its steps are a loop."""
    nodes, supervisor = topologies.inner_loop(jax_hash_node)
    graph = CompiledGraph(nodes, supervisor, draw(nodes, 0.5))
    assert graph.report()["longest_gap"] >= 10
    gs = graph.init(KEY)
    row = equations(lambda s: graph.rollout(s, rows=1)[0], gs)
    assert equations(graph.step, jax.eval_shape(graph.reset, gs)[0]) < 1.5 * row


def equations(function, *arguments):
    """Return how many equations a program has, those in loops and calls counted once."""

    def count(jaxpr):
        return sum(1 + sum(count(j) for j in jaxprs_in_params(e.params)) for e in jaxpr.eqns)

    return count(jax.make_jaxpr(function)(*arguments).jaxpr)


def test_nothing_changes_behind_the_last_row(compiled):
    """Under ``jit`` where a state stands is not known before: an error cannot be raised, so it stays as it is."""
    graph = compiled(topologies.pair)
    roll = jax.jit(lambda s: graph.rollout(s, ("world", "policy")))
    end, _ = roll(graph.init(KEY, eps=1))
    after, records = roll(end)
    assert equal(after, end)
    assert all((np.asarray(r.seq) == -1).all() for r in records.values())
    row = jax.jit(lambda s: graph.advance(*graph.observe(s)[:2], Value(x=jnp.uint32(3))))
    assert equal(row(end), end)


EPISODES = np.array([1, -1, 2, 99, -(2**31), 2**31 - 1], np.int32)
"""Episodes of a timeline that has two: the first one exists."""


def rolls(graph, gs):
    return graph.rollout(gs, tuple(graph.nodes))


def steps(graph, gs):
    gs, first = graph.reset(gs)
    gs, second = graph.step(gs, first, Value(x=jnp.uint32(3)))
    return graph.run(gs).replace(seq={}), {"policy": jax.tree.map(lambda *x: jnp.stack(x), first, second)}


def observes(graph, gs):
    gs, ss, _ = graph.observe(gs)
    return graph.advance(gs, ss, Value(x=jnp.uint32(3))), {"policy": ss}


@pytest.mark.parametrize("way", [rolls, steps, observes])
def test_an_episode_that_does_not_exist_has_no_steps(way, compiled):
    """Traced, it cannot be an error; XLA would look up the last episode instead."""
    graph = compiled(topologies.pair)

    def run(eps):
        begin = graph.init(KEY, eps=eps)
        return begin, *way(graph, begin)

    begins, ends, records = jax.jit(jax.vmap(run))(EPISODES)
    for i, eps in enumerate(EPISODES):
        begin, end, made = jax.tree.map(lambda x, i=i: x[i], (begins, ends, records))
        assert all((np.asarray(r.seq) >= 0).any() == (eps == 1) for r in made.values())
        assert equal(end.replace(step=begin.step), begin) == (eps != 1)
    with pytest.raises(UsageError, match="no episode 2: the timeline has 2"):
        way(graph, graph.init(KEY).replace(eps=jnp.int32(2)))


def equal(a, b):
    return jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), a, b))


def test_a_rollout_in_parts_is_a_rollout(compiled):
    graph = compiled(topologies.pair)
    gs, first = graph.rollout(graph.init(KEY), ("world",), rows=5)
    gs, second = graph.rollout(gs, ("world",))
    whole = rolled(graph, 0, ("world",))[1]["world"].output.x
    np.testing.assert_array_equal(np.concatenate([first["world"].output.x, second["world"].output.x]), whole)
    with pytest.raises(UsageError, match=f"row {graph.rows} of {graph.rows}"):
        graph.rollout(gs)


def test_a_leaf_of_size_zero():
    """A message may have a list that is empty for this robot; with a trainable delay too."""

    class Sender(BaseWorld):
        def init_output(self, rng=None, graph_state=None):
            return {"x": jnp.float32(0.0), "none": jnp.zeros((0, 3))}

        def init_state(self, rng=None, graph_state=None):
            return jnp.zeros((2, 0))

        def step(self, step_state):
            return step_state, step_state.inputs["sender"][-1].data if step_state.inputs else self.init_output()

    sender, reader = Sender("sender", 50), Sender("reader", 25)
    reader.connect(sender, delay_dist=TrainableDist.create(0.02, 0.0, 0.05, "linear"), delay=0.0, window=2)
    nodes = {"sender": sender, "reader": reader}
    graph = CompiledGraph(nodes, "reader", draw(nodes, 0.2))
    output = jax.vmap(lambda key: graph.rollout(graph.init(key), ("reader",))[1])(jax.random.split(KEY, 3))[
        "reader"
    ].output
    assert output["none"].shape == (*output["x"].shape, 0, 3)
    assert output["x"].shape[0] == 3


def test_errors_instead_of_silence(compiled):
    graph = compiled(topologies.pair)
    gs = graph.init(KEY)
    for call in (graph.step, lambda s: graph.advance(s, None, None), jax.jit(graph.step)):
        with pytest.raises(UsageError, match=r"step of the supervisor 'policy' is due"):
            call(gs)
    awaiting, ss = jax.jit(graph.reset)(gs)
    step = jax.jit(graph.step)
    for call in (graph.reset, graph.rollout, graph.observe):
        with pytest.raises(UsageError, match="was called while a step"):
            call(awaiting)
    with pytest.raises(UsageError, match="row 3 of"):
        graph.reset(gs.replace(step=jnp.int32(3)))
    for _ in range(graph.steps - 1):
        awaiting, ss = step(awaiting, ss, Value(x=jnp.uint32(1)))
    with pytest.raises(UsageError, match=f"timeline ends after step {graph.steps - 1} of the supervisor 'policy'"):
        graph.step(awaiting, ss, Value(x=jnp.uint32(1)))
    ended, ss = step(awaiting, ss, Value(x=jnp.uint32(1)))  # traced: it cannot be seen, but is marked
    assert int(ss.seq) == -1
    assert int(ended.step) == graph.rows
    assert equal(step(ended, ss, Value(x=jnp.uint32(2)))[0], ended)
    with pytest.raises(UsageError, match="own timelines"):
        graph.with_data(graph.data).reset(gs)
    for rows in (0, graph.rows + 1):
        with pytest.raises(UsageError, match="rows are left"):
            graph.rollout(gs, rows=rows)
    with pytest.raises(UsageError, match="no node 'nobody' could be recorded"):
        graph.rollout(gs, ("nobody",))
    for eps in (-1, 2):
        with pytest.raises(UsageError, match=f"no episode {eps}: the timeline has 2"):
            graph.init(KEY, eps=eps)
    with pytest.raises(UsageError, match="makes up to 2 steps in a row"):
        compiled(topologies.slow_world).observe(compiled(topologies.slow_world).init(KEY))


def test_what_does_not_fit_is_refused():
    nodes, _ = topologies.robot(jax_hash_node)
    timeline = draw(nodes, DURATION_S)
    world = timeline.vertices["world"]
    empty = {**timeline.vertices, "world": Vertex(world.start, world.end, np.zeros(1, np.int64))}
    edges = {k: replace(e, seq_in=np.full_like(e.seq_in, -1)) for k, e in timeline.edges.items()}
    more, fewer = (topologies.robot(jax_hash_node)[0] for _ in range(2))
    more["policy"].connect(more["world"], name="more")
    del fewer["policy"].inputs["sensor"]
    short, none, plain = Ramp("a", 10), np.zeros((1, 0), np.int64), HashInPython("p", 10)
    for args, words in (
        ((nodes, "nobody", timeline), "supervisor 'nobody' is not in the timeline"),
        (
            ([n for n in nodes.values() if n.name != "world"], "policy", timeline),
            "holds node 'world', which was not given",
        ),
        (([*nodes.values(), nodes["world"]], "policy", timeline), "two nodes are called 'world'"),
        ((nodes, ["policy"], timeline), "the supervisor is one node, or its name"),
        ((nodes, None, timeline), "the supervisor is one node, or its name"),
        (
            (nodes, jax_hash_node("policy", 7, False), timeline),
            "supervisor .*rate=7.* is another object than the node of",
        ),
        ((more, "policy", timeline), "no messages for input 'more' of node 'policy'"),
        ((fewer, "policy", timeline), "which has no such input"),
        (([plain], "p", draw([plain], 1.0)), "'p' steps in plain Python"),
        ((nodes, "policy", Timeline(empty, edges)), "no tick of the world"),
        (([short], "a", Timeline({"a": Vertex(none, none, np.zeros(1, np.int64))}, {})), "shorter than one row"),
    ):
        with pytest.raises(UsageError, match=words):
            CompiledGraph(*args)
    world = CompiledGraph(nodes, "world", timeline)
    for call in (world.reset, world.observe, world.step):
        with pytest.raises(UsageError, match="supervisor 'world' is the world: it ticks in every row"):
            call(world.init(KEY))


# Trainable delays, derivatives, vmap


class Ramp(BaseNode):
    """Sends a wave."""

    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(0.3))

    def step(self, step_state):
        return step_state, Value(x=jnp.sin(0.7 * step_state.seq.astype(jnp.float32)))


class Lag(BaseWorld):
    """Follows what it hears; its parameter is the delay of its command [s]."""

    def init_params(self, rng=None, graph_state=None):
        return jnp.float32(0.017)

    def init_delays(self, rng=None, graph_state=None):
        return {"wave": graph_state.params[self.name]}

    def init_state(self, rng=None, graph_state=None):
        return jnp.float32(0.0)

    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(0.0))

    def step(self, step_state):
        x = 0.8 * step_state.state + 0.2 * step_state.inputs["wave"][-1].data.x
        return step_state.replace(state=x), Value(x=x)


class Follower(Ramp):
    """Hears the world."""

    def init_delays(self, rng=None, graph_state=None):
        return {"world": 0.4 * graph_state.params["world"]}

    def step(self, step_state):
        window = step_state.inputs["world"]
        age = jnp.sum(step_state.ts - window.ts_recv)  # shows in the output, as a policy might look at it
        return step_state, Value(x=jnp.sum(window.data.x * jnp.arange(1.0, window.seq.shape[0] + 1.0)) + 0.1 * age)


def delayed(to_world, to_sensor, window=1):
    wave, world, sensor = Ramp("wave", 50, delay_dist=0.003), Lag("world", 100), Follower("sensor", 50)
    world.connect(wave, skip=True, delay_dist=TrainableDist.create(0.01, 0.0, 0.04, to_world))
    sensor.connect(world, skip=True, window=window, delay_dist=TrainableDist.create(0.005, 0.001, 0.03, to_sensor))
    return {n.name: n for n in (wave, world, sensor)}


@pytest.mark.parametrize(("to_world", "to_sensor"), [("zoh", "zoh"), ("zoh_mean", "linear")])
def test_trainable_delays_agree_with_the_simulated_clock(to_world, to_sensor):
    nodes = delayed(to_world, to_sensor, window=2)
    timeline = draw(nodes, DURATION_S)
    graph = CompiledGraph(nodes, "sensor", timeline)
    records = jax.jit(lambda: rolled(graph, 0)[1])()
    _, episode = simulate(nodes, "sensor", timeline)
    for name in nodes:
        got = by_seq(records[name]).x
        np.testing.assert_allclose(got, episode.outputs[name]["x"][: len(got)], rtol=2e-6, atol=2e-6, err_msg=name)


@pytest.fixture(scope="module")
def trained():
    nodes = delayed("zoh_mean", "linear")
    graph = CompiledGraph(nodes, "sensor", draw(nodes, DURATION_S, 3))

    def loss(delay, key=KEY, eps=0):
        gs = graph.init(key, {"world": delay}, eps=eps)
        return jnp.mean(graph.rollout(gs, ("sensor",))[1]["sensor"].output.x ** 2)

    return graph, loss


def test_gradient_through_a_rollout(trained):
    _, loss = trained
    value = jax.jit(loss)
    slope = float(jax.jit(jax.grad(loss))(jnp.float32(0.0153)))
    finite = (float(value(jnp.float32(0.0163))) - float(value(jnp.float32(0.0143)))) / 0.002
    assert slope == pytest.approx(finite, rel=0.03)
    assert abs(slope) > 0.1


def test_vmap_over_parameters_seeds_and_timelines(trained):
    _, loss = trained
    delays, keys, eps = jnp.array([0.01, 0.02, 0.03]), jax.random.split(KEY, 3), jnp.arange(3)
    together = jax.jit(jax.vmap(loss))(delays, keys, eps)
    one = jax.jit(loss)
    np.testing.assert_allclose(together, [one(*a) for a in zip(delays, keys, eps, strict=True)], rtol=1e-5)
    assert len(set(np.asarray(together).tolist())) == 3


def test_a_burst_that_the_window_does_not_hold_is_an_error():
    nodes = delayed("zoh", "zoh")
    nodes["wave"].delay_dist = EmpiricalDist([0.001] * 9 + [0.055], block=10)  # then three steps back to back
    nodes["wave"].scheduling = type(nodes["wave"].scheduling).PHASE
    timeline = draw(nodes, 1.0, 4, 1)
    assert bursty_episodes(nodes, timeline).all()
    with pytest.raises(UsageError, match=r"input 'wave' of node 'world': messages of 'wave' come in bursts") as error:
        CompiledGraph(nodes, "sensor", timeline)
    assert "bursty_episodes" in (error.value.hint or "")
    simulated = AsyncGraph(nodes, nodes["sensor"], Clock.SIMULATED, timeline=timeline)
    with pytest.raises(UsageError, match="come in bursts"):
        simulated.start(simulated.init(KEY))
    assert not bursty_episodes(nodes, draw(delayed("zoh", "zoh"), 1.0, 2)).any()
    nodes["world"].inputs["wave"].delay_dist = TrainableDist.create(0.01, 0.0, 0.04, "zoh", burst=3)
    assert nodes["world"].inputs["wave"].total_window == 1 + 2 + 3


# The report


def test_the_report(compiled):
    graph = compiled(topologies.unequal_rates)
    report = graph.report()
    # A policy step every 4.2 ticks; what it sees and what it touches lie so close together that rows have three ticks.
    assert (report["rows"], report["ticks_per_row"]) == (19, 3)
    assert sorted(report["slots"]) == ["actuator", "policy", "sensor"]
    assert (report["supervisor_slots"], report["longest_gap"]) == (1, 2)
    assert 0.2 < report["discarded"] < 0.35
    assert report["supervisor_steps"] == graph.steps
    assert report["bursts"]["policy/sensor"] == {"burst": 1, "window": 2}
    assert report["bursts"]["sensor/world"]["burst"] == 5  # 125 Hz into 30 Hz
    # Four hash states, four keys of 8 bytes, the rings, eps and step.
    rings = sum(report["rings"].values())
    assert report["bytes_per_copy"] == 4 * 4 + 4 * 8 + 4 * rings + 2 * 4
    assert compiled(topologies.slow_world).report()["supervisor_slots"] == 2
    # Outputs of nodes that nobody waits for never touch the world, but what they read would have to be kept for them.
    assert max(compiled(topologies.open_loop).report()["rings"].values()) < 20
