"""Every way in which a graph on the wall clock ends, in virtual time: each node that was started is stopped."""

import contextlib
import gc
import itertools
import linecache
import os
import signal
import sys
import threading

import jax
import numpy as np
import pytest
from asynchronous_nodes import Plain, Value, pair
from virtual_clock import VirtualClock

from sim2real.errors import SafetyStop, Sim2RealError, UsageError
from sim2real.graph.episode import MemoryRecorder
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.failure import GraphTimeout, NodeFailed, noted
from sim2real.runtime.wall_clock import WallClockRun, Watchdog, step_limits

KEY = jax.random.key(0)
WHOLE = (["startup", "stop"], [])
"""What a node may have seen of an episode that was stopped while it started: all of it, or nothing."""


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(Plain, "clock", VirtualClock())
    return Plain.clock


def graph_threads():
    """The running threads of this test's graphs."""
    return [t.name for t in Plain.clock.running if t.name.startswith("sim2real:")]


def gone(clock):
    """Whether all threads of graphs end."""
    return clock.wait_for(lambda: not graph_threads(), 20.0)


def in_thread(call, *args):
    thread = threading.Thread(target=call, args=args)
    Plain.clock.start(thread)
    return thread


class Breaks(Plain):
    error: Exception = KeyError("gone")

    def step(self, step_state):
        if step_state.seq == 5:
            raise self.error
        return super().step(step_state)


class Hangs(Plain):
    """Hangs in its step 5 until ``release`` is set."""

    def __init__(self, *args, hangs_at=5, **kwargs):
        super().__init__(*args, **kwargs)
        self.release, self.hangs_at = self.clock.event(), hangs_at

    def step(self, step_state):
        if step_state.seq == self.hangs_at:
            self.release.wait(100.0)
        return super().step(step_state)


class Motor(Plain):
    """A startup that switches torque on."""

    torque = False

    def startup(self, graph_state, timeout=None):
        self.torque = True
        return super().startup(graph_state, timeout)

    def stop(self, timeout=None):
        self.clock.sleep(0.1)
        self.torque = False
        return super().stop(timeout)


def run_until_it_breaks(graph, gs, how):
    if how == "step":
        step_many(graph, gs)
    else:
        graph.start(gs)
        Plain.clock.sleep(0.3 if how in ("stop", "reset") else 0.0)
        calls = {"run_for": (5.0,), "wait": (5.0,), "stop": (), "reset": (gs,)}
        getattr(graph, how)(*calls[how])


def step_many(graph, gs):
    gs, ss = graph.reset(gs)
    for _ in range(10_000):
        gs, ss = graph.step(gs, ss, Value(x=0))


def ended(clock, nodes, match, how="run_for", kind=Sim2RealError, **options):
    """Run a graph until it ends with an error; return graph and error. Each node was stopped, or never started."""
    graph = AsyncGraph(nodes, nodes[1], clock, **options)
    with pytest.raises(kind, match=match) as caught:
        run_until_it_breaks(graph, graph.init(KEY), how)
    assert all(node.calls in WHOLE for node in nodes)
    graph.stop()  # it is raised once
    assert not graph.running
    assert gone(clock)
    return graph, caught.value


@pytest.mark.parametrize("how", ["run_for", "wait", "step", "stop", "reset"])
def test_an_exception_stops_the_graph_and_reaches_the_caller(clock, how):
    sensor, agent = pair(Breaks)
    nodes = sensor, agent, Plain("slow", 1)
    match = r"node 'sensor' failed in its step 5: KeyError: 'gone'"
    graph, error = ended(clock, nodes, match, how, NodeFailed)
    assert error.node == "sensor"
    assert isinstance(error.__cause__, KeyError)
    assert [n.calls for n in nodes] == [["startup", "stop"]] * 3
    graph.start(graph.init(KEY))
    graph.stop()


class UnreadableError(Exception):
    def __str__(self):
        raise ValueError


