"""The wall clock in virtual time: the rules with measured times, the handover of steps, warm-up."""

import gc
import sys
import threading
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from asynchronous_nodes import Jitted, Plain, Value, assert_rules_explain, pair
from oracles.hash_nodes import random_graph
from virtual_clock import VirtualClock

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph import Jitter, Scheduling
from sim2real.graph.episode import MemoryRecorder
from sim2real.runtime import clock as runtime_clock
from sim2real.runtime import virtual
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import MonotonicClock, realtime

KEY = jax.random.key(0)


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(Plain, "clock", VirtualClock())
    return Plain.clock


def record(nodes, supervisor, seconds):
    recorder = MemoryRecorder()
    with AsyncGraph(nodes, supervisor, Plain.clock, recorder=recorder) as graph:
        graph.start(graph.init(KEY))
        graph.run_for(seconds)
    return recorder.episode(), graph


@pytest.mark.parametrize("seed", range(6))
def test_a_recorded_timeline_is_derived_again(clock, seed):
    rng = np.random.default_rng(seed)

    def make(name, rate, world, **options):
        busy = rng.exponential(rng.uniform(0.05, 0.5) / rate, 50)
        busy[rng.integers(0, 50, 3)] = 1.5 / rate  # overruns
        return Plain(name, rate, busy=tuple(busy), **options)

    nodes = list(random_graph(seed, worlds=0, make=make).values())
    episode, graph = record(nodes, nodes[0], 1.2)
    assert_rules_explain(episode, {n.name: n for n in nodes})
    assert sum(s.overruns for s in graph.statistics().values()) > 0
    for node in nodes:
        assert node.seqs == list(range(len(episode.steps[node.name])))  # exactly once, in order
        assert len(node.threads) == 1
        assert node.calls == ["startup", "stop"]


def test_a_blocking_step_waits_for_its_quota(clock):
    sensor = Plain("sensor", 100, busy=(0.0, 0.0, 0.015))
    agent = Plain("agent", 50)
    agent.connect(sensor, blocking=True, window=3)
    episode, _ = record([sensor, agent], agent, 0.5)
    seq_in = episode.messages["agent", "sensor"].seq_in
    assert (np.bincount(seq_in[seq_in > 0])[1:-1] == 2).all()
    assert len(episode.steps["agent"]) > 15
    last = [episode.messages["agent", "sensor"].received[seq_in == k].max() for k in range(10)]
    assert (episode.steps["agent"].start[:10] >= last).all()
    assert_rules_explain(episode, {"sensor": sensor, "agent": agent})


def test_a_late_awakening_is_logged_and_consumes_by_its_start(clock, monkeypatch):
    punctual = MonotonicClock.sleep_past

    def late(self, tick, stopping):
        extra = 4_000 if threading.current_thread().name == "sim2real:agent" else 0
        return punctual(self, tick + extra, stopping)

    monkeypatch.setattr(VirtualClock, "sleep_past", late)
    sensor, agent = Plain("sensor", 500), Plain("agent", 50)
    agent.connect(sensor)
    episode, graph = record([sensor, agent], agent, 0.4)
    steps = episode.steps["agent"]
    np.testing.assert_array_equal(steps.start, steps.scheduled)
    np.testing.assert_array_equal(steps.woken - steps.start, 4_001)
    messages = episode.messages["agent", "sensor"]
    used = messages.seq_in >= 0
    assert (messages.received[used] <= steps.start[messages.seq_in[used]]).all()
    assert (messages.received[used] > steps.start[messages.seq_in[used] - 1])[messages.seq_in[used] > 0].all()
    assert graph.statistics()["agent"].lateness_s.p50 == pytest.approx(0.004, abs=1e-5)
    assert_rules_explain(episode, {"sensor": sensor, "agent": agent})


def test_phase_returns_to_its_grid_and_frequency_does_not(clock):
    nodes = [Plain(s.value, 50, busy=(0.0,) * 3 + (0.035,) + (0.0,) * 100, scheduling=s) for s in Scheduling]
    episode, _ = record(nodes, nodes[0], 0.4)
    phase, frequency = episode.steps["phase"], episode.steps["frequency"]
    assert phase.start[8] == phase.scheduled[8]
    assert frequency.start[8] == frequency.scheduled[8] + 15_001  # 35 ms of work and a tick, less a period
    assert_rules_explain(episode, {n.name: n for n in nodes})


class Stamped(Plain):
    offset_s = 0.0

    def step(self, step_state):
        self.clock.sleep(0.002)
        stamp = self.now() + self.offset_s
        self.clock.sleep(0.002)
        new, output = super().step(step_state)
        return new.replace(ts=stamp), output


def test_a_step_may_move_its_start_later(clock):
    node = Stamped("servo", 50)
    assert node.now() == 0.0
    episode, _ = record([node], node, 0.3)
    steps = episode.steps["servo"]
    np.testing.assert_array_equal(steps.ts_overwrite, steps.woken + 2_000)
    np.testing.assert_array_equal(steps.end, steps.woken + 4_000)
    assert node.now() == 0.0


