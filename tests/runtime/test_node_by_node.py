"""OpenLoopGraph: node by node it computes what CompiledGraph computes row by row."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contractions import Contraction
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from oracles import topologies
from oracles.hash_nodes import Value, jax_hash_node

from sim2real.errors import UsageError
from sim2real.graph import BaseWorld, Timeline, TrainableDist
from sim2real.graph.node import TICKS_PER_S, Jitter, Scheduling
from sim2real.graph.rules import consumer
from sim2real.graph.schedule import draw
from sim2real.graph.windows import make_room
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.runtime.compiled.open_loop import OpenLoopGraph
from sim2real.runtime.compiled.wiring import wire
from sim2real.runtime.init import OUTPUTS

KEY = jax.random.key(0)
DURATION_S, EPISODES = 0.4, 2
RATES = [20.0, 30.0, 50.0, 64.0, 100.0]
NAMES = ["command", "other", "world", "filter", "sensor"]
"""Senders before readers; the first two are given."""
COMPUTED = NAMES[2:]


class Seer(Contraction):
    """A contraction whose output shows every entry of its windows: which, when it was sent and when it came."""

    def step(self, step_state):
        seen = jnp.float32(0.0)
        for k, (_, w) in enumerate(sorted(step_state.inputs.items())):
            weight = jnp.cos(1.0 + k + jnp.arange(w.seq.shape[0], dtype=jnp.float32))
            ages = (step_state.ts - w.ts_recv) + 0.3 * (step_state.ts - w.ts_sent)
            seen += jnp.sum(weight * (w.data.x + jnp.clip(ages, -9.0, 9.0) + 0.01 * w.seq))
        state = 0.5 * step_state.state + jnp.tanh(seen) + 0.1 * jnp.sin(1.3 * step_state.seq)
        return step_state.replace(state=state), Value(x=jnp.sin(state) + step_state.ts)


class SeeingWorld(Seer, BaseWorld):
    """The same on a world's grid."""


def seer(name, rate, world, **options):
    return SeeingWorld(name, rate) if world else Seer(name, rate, **options)


seconds = st.integers(0, 300).map(lambda n: n * 1e-4)


@st.composite
def trainable(draw_, interps):
    low = draw_(seconds)
    high = low + draw_(st.integers(10, 300)) * 1e-4
    share = draw_(st.sampled_from([0.0, 0.37, 0.5, 1.0]))
    return TrainableDist.create(low + share * (high - low), low, high, draw_(st.sampled_from(interps)))


@st.composite
def graphs(draw_, make, of_world=("zoh",), of_others=("zoh",)):
    """Nodes that hear each other in one direction: the sensor the world, and others at random."""
    nodes = {}
    for name in NAMES:
        world = name == "world"
        options = {} if world else {"delay_dist": draw_(seconds), "scheduling": draw_(st.sampled_from(Scheduling))}
        nodes[name] = make(name, draw_(st.sampled_from([50.0, 100.0, 125.0] if world else RATES)), world, **options)
    for i, reader in enumerate(COMPUTED, 2):
        for sender in NAMES[:i]:
            if (sender, reader) not in (("command", "world"), ("world", "sensor")) and not draw_(st.booleans()):
                continue
            interps = of_world if reader == "world" else of_others
            dist = draw_(trainable(interps) if draw_(st.booleans()) else seconds)
            mean = isinstance(dist, TrainableDist) and dist.interp == "zoh_mean"
            nodes[reader].connect(
                nodes[sender],
                window=1 if mean else draw_(st.integers(1, 3)),
                skip=draw_(st.booleans()),
                jitter=Jitter.LATEST if isinstance(dist, TrainableDist) else draw_(st.sampled_from(Jitter)),
                delay_dist=dist,
            )
    lengths = draw_(st.tuples(*[st.sampled_from([1.0, 0.8, 0.5])] * EPISODES))
    seed = draw_(st.integers(0, 1000))
    return nodes, shortened(nodes, draw(nodes, DURATION_S, EPISODES, seed), lengths), seed


def shortened(nodes, timeline, lengths):
    """Return the timeline with episodes that end earlier, each at a share of the duration."""
    ends = DURATION_S * TICKS_PER_S * np.array(lengths)[:, None]
    vertices = {
        n: replace(v, count=np.minimum(v.count, (v.start < ends).sum(axis=1))) for n, v in timeline.vertices.items()
    }
    edges = {
        (n, i): replace(e, seq_in=consumer(nodes[n].inputs[i], e.received, vertices[n], vertices[e.sender]))
        for (n, i), e in timeline.edges.items()
    }
    return Timeline(vertices, edges)