@pytest.mark.parametrize("error", [UnreadableError(), SystemExit(1), MemoryError(), SafetyStop("too hot")], ids=repr)
def test_any_exception_of_a_step_ends_with_all_nodes_stopped(clock, error):
    nodes = pair(type("Fails", (Breaks,), {"error": error}))
    _, found = ended(clock, nodes, None)
    assert [n.calls for n in nodes] == [["startup", "stop"]] * 2
    if isinstance(error, SafetyStop):  # the project's own errors keep their type
        assert found is error
        assert "node 'sensor', step 5" in error.__notes__
    else:
        assert found.__cause__ is error


@pytest.mark.parametrize("call", ["start", "step", "message", "watchdog"])
def test_a_recorder_or_a_watchdog_that_fails_stops_the_graph(clock, call, monkeypatch):
    class Full(MemoryRecorder):
        pass

    def full(*_):
        raise OSError("disk full")

    monkeypatch.setattr(*((Watchdog, "_look") if call == "watchdog" else (Full, call)), full, raising=False)
    match = "watchdog" if call == "watchdog" else "disk full"
    ended(clock, pair(), match, kind=(OSError, Sim2RealError), recorder=Full())


def test_a_failure_that_comes_while_a_call_looks_for_one_is_raised(clock, monkeypatch):
    """A process that was stopped goes on: the node that the guardian left without torque wakes with its caller."""
    looks, check = [], WallClockRun.check

    def late(run):
        check(run)
        looks.append(run)
        if len(looks) == 1:
            run._shared.fail(SafetyStop("the guardian has switched torque off"))

    sensor, agent = pair()
    graph = AsyncGraph([sensor, agent], agent, clock)
    graph.start(graph.init(KEY))
    monkeypatch.setattr(WallClockRun, "check", late)
    with pytest.raises(SafetyStop, match="the guardian"):
        graph.run_for(5.0)
    assert not graph.running


def test_every_node_is_stopped_although_one_stop_fails_which_does_not_hide_why_a_block_is_left(clock):
    class BadStop(Plain):
        def stop(self, timeout=None):
            super().stop(timeout)
            raise OSError("port")

    class StopsNot(Plain):
        def stop(self, timeout=None):
            super().stop(timeout)
            return False

    def interrupted():
        with graph:
            graph.start(graph.init(KEY))
            raise KeyboardInterrupt

    nodes = [BadStop("a", 50), Plain("b", 50), StopsNot("c", 50)]
    graph = AsyncGraph(nodes, nodes[0], clock)
    graph.start(graph.init(KEY))
    for call, kind in ((graph.stop, Sim2RealError), (interrupted, KeyboardInterrupt)):
        with pytest.raises(kind) as caught:
            call()
        text = str(caught.value) + "".join(getattr(caught.value, "__notes__", []))
        assert "OSError: port" in text
        assert "'c' did not succeed" in text
    assert all(n.calls == ["startup", "stop"] * 2 for n in nodes)


@pytest.mark.parametrize(("seconds", "match"), [(0.0, "startup of node 'sensor'"), (20.0, "'sensor' has not finished")])
def test_a_failed_startup_stops_everything(clock, seconds, match):
    class Unplugged(Plain):
        def startup(self, graph_state, timeout=None):
            super().startup(graph_state, timeout)
            self.clock.sleep(seconds)
            return bool(seconds)

    sensor, agent = pair(Unplugged)
    graph = AsyncGraph([sensor, agent], agent, clock)
    with pytest.raises(Sim2RealError, match=match):
        graph.start(graph.init(KEY), timeout_s=0.1)
    assert gone(clock)
    # The slow one is made safe at once, and again when its startup returns, which may have switched something on.
    assert sensor.calls == ["startup", "stop", "stop"] if seconds else ["startup", "stop"]
    assert agent.calls in WHOLE  # nothing starts up once the graph has failed
    assert sensor.seqs == agent.seqs == []


