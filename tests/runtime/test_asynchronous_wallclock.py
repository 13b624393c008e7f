"""The wall clock: the rules with measured times, the hand-over of steps, warm-up."""

import gc
import os
import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from asynchronous_nodes import Jitted, Plain, Value, pair, random_graph

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph import Jitter, Scheduling, Timeline
from sim2real.graph.episode import MemoryRecorder
from sim2real.graph.schedule import rederive
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import MonotonicClock, realtime

pytestmark = [pytest.mark.process, pytest.mark.timeout(60)]
KEY = jax.random.key(0)


def record(nodes, supervisor, seconds):
    recorder = MemoryRecorder()
    with AsyncGraph(nodes, supervisor, recorder=recorder) as graph:
        graph.start(graph.init(KEY))
        graph.run_for(seconds)
    return recorder.episode(), graph


def assert_rules_explain(episode, nodes):
    """The timeline that the rules derive from measured delays is the recorded one."""
    nodes = {n.name: n for n in nodes}
    recorded = Timeline.from_episode(episode, nodes)
    derived = rederive(episode, nodes)
    for n, vertex in recorded.vertices.items():
        np.testing.assert_array_equal(derived.vertices[n].start, vertex.start, err_msg=n)
        np.testing.assert_array_equal(derived.vertices[n].end, vertex.end, err_msg=n)
    for (n, i), edge in recorded.edges.items():
        sender = nodes[n].inputs[i].output_node.name
        np.testing.assert_array_equal(episode.messages[n, i].seq_out, np.arange(len(episode.steps[sender])))
        np.testing.assert_array_equal(episode.messages[n, i].sent, episode.steps[sender].end)
        np.testing.assert_array_equal(derived.edges[n, i].received, edge.received, err_msg=f"{n}/{i}")
        np.testing.assert_array_equal(derived.edges[n, i].seq_in, edge.seq_in, err_msg=f"{n}/{i}")


@pytest.mark.parametrize("seed", range(6))
def test_a_recorded_timeline_is_derived_again(seed):
    rng = np.random.default_rng(seed)

    def make(name, rate, **options):
        busy = rng.exponential(rng.uniform(0.05, 0.5) / rate, 50)
        busy[rng.integers(0, 50, 3)] = 1.5 / rate  # overruns
        return Plain(name, rate, busy=tuple(busy), **options)

    nodes = random_graph(seed, make, lambda r, rate: {"delay": float(r.uniform(0, 0.3) / rate)})
    episode, graph = record(nodes, nodes[-1], 1.2)
    assert_rules_explain(episode, nodes)
    assert sum(s.overruns for s in graph.statistics().values()) > 0
    for node in nodes:
        assert node.seqs == list(range(len(episode.steps[node.name])))  # exactly once, in order
        assert len(node.threads) == 1
        assert node.calls == ["startup", "stop"]


def test_a_blocking_step_waits_for_its_quota():
    sensor = Plain("sensor", 100, busy=(0.0, 0.0, 0.015))
    agent = Plain("agent", 50)
    agent.connect(sensor, blocking=True, window=3)
    episode, _ = record([sensor, agent], agent, 0.5)
    seq_in = episode.messages["agent", "sensor"].seq_in
    assert (np.bincount(seq_in[seq_in > 0])[1:-1] == 2).all()
    assert len(episode.steps["agent"]) > 15
    last = [episode.messages["agent", "sensor"].received[seq_in == k].max() for k in range(10)]
    assert (episode.steps["agent"].start[:10] >= last).all()
    assert_rules_explain(episode, [sensor, agent])


def test_a_late_awakening_is_logged_and_consumes_by_its_start(monkeypatch):
    punctual = MonotonicClock.sleep_past

    def late(self, tick, stopping, spin=0):
        extra = 4_000 if threading.current_thread().name == "sim2real:agent" else 0
        return punctual(self, tick + extra, stopping, spin)

    monkeypatch.setattr(MonotonicClock, "sleep_past", late)
    sensor, agent = Plain("sensor", 500), Plain("agent", 50)
    agent.connect(sensor)
    episode, graph = record([sensor, agent], agent, 0.4)
    steps = episode.steps["agent"]
    assert (steps.woken - steps.start > 4_000).all()
    overran = np.flatnonzero(steps.end[:-1] > steps.scheduled[1:])  # on a busy machine: that moves what follows
    prompt = overran[0] + 1 if overran.size else len(steps.end)
    assert prompt > 1
    np.testing.assert_array_equal(steps.start[:prompt], steps.scheduled[:prompt])
    messages = episode.messages["agent", "sensor"]
    used = messages.seq_in >= 0
    assert (messages.received[used] <= steps.start[messages.seq_in[used]]).all()
    assert (messages.received[used] > steps.start[messages.seq_in[used] - 1])[messages.seq_in[used] > 0].all()
    assert graph.statistics()["agent"].lateness_s.p50 > 0.004
    assert_rules_explain(episode, [sensor, agent])


