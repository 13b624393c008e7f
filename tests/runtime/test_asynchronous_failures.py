"""What goes wrong on the wall clock: exceptions, silence, every order of calls."""

import contextlib
import gc
import os
import signal
import threading
import time

import jax
import numpy as np
import pytest
from asynchronous_nodes import Plain, Value, pair

from sim2real.errors import SafetyStop, Sim2RealError, UsageError
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.failure import GraphTimeout, NodeFailed, noted
from sim2real.runtime.wall_clock.node_thread import NodeThread
from sim2real.runtime.wall_clock.wall_clock import WallClockRun
from sim2real.runtime.wall_clock.watchdog import step_limits

pytestmark = [pytest.mark.process, pytest.mark.timeout(60)]
KEY = jax.random.key(0)
WHOLE = (["startup", "stop"], [])
"""What a node may have seen of an episode that was stopped while it started: all of it, or nothing."""


def graph_threads():
    return [t.name for t in threading.enumerate() if t.name.startswith("sim2real:")]


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def run(sensor, agent, seconds):
    with AsyncGraph([sensor, agent], agent) as graph:
        graph.start(graph.init(KEY))
        graph.run_for(seconds)


class Breaks(Plain):
    error: Exception = KeyError("gone")

    def step(self, step_state):
        if step_state.seq == 5:
            raise self.error
        return super().step(step_state)


def run_until_it_breaks(graph, gs, how):
    if how == "step":
        step_many(graph, gs)
    else:
        graph.start(gs)
        time.sleep(0.3 if how in ("stop", "reset") else 0.0)
        calls = {"run_for": (5.0,), "wait": (5.0,), "stop": (), "reset": (gs,)}
        getattr(graph, how)(*calls[how])


def step_many(graph, gs):
    gs, ss = graph.reset(gs)
    for _ in range(10_000):
        gs, ss = graph.step(gs, ss, Value(x=0))


@pytest.mark.parametrize("how", ["run_for", "wait", "step", "stop", "reset"])
def test_an_exception_stops_the_graph_and_reaches_the_caller(how):
    sensor, agent = pair(Breaks)
    slow = Plain("slow", 1)
    graph = AsyncGraph([sensor, agent, slow], agent)
    gs = graph.init(KEY)
    graph.warmup(gs)
    with pytest.raises(NodeFailed, match=r"node 'sensor' failed in its step 5: KeyError: 'gone'") as caught:
        run_until_it_breaks(graph, gs, how)
    assert caught.value.node == "sensor"
    assert isinstance(caught.value.__cause__, KeyError)
    assert [n.calls for n in (sensor, agent, slow)] == [["startup", "stop"]] * 3
    graph.stop()  # heard of once
    assert not graph.running
    graph.start(gs)
    graph.stop()


def test_a_failure_that_comes_while_a_call_looks_for_one_is_the_one_that_is_told(monkeypatch):
    """A process that was stopped goes on: the node that the guardian left without torque wakes with its caller."""
    looks, check = [], WallClockRun.check

    def late(run):
        check(run)
        looks.append(run)
        if len(looks) == 1:
            run._shared.fail(SafetyStop("the guardian has taken the torque off"))

    sensor, agent = pair(Plain)
    graph = AsyncGraph([sensor, agent], agent)
    graph.start(graph.init(KEY))
    monkeypatch.setattr(WallClockRun, "check", late)
    with pytest.raises(SafetyStop, match="the guardian"):
        graph.run_for(5.0)
    assert not graph.running


def test_the_projects_own_errors_keep_their_type():
    class Limit(Breaks):
        error = SafetyStop("too hot", hint="let it cool")

    sensor, agent = pair(Limit)
    begin = time.monotonic()
    with pytest.raises(SafetyStop, match="too hot") as caught:
        run(sensor, agent, 20.0)
    assert time.monotonic() - begin < 10.0
    assert caught.value.exit_code == 3
    assert "node 'sensor', step 5" in caught.value.__notes__