def both(nodes, timeline, given, defaults):
    """Return the computed nodes' outputs by ``CompiledGraph``, an array an episode, and by ``OpenLoopGraph``."""
    for name, messages in given.items():  # here its node sends what is given there
        rows = jnp.asarray(messages.x)
        nodes[name].step = lambda s, rows=rows: (s, Value(x=rows[s.eps, s.seq]))
    compiled = CompiledGraph(nodes, "sensor", timeline)
    due = due_steps(compiled)

    def rolled(eps):
        gs = compiled.init(KEY, eps=eps)
        held = {n: (d,) * len(gs.buffer[n]) for n, d in defaults.items() if n in gs.buffer}
        return compiled.rollout(gs.replace(buffer={**gs.buffer, **held}), record=tuple(COMPUTED))[1]

    rows, each = jax.jit(jax.vmap(rolled))(jnp.arange(EPISODES)), {}
    for name, record in rows.items():
        seq = np.asarray(record.seq)
        each[name] = [np.asarray(record.output.x)[e][seq[e] >= 0] for e in range(EPISODES)]
        assert all(s[s >= 0].tolist() == list(range(len(x))) for s, x in zip(seq, each[name], strict=True))
        assert ([len(x) for x in each[name]] >= due[name]).all(), name
    graph = OpenLoopGraph(nodes, "sensor", given)
    tables = graph.tables(timeline, given)

    def run(eps, tables, given):
        gs = graph.begin({}, defaults, eps)
        made = {n: graph.run(gs, tables, given, n).x for n in COMPUTED}
        ticks = graph.drive(gs, tables, given, nodes["world"].step)  # as physics outside of the program
        sent = jax.tree.map(lambda first, rest: jnp.append(first, rest), gs.aux[OUTPUTS]["world"], ticks)
        return made, {"world": ticks.x, "sensor": graph.run(gs, tables, given, "sensor", {"world": sent}).x}

    made, driven = jax.jit(jax.vmap(run))(jnp.arange(EPISODES), tables, given)
    for name, x in driven.items():
        close(x, made[name]) if x.dtype == jnp.float32 else np.testing.assert_array_equal(x, made[name])
    for name in COMPUTED:
        assert (tables[name]["seq"] >= 0).sum(axis=1).tolist() == timeline.vertices[name].count.tolist()
    return each, {n: np.asarray(x) for n, x in made.items()}


def due_steps(graph):
    """Return how many steps of each node have to run: a step that nobody hears may be two periods of the sensor late.

    A compiled graph ends with the shortest episode, at the end of a row.
    """
    world, report = graph.nodes["world"], graph.report()
    late = 2 * np.ceil(world.rate / graph.nodes["sensor"].rate) + report["ticks_per_row"]
    last_s = (report["rows"] * report["ticks_per_row"] - late) / world.rate
    made = {n: (v.start < last_s * TICKS_PER_S).sum(axis=1) for n, v in graph.timeline.vertices.items()}
    return {n: np.minimum(c, graph.timeline.vertices[n].count) for n, c in made.items()}


def random_messages(rng, timeline, names, integers):
    shape = lambda n: timeline.vertices[n].start.shape  # noqa: E731
    if integers:
        return {n: Value(x=rng.integers(0, 2**32, shape(n), dtype=np.uint32)) for n in names}
    return {n: Value(x=rng.normal(size=shape(n)).astype(np.float32)) for n in names}


def check(case, held, same):
    nodes, timeline, seed = case
    make_room(nodes, timeline)
    rng = np.random.default_rng(seed)
    integers = nodes["world"].init_output(KEY, None).x.dtype == jnp.uint32
    given = random_messages(rng, timeline, NAMES[:2], integers)
    first = {"command": jax.tree.map(lambda rows: jnp.asarray(rows[0, 0]), given["command"])} if held else {}
    each, made = both(nodes, timeline, given, first)
    for name in COMPUTED:
        for e, rolled in enumerate(each[name]):
            count = min(len(rolled), timeline.vertices[name].count[e])
            same(made[name][e, :count], rolled[:count])


# Each example compiles two programs: to shrink one that fails would take minutes.
PHASES = [Phase.explicit, Phase.reuse, Phase.generate]


@pytest.mark.night
def test_hashes_of_all_that_is_heard_are_equal():
    @settings(max_examples=8, derandomize=True, phases=PHASES)
    @given(graphs(jax_hash_node), st.booleans())
    def equal(case, held):
        check(case, held, np.testing.assert_array_equal)

    equal()


def close(a, b):
    np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-6)


def by_hand():
    """Return one such graph for the gate: means over a tick, and lines between messages in a window of three."""
    rates = zip(NAMES, (40.0, 30.0, 100.0, 50.0, 30.0), strict=True)
    nodes = {n: seer(n, rate, n == "world", **({} if n == "world" else {"delay_dist": 0.003})) for n, rate in rates}
    late = {i: TrainableDist.create(0.013, 0.0, 0.05, i) for i in ("zoh", "zoh_mean", "linear")}
    nodes["world"].connect(nodes["command"], skip=True, delay_dist=late["zoh_mean"])
    nodes["filter"].connect(nodes["other"], delay_dist=late["zoh"])
    nodes["sensor"].connect(nodes["world"], window=3, delay_dist=late["linear"])
    nodes["sensor"].connect(nodes["filter"])
    return nodes