@pytest.mark.parametrize("offset_s", [-1.0, 1.0])
def test_a_start_cannot_leave_its_step(clock, offset_s):
    node = Stamped("servo", 50)
    node.offset_s = offset_s
    with pytest.raises(Sim2RealError, match="'servo': its step moved ts"):
        record([node], node, 1.0)
    assert node.calls == ["startup", "stop"]


def test_a_window_that_a_step_kept_does_not_change(clock):
    class Keeps(Plain):
        kept: list

        def step(self, step_state):
            self.kept.append((step_state.inputs["sensor"].seq, step_state.inputs["sensor"].seq.copy()))
            return super().step(step_state)

    sensor, agent = Plain("sensor", 200), Keeps("agent", 100)
    agent.kept = []
    agent.connect(sensor, window=3, jitter=Jitter.BUFFER)
    record([sensor, agent], agent, 0.3)
    assert len(agent.kept) == 30
    assert all(np.array_equal(a, b) for a, b in agent.kept)
    assert (np.diff(agent.kept[-1][1]) == 1).all()


def test_the_supervisor_hands_over_its_steps(clock):
    sensor, agent = pair(Jitted)
    recorder = MemoryRecorder()
    with AsyncGraph([sensor, agent], agent, clock, recorder=recorder) as graph:
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
    assert_rules_explain(episode, {"sensor": sensor, "agent": agent})


def test_start_then_step_is_refused(clock):
    sensor, agent = pair()
    with AsyncGraph([sensor, agent], agent, clock) as graph:
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


def test_warmup_compiles_once_and_moves_nothing(clock):
    traced = []

    class Counted(Jitted):
        def step(self, step_state):
            traced.append(self.name)
            return super().step(step_state)

    hardware, callback, agent = Plain("hardware", 50), Callback("callback", 50), Counted("agent", 50)
    agent.connect(hardware)
    agent.connect(callback)
    graph = AsyncGraph([hardware, callback, agent], agent, clock)
    gs = graph.init(KEY)
    graph.warmup(gs)
    graph.warmup(gs)
    assert traced == ["agent"]
    assert hardware.seqs == callback.seqs == []
    with graph:
        graph.start(gs)
        graph.run_for(0.3)
    assert traced == ["agent"]
    assert hardware.seqs == callback.seqs == list(range(15))


def test_steps_run_without_jit_when_asked(clock):
    class Eager(Plain):
        jittable = True  # although its step looks at values

    sensor, agent = pair(Eager)
    graph = AsyncGraph([sensor, agent], agent, clock)
    gs = graph.init(KEY)
    graph.warmup(gs, jit_step=False)
    with graph:
        graph.start(gs)
        graph.run_for(0.2)
    assert sensor.seqs == list(range(20))


def test_a_step_that_forgets_its_output_is_refused_before_anything_moves():
    class Forgets(Jitted):
        def step(self, step_state):
            return step_state

    node = Forgets("a", 50)
    graph = AsyncGraph([node], node)
    with pytest.raises(UsageError, match="'a': step returned StepState"):
        graph.start(graph.init(KEY))
    assert node.calls == []


@pytest.mark.parametrize("frozen", [0, 5])
def test_objects_are_frozen_for_the_block_alone_unless_the_caller_froze_some(monkeypatch, frozen):
    own = Mock(wraps=gc, get_freeze_count=lambda: frozen, unfreeze=Mock())  # a real one would let the suite's go
    monkeypatch.setattr(runtime_clock, "gc", own)
    with realtime():
        own.freeze.assert_called_once()
        own.unfreeze.assert_not_called()
    assert own.unfreeze.call_count == (frozen == 0)


def test_episodes_leave_the_interpreter_as_it_was(clock):
    before = sys.getswitchinterval()
    with realtime(), realtime():
        assert not gc.isenabled()
        assert sys.getswitchinterval() < before
    assert gc.isenabled()
    sensor, agent = pair(Jitted)
    with AsyncGraph([sensor, agent], agent, clock) as graph:
        graph.start(graph.init(KEY))
        assert not gc.isenabled()
        graph.run_for(0.05)
        gc.collect()
        graph.run_for(0.5)
        assert gc.collect() < 100, "steps leave cyclic garbage"
    assert gc.isenabled()
    assert sys.getswitchinterval() == before


def test_all_nodes_make_their_steps_and_nobody_waits(clock):
    sensor, agent = pair()
    with AsyncGraph([sensor, agent], agent, clock) as graph:
        graph.start(graph.init(KEY))
        graph.run_for(60.0)
        statistics = graph.statistics()
    for node in (sensor, agent):
        assert statistics[node.name].steps == pytest.approx(60.0 * node.rate, abs=1)
        assert statistics[node.name].overruns == 0


def test_a_step_that_never_returns_ends_the_graph(clock, monkeypatch):
    monkeypatch.setattr(virtual, "_HANGS_S", 0.05)
    release = threading.Event()

    class Hangs(Plain):
        def step(self, step_state):
            if step_state.seq == 5:
                release.wait()
            return super().step(step_state)

    sensor, agent = pair(Hangs)
    graph = AsyncGraph([sensor, agent], agent, clock)
    graph.start(graph.init(KEY))
    graph.run_for(5.0)
    try:
        with pytest.raises(Sim2RealError, match="'sensor' is still in its step 5"):
            graph.stop()
        assert "stop" in sensor.calls
    finally:
        release.set()