def test_every_node_is_stopped_although_one_stop_fails():
    class BadStop(Plain):
        def stop(self, timeout=None):
            super().stop(timeout)
            raise OSError("port")

    class StopsNot(Plain):
        def stop(self, timeout=None):
            super().stop(timeout)
            return False

    nodes = [BadStop("a", 50), Plain("b", 50), StopsNot("c", 50)]
    graph = AsyncGraph(nodes, nodes[0])
    graph.start(graph.init(KEY))
    with pytest.raises(Sim2RealError) as caught:
        graph.stop()
    told = str(caught.value) + "".join(caught.value.__notes__ if hasattr(caught.value, "__notes__") else [])
    assert "OSError: port" in told
    assert "'c' did not succeed" in told
    assert all(n.calls == ["startup", "stop"] for n in nodes)


def test_a_failed_startup_stops_everything():
    class Unplugged(Plain):
        def startup(self, graph_state, timeout=None):
            super().startup(graph_state, timeout)
            return False

    class Slow(Plain):
        def startup(self, graph_state, timeout=None):
            super().startup(graph_state, timeout)
            release.wait(20)
            return True

    release = threading.Event()

    for cls, seconds, match in ((Unplugged, 5.0, "startup of node 'sensor'"), (Slow, 0.1, "'sensor' has not finished")):
        release.clear()
        sensor, agent = pair(cls)
        graph = AsyncGraph([sensor, agent], agent)
        with pytest.raises(Sim2RealError, match=match):
            graph.start(graph.init(KEY), timeout_s=seconds)
        release.set()
        wait_for(lambda: not graph_threads())
        # The slow one is made safe at once, and again when its startup comes back, which may have switched things on.
        assert sensor.calls == ["startup", "stop", "stop"] if cls is Slow else ["startup", "stop"]
        assert agent.calls in WHOLE  # nothing starts up once the graph has failed
        assert sensor.seqs == agent.seqs == []


class Hangs(Plain):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.release = threading.Event()

    def step(self, step_state):
        self.release.wait(20)
        return super().step(step_state)


def test_calls_honour_their_timeouts():
    sensor, agent = pair(Hangs, blocking=True)
    graph = AsyncGraph([sensor, agent], agent, timeout_s=0.3)
    gs = graph.init(KEY)
    graph.warmup(gs)
    begin = time.monotonic()
    with pytest.raises(GraphTimeout, match="no step of the supervisor 'agent' within"):
        graph.reset(gs)
    assert graph.wait(0.1) is False
    with pytest.raises(GraphTimeout, match="'sensor' is still in its step 0"):
        graph.stop(timeout_s=0.2)
    assert time.monotonic() - begin < 5.0
    assert sensor.calls == ["startup", "stop"]
    graph.stop()
    with pytest.raises(Sim2RealError, match="sensor did not end"):
        graph.start(gs)
    sensor.release.set()
    wait_for(lambda: not graph_threads())
    assert sensor.calls == ["startup", "stop", "stop"]  # once more: the step that hung may have acted since
    graph.start(gs)
    graph.stop()
    assert sensor.calls[3:] == ["startup", "stop"]


def test_a_supervisor_without_a_caller_stops_the_graph():
    sensor, agent = pair()
    graph = AsyncGraph([sensor, agent], agent, timeout_s=0.2)
    gs, _ = graph.reset(graph.init(KEY))
    time.sleep(0.4)
    assert not graph.running
    assert sensor.calls == ["startup", "stop"]
    with pytest.raises(GraphTimeout, match="waited"):
        graph.step(gs, None, Value(x=0))


@pytest.mark.parametrize("mode", ["run_for", "wait", "step"])
def test_stop_from_another_thread_or_a_node(mode):
    class Stops(Plain):
        def step(self, step_state):
            if step_state.seq == 5:
                graph.stop()
            return super().step(step_state)

    for cls in (Plain, Stops):
        sensor, agent = pair(cls)
        graph = AsyncGraph([sensor, agent], agent)
        gs = graph.init(KEY)
        later = threading.Timer(0.3 if mode == "step" else 0.15, graph.stop)
        if mode == "step":
            if cls is Plain:
                later.start()
            with pytest.raises(Sim2RealError, match="stopped"):
                step_many(graph, gs)
        else:
            graph.start(gs)
            if cls is Plain:
                later.start()  # only now: on a busy machine the start may take longer than the timer
            getattr(graph, mode)(10.0)
        graph.stop()
        assert sensor.calls in WHOLE
        assert agent.calls in WHOLE
        if mode != "step" or cls is Stops:  # else the stop may come before the first startup
            assert sensor.calls == agent.calls == ["startup", "stop"]