def test_calls_honour_their_timeouts(clock):
    sensor, agent = pair(lambda *args: Hangs(*args, hangs_at=0), blocking=True)
    graph = AsyncGraph([sensor, agent], agent, clock, timeout_s=0.3)
    gs = graph.init(KEY)
    graph.warmup(gs)
    begin = clock.monotonic_s()
    with pytest.raises(GraphTimeout, match="no step of the supervisor 'agent' within"):
        graph.reset(gs)
    assert clock.monotonic_s() - begin == pytest.approx(0.3, abs=0.01)
    assert graph.wait(0.1) is False
    with pytest.raises(GraphTimeout, match=r"'sensor' is still in its step 0 0\.2 s after the stop"):
        graph.stop(timeout_s=0.2)
    assert clock.monotonic_s() - begin == pytest.approx(0.6, abs=0.01)
    assert sensor.calls == ["startup", "stop"]
    graph.stop()
    with pytest.raises(Sim2RealError, match="sensor did not end"):
        graph.start(gs)
    sensor.release.set()
    assert gone(clock)
    assert sensor.calls == ["startup", "stop", "stop"]  # once more: the step that hung may have acted since
    graph.start(gs)
    graph.stop()
    assert sensor.calls[3:] == ["startup", "stop"]


def test_a_supervisor_without_a_caller_stops_the_graph(clock):
    sensor, agent = pair()
    graph = AsyncGraph([sensor, agent], agent, clock, timeout_s=0.2)
    gs, _ = graph.reset(graph.init(KEY))
    clock.sleep(0.4)
    assert not graph.running
    assert sensor.calls == ["startup", "stop"]
    with pytest.raises(GraphTimeout, match="waited"):
        graph.step(gs, None, Value(x=0))


@pytest.mark.parametrize("mode", ["run_for", "wait", "step"])
@pytest.mark.parametrize("by_a_node", [False, True])
def test_stop_from_another_thread_or_a_node(clock, mode, by_a_node):
    class Stops(Plain):
        def step(self, step_state):
            if step_state.seq == 5:
                graph.stop()
            return super().step(step_state)

    def later():
        clock.sleep(0.15)
        graph.stop()

    sensor, agent = pair(Stops if by_a_node else Plain)
    graph = AsyncGraph([sensor, agent], agent, clock)
    gs = graph.init(KEY)
    stopper = None if by_a_node else in_thread(later)
    if mode == "step":
        with pytest.raises(Sim2RealError, match="stopped"):
            step_many(graph, gs)
    else:
        graph.start(gs)
        getattr(graph, mode)(10.0)
    graph.stop()
    if stopper:
        stopper.join(20)
    assert sensor.calls == agent.calls == ["startup", "stop"]