class Stamped(Plain):
    offset_s = 0.0

    def step(self, step_state):
        time.sleep(0.002)
        stamp = self.now() + self.offset_s
        time.sleep(0.002)
        new, output = super().step(step_state)
        return new.replace(ts=stamp), output


def test_a_step_may_move_its_start_later():
    node = Stamped("servo", 50)
    assert node.now() == 0.0
    episode, _ = record([node], node, 0.3)
    steps = episode.steps["servo"]
    assert (steps.ts_overwrite >= steps.start + 2_000).all()
    assert (steps.ts_overwrite <= steps.end - 2_000).all()
    assert node.now() == 0.0


@pytest.mark.parametrize("offset_s", [-1.0, 1.0])
def test_a_start_cannot_leave_its_step(offset_s):
    node = Stamped("servo", 50)
    node.offset_s = offset_s
    with pytest.raises(Sim2RealError, match="'servo': its step moved ts"):
        record([node], node, 1.0)
    assert node.calls == ["startup", "stop"]


def test_the_supervisor_hands_over_its_steps():
    sensor, agent = pair(Jitted)
    recorder = MemoryRecorder()
    with AsyncGraph([sensor, agent], agent, recorder=recorder) as graph:
        gs, ss = graph.reset(graph.init(KEY))
        for k in range(20):
            assert int(ss.seq) == k == int(gs.step)
            gs, ss = graph.step(gs, ss.replace(state=np.int32(7)), Value(x=np.int32(100 + k)))
        gs = graph.run(gs)
        assert int(gs.state["agent"]) == 8
        assert int(graph.run_for(0.1).step) > 25
        gs, ss = graph.step(gs)  # on offer again
    episode = recorder.episode()
    assert [int(x) for x in episode.outputs["agent"]["x"][:20]] == list(range(100, 120))
    assert agent.seqs == list(range(20, len(episode.steps["agent"])))
    assert_rules_explain(episode, [sensor, agent])


def test_start_then_step_is_refused():
    sensor, agent = pair()
    with AsyncGraph([sensor, agent], agent) as graph:
        gs = graph.init(KEY)
        graph.start(gs)
        with pytest.raises(UsageError, match="makes its own steps"):
            graph.step(gs)
        with pytest.raises(UsageError, match="is running"):
            graph.start(gs)


class Callback(Plain):
    """A hardware step in JAX, as the seed's tutorial writes them."""

    jittable = True

    def step(self, step_state):
        def act(seq):
            self.seqs.append(int(seq))
            return np.int32(seq)

        seq = jax.experimental.io_callback(act, jax.ShapeDtypeStruct((), jnp.int32), step_state.seq)
        return step_state, Value(x=seq)


def test_warmup_compiles_once_and_moves_nothing():
    traced = []

    class Counted(Jitted):
        def step(self, step_state):
            traced.append(self.name)
            return super().step(step_state)

    hardware, callback, agent = Plain("hardware", 50), Callback("callback", 50), Counted("agent", 50)
    agent.connect(hardware)
    agent.connect(callback)
    graph = AsyncGraph([hardware, callback, agent], agent)
    gs = graph.init(KEY)
    graph.warmup(gs)
    graph.warmup(gs)
    assert traced == ["agent"]
    assert hardware.seqs == callback.seqs == []
    with graph:
        graph.start(gs)
        graph.run_for(0.3)
    assert traced == ["agent"]
    for node in (hardware, callback):
        assert node.seqs == list(range(len(node.seqs)))
        assert len(node.seqs) > 5


def test_steps_run_without_jit_when_asked():
    class Eager(Plain):
        jittable = True  # although its step looks at values

    sensor, agent = pair(Eager)
    graph = AsyncGraph([sensor, agent], agent)
    gs = graph.init(KEY)
    with pytest.raises(UsageError, match="jit_step names nobody"):
        graph.warmup(gs, {"nobody": True})
    graph.warmup(gs, {"sensor": False})
    with graph:
        graph.start(gs)
        graph.run_for(0.2)
    assert sensor.seqs == list(range(len(sensor.seqs)))
    assert len(sensor.seqs) > 3


