"""The simulated clock: determinism, trainable delays, the gym-like calls; what steps see is in tests/conformance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from asynchronous_nodes import Jitted, Plain, assert_rules_explain, simulate
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.hash_nodes import Value, random_graph

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph import BaseNode, BaseWorld, EmpiricalDist, Scheduling, Timeline, TrainableDist
from sim2real.graph.episode import MemoryRecorder
from sim2real.graph.schedule import draw
from sim2real.log.session import input_ages
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock


def record(nodes, supervisor, seed=0, **options):
    recorder = MemoryRecorder()
    graph = AsyncGraph(nodes, nodes[supervisor], Clock.SIMULATED, recorder=recorder, **options)
    graph.start(graph.init(jax.random.key(seed)))
    assert graph.wait(timeout_s=60)
    graph.stop()
    return recorder.episode(), graph


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_a_log_derived_again_gives_its_own_timeline(seed):
    nodes = random_graph(seed)
    assert_rules_explain(simulate(nodes, "n0", draw(nodes, 0.4, 1, seed))[1], nodes)


def chain(cls=Jitted, **options):
    world, agent = cls("world", 100, delay_dist=0.002), cls("agent", 50, delay_dist=0.004)
    agent.connect(world, window=2, delay_dist=0.001, **options)
    world.connect(agent, skip=True)
    return {"world": world, "agent": agent}


def same_trees(a, b):
    equal = jax.tree.map(lambda x, y: bool(np.array_equal(np.asarray(x), np.asarray(y))), a, b)
    return all(jax.tree.leaves(equal))


def test_the_same_seed_gives_the_same_episode():
    def one(seed):
        episode, _ = record(random_graph(3), "n0", seed=seed, duration_s=0.5)
        columns = {n: {f: getattr(s, f) for f in s.__dataclass_fields__} for n, s in episode.steps.items()}
        messages = {k: {f: getattr(m, f) for f in m.__dataclass_fields__} for k, m in episode.messages.items()}
        return columns, messages, episode.outputs

    first, second, other = one(1), one(1), one(2)
    assert same_trees(first, second)
    assert not all(np.array_equal(first[0][n]["end"], other[0][n]["end"]) for n in first[0])


def test_gym_calls_see_what_the_supervisor_would_have_seen():
    own, _ = record(chain(), "agent", duration_s=0.5)
    recorder = MemoryRecorder()
    nodes = chain()
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, duration_s=0.5, recorder=recorder)
    gs, ss = graph.reset(graph.init(jax.random.key(0)))
    assert int(gs.step) == 0
    for k in range(20):
        assert int(ss.seq) == k
        gs, ss = graph.step(gs, ss.replace(state=ss.state + 1), Value(x=np.int32(ss.seq)))
        assert int(gs.step) == int(gs.state["agent"]) == k + 1
        assert int(ss.inputs["world"].seq[-1]) == int(gs.seq["world"]) - 1
    graph.stop()
    seen = recorder.episode()
    np.testing.assert_array_equal(seen.steps["agent"].start, own.steps["agent"].start[:20])
    seq_in = seen.messages["agent", "world"].seq_in
    np.testing.assert_array_equal(seq_in[seq_in >= 0], own.messages["agent", "world"].seq_in[: (seq_in >= 0).sum()])


def test_step_takes_a_changed_step_state_and_keeps_aux():
    nodes = chain()
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, duration_s=1)
    gs = graph.init(jax.random.key(0))
    gs, ss = graph.reset(gs.replace(aux={**gs.aux, "mine": 5}))
    gs, ss = graph.step(gs, ss.replace(state=jnp.int32(41)))  # the node makes the step itself, from this state
    assert int(gs.state["agent"]) == 42
    assert gs.aux["mine"] == 5
    gs = graph.run(gs)
    assert int(gs.state["agent"]) == 43
    gs = graph.run_for(0.2)
    assert int(gs.seq["agent"]) > 8


def test_a_wrong_output_is_refused_and_the_step_stays_on_offer_up_to_the_end():
    nodes = chain()
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, duration_s=0.1)
    gs = graph.init(jax.random.key(0))
    with pytest.raises(UsageError, match="reset"):
        graph.step(gs)
    gs, ss = graph.reset(gs)
    for wrong in (Value(x=np.zeros(2, np.int32)), Value(x=np.float32(0.5)), {"x": 1}):
        with pytest.raises(UsageError, match="'agent'"):
            graph.step(gs, ss, wrong)
    for k in range(1, 5):
        gs, ss = graph.step(gs, ss, Value(x=3))
        assert int(ss.seq) == k
    with pytest.raises(UsageError, match="timeline ends after step 4"):
        graph.step(gs, ss, Value(x=0))


def test_a_node_that_raises_is_named():
    class Breaks(Plain):
        def step(self, step_state):
            if step_state.seq == 3:
                raise KeyError("servo")
            return super().step(step_state)

    nodes = chain(Breaks)
    recorder = MemoryRecorder()
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, duration_s=1, recorder=recorder)
    gs = graph.init(jax.random.key(0))
    graph.start(gs)
    with pytest.raises(Sim2RealError, match=r"node 'world' failed in its step 3: KeyError") as caught:
        graph.run_for(1.0)
    assert isinstance(caught.value.__cause__, KeyError)
    assert not graph.running
    graph.stop()
    episode = recorder.episode()
    assert len(episode.messages["agent", "world"]) == len(episode.steps["world"]) == 3
    with pytest.raises(UsageError, match="stopped"):
        graph.step(gs)


class Newest(BaseNode):
    """Tells which message is the newest that it sees."""

    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.int32(-1))

    def step(self, step_state):
        return step_state, Value(x=step_state.inputs["sender"][-1].seq)


@pytest.mark.parametrize("skip", [False, True])
def test_a_record_says_when_messages_arrived_at_the_delay_that_they_had(skip):
    """And which step was the first to see them: ages and arrows are worked out from it."""
    sender, reader = Jitted("sender", 50.0, delay_dist=0.001), Newest("reader", 50.0)
    reader.connect(sender, delay_dist=TrainableDist.create(0.039, 0.0, 0.1), skip=skip)
    nodes = {"sender": sender, "reader": reader}
    timeline = draw(nodes, 1.0, rng=0)
    episode, _ = record(nodes, "reader", timeline=timeline)
    messages, starts = episode.messages["reader", "sender"], episode.steps["reader"].start
    np.testing.assert_array_equal(messages.received - messages.sent, 39_000)
    seen = episode.outputs["reader"]["x"]
    for seq_out, seq_in, received in zip(messages.seq_out, messages.seq_in, messages.received, strict=True):
        sees = np.flatnonzero(seen >= seq_out)
        assert seq_in == (sees[0] if sees.size else -1)
        assert seq_in == -1 or starts[seq_in] >= received + skip
    ages = input_ages(episode, "reader")["sender"]
    assert np.nanmin(ages) == pytest.approx(0.039 if not skip else 0.059)
    again = Timeline.from_episode(episode, nodes).edges["reader", "sender"]
    drawn = timeline.edges["reader", "sender"]  # as windows need it: at the least delay
    np.testing.assert_array_equal(again.received, drawn.received)
    np.testing.assert_array_equal(again.seq_in, drawn.seq_in)


def test_options_that_do_not_fit_are_refused():
    nodes = chain()
    with pytest.raises(UsageError, match="duration_s or a timeline"):
        AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, duration_s=1.0, timeline=draw(nodes, 1.0))
    with pytest.raises(UsageError, match="simulated clock"):
        AsyncGraph(nodes, nodes["agent"], duration_s=1.0)
    with pytest.raises(UsageError, match="lacks world"):
        AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, timeline=Timeline({}, {}))
    with pytest.raises(UsageError, match="not in the graph"):
        AsyncGraph({"agent": nodes["agent"]}, nodes["agent"])
    with pytest.raises(UsageError, match="two nodes are called"):
        AsyncGraph([*nodes.values(), Jitted("world", 1)], nodes["agent"])
    world, command = BaseWorld("world", 100), Jitted("command", 100)
    world.connect(command, delay_dist=TrainableDist.create(0.01, 0.0, 0.05, "zoh_mean"))
    with pytest.raises(UsageError, match="zoh_mean"):
        AsyncGraph([world, command], command)


def test_statistics_tell_how_old_the_data_were_that_steps_used():
    """One step of 100 ms: who keeps the frequency reads 80 ms late for good, who keeps the phase does not."""
    sensor = Plain("sensor", 50.0, delay_dist=0.001)
    busy = EmpiricalDist([*[0.001] * 30, 0.1, *[0.001] * 69], block=100)
    readers = [Plain(s.value, 50.0, delay=0.001, delay_dist=busy, scheduling=s) for s in Scheduling]
    for reader in readers:
        reader.connect(sensor, blocking=True)
    readers[0].connect(sensor, name="fresh")
    episode, graph = record({n.name: n for n in (sensor, *readers)}, "sensor", duration_s=2.0)
    found = graph.statistics()
    assert found["sensor"].age_s == {}
    frequency, phase = (found[s.value] for s in (Scheduling.FREQUENCY, Scheduling.PHASE))
    assert [frequency.age_s["sensor"].p50, frequency.age_s["sensor"].max] == pytest.approx([0.08, 0.08])
    assert [phase.age_s["sensor"].p50, phase.age_s["sensor"].max] == pytest.approx([0.0, 0.08])
    assert frequency.age_s["fresh"].p50 == pytest.approx(0.0)
    assert (frequency.overruns, phase.overruns) == (1, 5), "of those that keep the phase, each that starts late counts"
    for node in found:
        for name, ages in input_ages(episode, node).items():  # the log says the same
            assert np.quantile(ages, [0.5, 0.99, 1.0]) == pytest.approx(found[node].age_s[name])


def test_a_node_that_waits_for_a_late_sender_does_not_overrun():
    sensor = Plain(
        "sensor", 50.0, delay=0.001, delay_dist=EmpiricalDist([*[0.001] * 10, 0.09, *[0.001] * 89], block=100)
    )
    agent = Plain("agent", 50.0, delay_dist=0.001, scheduling=Scheduling.PHASE)
    agent.connect(sensor, blocking=True)
    found = record({"sensor": sensor, "agent": agent}, "agent", duration_s=1.0)[1].statistics()
    assert (found["sensor"].overruns, found["agent"].overruns) == (1, 0)
    assert found["agent"].age_s["sensor"].max == pytest.approx(0.0)