@pytest.mark.parametrize(("wall", "sequences"), [(False, 100), (True, 8)])
def test_any_order_of_calls(clock, wall, sequences):
    rng = np.random.default_rng(int(not wall))
    sensor, agent = pair(rate=400.0)
    options = {} if wall else {"duration_s": 0.2}
    graph = AsyncGraph([sensor, agent], agent, clock if wall else Clock.SIMULATED, timeout_s=5.0, **options)
    gs = graph.init(KEY)
    calls = {
        "start": lambda: graph.start(gs),
        "run_for": lambda: graph.run_for(0.005),
        "run": lambda: graph.run(gs),
        "reset": lambda: graph.reset(gs),
        "step": lambda: graph.step(gs, None, Value(x=1)),
        "own": lambda: graph.step(gs),
        "stop": lambda: graph.stop(),
        "wait": lambda: graph.wait(0.002),
        "state": lambda: graph.graph_state,
    }
    made = 0
    for _ in range(sequences):
        for name in rng.choice(list(calls), rng.integers(1, 7)):
            with contextlib.suppress(UsageError):  # out of place, and refused
                calls[name]()
                made += 1
    graph.stop()
    assert made > sequences
    assert not graph_threads()
    if wall:
        assert sensor.calls == ["startup", "stop"] * (len(sensor.calls) // 2)
        assert len(sensor.calls) > 8


def at_line(number, act, call):
    """Call, and act before the runtime's line of this ``number`` runs in this thread; return whether one had it."""
    count = 0

    def trace(frame, event, _):
        nonlocal count
        if not frame.f_code.co_filename.endswith(("runtime/asynchronous.py", "runtime/wall_clock.py")):
            return None
        # Python reports the line of a `with` again before it leaves the block, where it does not look for signals.
        is_with = linecache.getline(frame.f_code.co_filename, frame.f_lineno).lstrip().startswith("with ")
        if event == "line" and not is_with:
            count += 1
            if count == number:
                sys.settrace(None)
                act()
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count >= number


class Logs(MemoryRecorder):
    def start(self, epoch_ns, origin_ns):
        self.events.append("recorder.start")
        super().start(epoch_ns, origin_ns)


def motor_graph(clock):
    """Return a graph with a motor, the motor, and what happens."""
    events, nodes, recorder = [], [Plain("other", 50), Motor("motor", 50)], Logs()
    for part in nodes:
        part.calls = events
    recorder.events = events
    return AsyncGraph(nodes, nodes[1], clock, recorder=recorder), nodes[1], events


@pytest.mark.parametrize("each", [5, pytest.param(1, marks=pytest.mark.night)])
@pytest.mark.parametrize("by", ["another thread", "Ctrl-C"])
def test_a_start_can_be_stopped_at_every_line(clock, by, each):
    """When stop() returns, torque is off and stays off, and nothing starts any more."""
    states = {}
    for line in itertools.count(5, each):  # the first four come before the start counts the stops so far
        graph, motor, events = motor_graph(clock)
        gs, stopped, errors = graph.init(KEY), clock.event(), []

        def stop(graph=graph, motor=motor, events=events, stopped=stopped):
            graph.stop()
            events.append("torque" if motor.torque else "off")
            stopped.set()

        def act(stop=stop, stopped=stopped):
            if by == "Ctrl-C":
                raise KeyboardInterrupt
            in_thread(stop)
            stopped.wait(0.5)  # of virtual time: start() may hold stop() up

        def start(graph=graph, gs=gs, errors=errors):
            try:
                graph.start(gs)
            except (KeyboardInterrupt, Sim2RealError) as error:
                errors.append(error)

        came = at_line(line, act, start)
        if by == "Ctrl-C" or not came:
            stop()
        assert stopped.wait(5.0), line
        assert gone(clock), line
        assert events[-1] == "off", (line, events)
        assert events.count("startup") == events.count("stop"), (line, events)
        assert gc.isenabled(), line
        assert not graph.running
        states[tuple(events[:-1])] = line
        if not came:
            break
    assert line > 50
    assert () in states, "stopped before anything started"
    assert ("startup", "startup", "recorder.start", "stop", "stop") in states


@pytest.mark.night
def test_a_stop_can_be_interrupted_at_every_line(clock):
    """Ctrl-C while stop() waits: the nodes are stopped, and the next stop() ends what this one did not."""

    def interrupt():
        raise KeyboardInterrupt

    for line in itertools.count(1):
        graph, motor, events = motor_graph(clock)
        graph.start(graph.init(KEY))

        def stop(graph=graph):
            with contextlib.suppress(KeyboardInterrupt):
                graph.stop()

        came = at_line(line, interrupt, stop)
        graph.stop()
        assert not motor.torque
        assert events.count("stop") == 2
        assert gone(clock), line
        assert gc.isenabled(), line
        if not came:
            break
    assert line > 20


def test_a_stop_before_the_graph_is_compiled_ends_the_start(clock, monkeypatch):
    def prepare(self, graph_state):
        graph.stop()
        return prepared(self, graph_state)

    prepared = AsyncGraph._prepare
    motor = Motor("motor", 50)
    graph = AsyncGraph([motor], motor, clock)
    gs = graph.init(KEY)
    monkeypatch.setattr(AsyncGraph, "_prepare", prepare)
    with pytest.raises(Sim2RealError, match="stopped while it started"):
        graph.start(gs)
    assert motor.calls == []
    assert not graph.running


def test_garbage_is_collected_before_a_startup_may_switch_torque_on(clock):
    """Collecting stops every thread, that which feeds a servo's watchdog too."""

    class Watches(Plain):
        def startup(self, graph_state, timeout=None):
            self.collecting = gc.isenabled()
            return super().startup(graph_state, timeout)

    sensor, agent = pair(Watches)
    with AsyncGraph([sensor, agent], agent, clock) as graph:
        graph.start(graph.init(KEY))
    assert not sensor.collecting


def test_a_step_that_hangs_stops_the_graph_and_is_made_safe(clock):
    class Stuck(Hangs, Motor):
        pass

    sensor, motor = Plain("sensor", 50), Stuck("motor", 50)
    motor.connect(sensor)
    graph = AsyncGraph([sensor, motor], sensor, clock, step_timeout_s=0.5)
    begin = clock.monotonic_s()
    graph.start(graph.init(KEY))
    assert clock.wait_for(lambda: not motor.torque, 20.0)  # although nobody waits for the graph
    assert clock.monotonic_s() - begin == pytest.approx(0.005 + 5 / 50 + 0.5 + 0.1, abs=0.001)
    with pytest.raises(GraphTimeout, match=r"node 'motor' hangs: its step 5 has taken 0\.5 s") as caught:
        graph.run_for(30.0)
    assert not getattr(caught.value, "__notes__", []), "reported once"
    assert sensor.calls == motor.calls == ["startup", "stop"]
    motor.release.set()
    assert gone(clock)
    assert motor.calls == ["startup", "stop", "stop"]


def test_how_long_a_step_may_take():
    nodes = {n.name: n for n in (Plain("fast", 50), Plain("slow", 2))}
    assert step_limits(nodes, None) == {"fast": 1.0, "slow": 5.0}
    assert step_limits(nodes, 0.3) == {"fast": 0.3, "slow": 0.3}
    assert step_limits(nodes, 0.0) == {"fast": float("inf"), "slow": float("inf")}
    with pytest.raises(UsageError, match="step_timeout_s must be at least 0"):
        AsyncGraph(nodes, nodes["slow"], step_timeout_s=-1.0)
    with pytest.raises(UsageError, match="wall clock"):
        AsyncGraph(nodes, nodes["slow"], Clock.SIMULATED, duration_s=1.0, step_timeout_s=1.0)


def test_the_watchdog_does_not_count_what_the_caller_takes(clock):
    sensor, agent = pair()
    with AsyncGraph([sensor, agent], agent, clock, step_timeout_s=0.3) as graph:
        gs, ss = graph.reset(graph.init(KEY))
        clock.sleep(0.7)
        graph.step(gs, ss, Value(x=0))


def test_ctrl_c_ends_a_startup_that_hangs(clock):
    class Hanging(Plain):
        def startup(self, graph_state, timeout=None):
            self.clock.sleep(20.0)
            return super().startup(graph_state, timeout)

    hanging, motor = Hanging("hanging", 50), Motor("motor", 50)
    graph = AsyncGraph([motor, hanging], motor, clock)
    gs = graph.init(KEY)
    graph.warmup(gs)

    def interrupt():
        clock.sleep(2.0)
        os.kill(os.getpid(), signal.SIGINT)

    begin = clock.monotonic_s()
    in_thread(interrupt)
    with pytest.raises(KeyboardInterrupt) as caught:
        graph.start(gs, timeout_s=50.0)
    assert clock.monotonic_s() - begin < 5.0
    assert not motor.torque
    assert "'hanging' is still in its startup" in "".join(caught.value.__notes__)
    assert hanging.calls == ["stop"]
    assert gone(clock)
    assert hanging.calls == ["stop", "startup", "stop"]


def test_what_fails_on_the_way_out_becomes_a_note():
    reason = SafetyStop("too fast")
    with noted(reason):
        raise OSError("disk full")
    with noted(reason):
        raise reason
    assert reason.__notes__ == ["then: OSError: disk full"]
    with pytest.raises(KeyboardInterrupt), noted(reason):
        raise KeyboardInterrupt