def test_outputs_are_equal():
    nodes = by_hand()
    check((nodes, shortened(nodes, draw(nodes, DURATION_S, EPISODES), [1.0, 0.8]), 0), True, close)


@pytest.mark.night
def test_outputs_are_equal_at_delays_of_every_interpolation():
    @settings(max_examples=14, derandomize=True, phases=PHASES)
    @given(
        graphs(seer, ("zoh", "linear", "zoh_mean"), ("zoh", "linear")),
        st.booleans(),
    )
    def equal(case, held):
        check(case, held, close)

    equal()


def test_the_program_holds_no_time():
    """One program runs any timeline of as many steps."""
    nodes = {"world": seer("world", 50.0, True), "sensor": seer("sensor", 50.0, False, delay_dist=0.003)}
    nodes["sensor"].connect(nodes["world"], delay_dist=0.004)
    graph, texts, outputs = OpenLoopGraph(nodes, "sensor", ()), [], []
    for seed, late in ((0, 0), (1, 2500)):
        timeline = draw(nodes, DURATION_S, 1, seed)
        moved = {n: replace(v, start=v.start + late, end=v.end + late) for n, v in timeline.vertices.items()}
        tables = jax.tree.map(lambda rows: rows[0], graph.tables(Timeline(moved, timeline.edges), {}))
        program = jax.jit(lambda t: graph.run(graph.begin({}, {}, 0), t, {}, "sensor")).lower(tables)
        texts.append(program.as_text())
        outputs.append(np.asarray(program.compile()(tables).x))
    assert texts[0] == texts[1]
    assert np.abs(outputs[0] - outputs[1]).max() > 1e-3


def test_a_shorter_episode_has_no_messages_of_steps_that_are_not_made():
    """It ends within the last tick of the world, which averages over the commands that arrive before the tick ends."""
    world, command = SeeingWorld("world", 50.0), Seer("command", 100.0)
    world.connect(command, delay_dist=TrainableDist.create(0.0, 0.0, 0.01, "zoh_mean"), skip=True)
    nodes, given = {"command": command, "world": world}, {"command": Value(x=np.zeros((1, 40), np.float32))}
    whole = draw(nodes, DURATION_S)
    short = shortened(nodes, whole, [0.385 / DURATION_S])
    graph = OpenLoopGraph(nodes, "world", given)
    assert graph.tables(short, given)["world"]["inputs"]["command"]["seq"][0, -1, -1] == 38
    assert wire(nodes, "world", short).world_table.inputs["command"].seq[0, -1, -1, -1] == 38
    contradiction = Timeline(short.vertices, whole.edges)
    with pytest.raises(UsageError, match="consumes messages of steps that 'command'"):
        graph.tables(contradiction, given)
    with pytest.raises(UsageError, match="does not make"):
        CompiledGraph(nodes, "world", contradiction)


def test_a_loop_among_computed_nodes_is_refused_and_given_outputs_open_it():
    nodes, _ = topologies.robot(jax_hash_node)
    with pytest.raises(UsageError, match=r"read each other's messages in a loop: \w+ -> \w+") as error:
        OpenLoopGraph(nodes, "sensor", ())
    assert all(n in str(error.value) for n in ("world", "sensor", "policy", "actuator"))
    assert "give the recorded outputs of one of them" in (error.value.hint or "")
    opened = OpenLoopGraph(nodes, "sensor", ("actuator",))
    assert opened.order.index("world") < opened.order.index("sensor") < opened.order.index("policy")
    assert opened.world == "world"
    with pytest.raises(UsageError, match="'command' is not given"):
        OpenLoopGraph(by_hand(), "sensor", ("other",)).drive(None, None, ("other",), None)


def test_what_is_not_computed_cannot_be_recorded():
    nodes, _ = topologies.robot(jax_hash_node)
    timeline = draw(nodes, DURATION_S)
    given = random_messages(np.random.default_rng(0), timeline, ["actuator"], integers=True)
    graph = OpenLoopGraph(nodes, "sensor", given)
    one = lambda tree: jax.tree.map(lambda rows: jnp.asarray(rows[0]), tree)  # noqa: E731
    for name in ("actuator", "nobody"):
        with pytest.raises(UsageError, match=f"no node '{name}' runs that could be recorded"):
            graph.run(graph.begin({}, {}, 0), one(graph.tables(timeline, given)), one(given), name)
    with pytest.raises(UsageError, match=r"'actuator'.x have shape \(1, 3\)"):
        graph.tables(timeline, {"actuator": Value(x=np.zeros((1, 3), np.uint32))})