@pytest.mark.parametrize(("clock", "sequences"), [(Clock.SIMULATED, 940), (Clock.WALL_CLOCK, 60)])
def test_any_order_of_calls(clock, sequences):
    rng = np.random.default_rng(int(clock is Clock.SIMULATED))
    sensor, agent = pair(rate=400.0)
    options = {"duration_s": 0.2} if clock is Clock.SIMULATED else {}
    graph = AsyncGraph([sensor, agent], agent, clock, timeout_s=5.0, **options)
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
            with contextlib.suppress(UsageError):  # out of place, and said so
                calls[name]()
                made += 1
    graph.stop()
    assert made > sequences
    assert not graph_threads()
    if clock is Clock.WALL_CLOCK:
        assert sensor.calls == ["startup", "stop"] * (len(sensor.calls) // 2)
        assert len(sensor.calls) > 20


def test_garbage_is_collected_before_a_startup_may_switch_torque_on():
    """Collecting holds up every thread, the one that feeds a servo's watchdog too."""

    class Watches(Plain):
        def startup(self, graph_state, timeout=None):
            self.collecting = gc.isenabled()
            return super().startup(graph_state, timeout)

    sensor, agent = pair(Watches)
    was = gc.isenabled()
    run(sensor, agent, 0.1)
    assert was
    assert not sensor.collecting
    assert gc.isenabled()


class Motor(Plain):
    """A startup that switches torque on."""

    torque = False

    def startup(self, graph_state, timeout=None):
        self.torque = True
        return super().startup(graph_state, timeout)

    def stop(self, timeout=None):
        time.sleep(0.1)
        self.torque = False
        return super().stop(timeout)


@pytest.mark.parametrize("moment", ["compiling", "between threads", "startup"])
def test_stop_ends_a_start(moment, monkeypatch):
    """When stop() returns, torque is off and stays off, however far the start in another thread is."""
    reached, let_go = threading.Event(), threading.Event()

    def pause():
        reached.set()
        let_go.wait(20)

    class Other(Plain):
        def startup(self, graph_state, timeout=None):
            if moment == "startup":
                reached.set()
                wait_for(lambda: not graph.running)
            return super().startup(graph_state, timeout)

    def prepare(self, graph_state):
        if moment == "compiling":
            pause()
        return prepared(self, graph_state)

    def start_thread(self):
        if moment == "between threads" and self.node.name == "motor":
            pause()
        started(self)

    prepared, started = AsyncGraph._prepare, NodeThread.start
    monkeypatch.setattr(AsyncGraph, "_prepare", prepare)
    monkeypatch.setattr(NodeThread, "start", start_thread)
    other, motor = Other("other", 50), Motor("motor", 50)
    graph = AsyncGraph([other, motor], motor)
    gs, caught = graph.init(KEY), []

    def start():
        with pytest.raises(Sim2RealError, match="stopped while it started") as raised:
            graph.start(gs)
        caught.append(raised)

    starting = threading.Thread(target=start)
    starting.start()
    assert reached.wait(20)
    if moment == "startup":
        wait_for(lambda: motor.torque)
    threading.Timer(0.1, let_go.set).start()
    graph.stop()
    after = list(motor.calls)
    assert not motor.torque
    starting.join(20)
    assert caught
    assert motor.calls == after
    assert motor.calls == (["startup", "stop"] if moment == "startup" else [])
    assert not graph.running
    assert not graph_threads()


def test_a_step_that_hangs_stops_the_graph_and_is_made_safe():
    class Stuck(Motor):
        release = threading.Event()

        def step(self, step_state):
            if step_state.seq == 5:
                self.release.wait(20)
            return super().step(step_state)

    sensor, motor = Plain("sensor", 50), Stuck("motor", 50)
    motor.connect(sensor)
    graph = AsyncGraph([sensor, motor], sensor, step_timeout_s=0.5)
    begin = time.monotonic()
    graph.start(graph.init(KEY))
    wait_for(lambda: not motor.torque)  # although nobody waits for the graph
    with pytest.raises(GraphTimeout, match=r"node 'motor' hangs: its step 5 has taken 0\.5 s") as caught:
        graph.run_for(30.0)
    assert time.monotonic() - begin < 10.0
    assert not getattr(caught.value, "__notes__", []), "said once"
    assert sensor.calls == motor.calls == ["startup", "stop"]
    motor.release.set()
    wait_for(lambda: not graph_threads())
    assert motor.calls == ["startup", "stop", "stop"]


def test_how_long_a_step_may_take():
    nodes = {n.name: n for n in (Plain("fast", 50), Plain("slow", 2))}
    assert step_limits(nodes, None) == {"fast": 1.0, "slow": 5.0}
    assert step_limits(nodes, 0.3) == {"fast": 0.3, "slow": 0.3}
    assert step_limits(nodes, 0.0) == {"fast": float("inf"), "slow": float("inf")}
    with pytest.raises(UsageError, match="step_timeout_s must be at least 0"):
        AsyncGraph(nodes, nodes["slow"], step_timeout_s=-1.0)
    with pytest.raises(UsageError, match="step_timeout_s are for the wall clock"):
        AsyncGraph(nodes, nodes["slow"], Clock.SIMULATED, duration_s=1.0, step_timeout_s=1.0)


def test_the_watchdog_does_not_count_what_the_caller_takes():
    sensor, agent = pair()
    with AsyncGraph([sensor, agent], agent, step_timeout_s=0.3) as graph:
        gs, ss = graph.reset(graph.init(KEY))
        time.sleep(0.7)
        graph.step(gs, ss, Value(x=0))


def test_ctrl_c_ends_a_startup_that_hangs():
    class Hanging(Plain):
        reached, release = threading.Event(), threading.Event()

        def startup(self, graph_state, timeout=None):
            self.reached.set()
            self.release.wait(20)
            return super().startup(graph_state, timeout)

    hanging, motor = Hanging("hanging", 50), Motor("motor", 50)
    graph = AsyncGraph([motor, hanging], motor)
    gs = graph.init(KEY)
    graph.warmup(gs)

    def interrupt():
        wait_for(lambda: motor.torque and hanging.reached.is_set())
        begun.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    begun = []
    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt) as caught:
        graph.start(gs, timeout_s=50.0)
    assert time.monotonic() - begun[0] < 5.0
    assert not motor.torque
    assert "'hanging' is still in its startup" in "".join(caught.value.__notes__)
    assert hanging.calls == ["stop"]
    hanging.release.set()
    wait_for(lambda: not graph_threads())
    assert hanging.calls == ["stop", "startup", "stop"]


def test_leaving_the_graph_does_not_hide_why():
    class BadStop(Plain):
        def stop(self, timeout=None):
            raise OSError("port")

    node = BadStop("a", 50)

    def interrupted():
        with AsyncGraph([node], node) as graph:
            graph.start(graph.init(KEY))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        interrupted()
    assert "OSError: port" in "".join(caught.value.__notes__)


def test_what_fails_on_the_way_out_becomes_a_note():
    reason = SafetyStop("too fast")
    with noted(reason):
        raise OSError("disk full")
    with noted(reason):
        raise reason
    assert reason.__notes__ == ["then: OSError: disk full"]
    with pytest.raises(KeyboardInterrupt), noted(reason):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("supervisor", "match"),
    [
        ("agent", "must be a node, not the name 'agent'. Nodes: sensor, agent"),
        (["sensor", "agent"], "must be a node, not 2 nodes. Nodes: sensor, agent"),
        (None, "must be a node, not a NoneType"),
    ],
)
def test_the_supervisor_is_one_node(supervisor, match):
    with pytest.raises(UsageError, match=match) as caught:
        AsyncGraph(list(pair()), supervisor)
    assert caught.value.hint