def test_steps_that_do_not_fit_are_refused_before_anything_moves():
    class Grows(Jitted):
        def step(self, step_state):
            return step_state.replace(state=step_state.state + 0.5), Value(x=step_state.seq)

    class Outputs(Jitted):
        def step(self, step_state):
            return step_state, Value(x=jnp.zeros(2))

    class Forgets(Jitted):
        def step(self, step_state):
            return step_state

    for cls, match in (
        (Grows, r"'a': the state that step returns differs .* float32\[\] instead of int32\[\]"),
        (Outputs, r"'a': the output of step differs .* float32\[2\] instead of int32\[\]"),
        (Forgets, "'a': step returned StepState"),
    ):
        node = cls("a", 50)
        graph = AsyncGraph([node], node)
        with pytest.raises(UsageError, match=match):
            graph.start(graph.init(KEY))
        assert node.calls == []


def test_episodes_leave_the_interpreter_as_it_was():
    gc.unfreeze()
    before = sys.getswitchinterval()
    with realtime(), realtime():
        assert not gc.isenabled()
        assert sys.getswitchinterval() < before
    assert gc.isenabled()
    sensor, agent = pair(Jitted)
    with AsyncGraph([sensor, agent], agent) as graph:
        graph.start(graph.init(KEY))
        assert not gc.isenabled()
        graph.run_for(0.05)
    assert gc.isenabled()
    assert sys.getswitchinterval() == before
    assert gc.get_freeze_count() == 0
    gc.freeze()
    with realtime():
        pass
    assert gc.get_freeze_count() > 0  # the caller's own stay frozen


def real_time_is_allowed():
    """Whether this process may have a real-time priority, found out in a thread that ends."""
    found = []

    def try_it():
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(3))
            found.append(True)
        except OSError:
            found.append(False)

    thread = threading.Thread(target=try_it)
    thread.start()
    thread.join()
    return found[0]


@pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="priorities of Linux")
def test_steps_have_real_time_priority_where_that_is_allowed():
    class Asks(Plain):
        def step(self, step_state):
            policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
            self.policies.append((policy, os.sched_getparam(0).sched_priority))
            if len(self.policies) == 1:
                inner = threading.Thread(target=lambda: self.inherited.append(os.sched_getscheduler(0)))
                inner.start()
                inner.join()
            return super().step(step_state)

    agent = Asks("agent", 100)
    agent.policies, agent.inherited = [], []
    before = os.sched_getscheduler(0)
    record([agent], agent, 0.05)
    assert set(agent.policies) == {(os.SCHED_FIFO, 1) if real_time_is_allowed() else (before, 0)}
    assert agent.inherited == [os.SCHED_OTHER if real_time_is_allowed() else before], "what a step starts has none"
    assert os.sched_getscheduler(0) == before, "nor has what runs the graph"


def test_steps_leave_no_cyclic_garbage():
    sensor, agent = pair(Jitted)
    with AsyncGraph([sensor, agent], agent) as graph:
        graph.start(graph.init(KEY))
        graph.run_for(0.1)
        gc.collect()
        graph.run_for(0.5)
        assert gc.collect() < 100


def test_a_window_that_a_step_kept_does_not_change():
    class Keeps(Plain):
        kept: list

        def step(self, step_state):
            self.kept.append((step_state.inputs["sensor"].seq, step_state.inputs["sensor"].seq.copy()))
            return super().step(step_state)

    sensor, agent = Plain("sensor", 200), Keeps("agent", 100)
    agent.kept = []
    agent.connect(sensor, window=3, jitter=Jitter.BUFFER)
    record([sensor, agent], agent, 0.3)
    assert len(agent.kept) > 10
    assert all(np.array_equal(a, b) for a, b in agent.kept)
    assert (np.diff(agent.kept[-1][1]) == 1).all()


def test_phase_returns_to_its_grid_and_frequency_does_not():
    nodes = [Plain(s.value, 50, busy=(0.0,) * 3 + (0.035,) + (0.0,) * 100, scheduling=s) for s in Scheduling]
    episode, _ = record(nodes, nodes[0], 0.4)
    phase, frequency = episode.steps["phase"], episode.steps["frequency"]
    assert phase.start[8] == phase.scheduled[8]
    assert frequency.start[8] > frequency.scheduled[8] + 10_000
    assert_rules_explain(episode, nodes)
