"""AsyncGraph: runs the nodes of a graph step by step, on the wall clock or on a simulated clock."""

from __future__ import annotations

import atexit
import contextlib
from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.episode import Recorder
from sim2real.graph.node import BaseNode
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import check_bursts
from sim2real.runtime.clock import Clock, MonotonicClock
from sim2real.runtime.failure import noted
from sim2real.runtime.init import collect, init_graph_state, key_numbers
from sim2real.runtime.simulated import SimulatedRun
from sim2real.runtime.statistics import NodeStatistics
from sim2real.runtime.steps import NodeData, Reply, Stepper
from sim2real.runtime.wall_clock import WallClockRun
from sim2real.types import Key, PyTree

_INTERRUPTED_S = 1.0
"""Time that the nodes' ``stop`` may take when a start is interrupted, e.g. by Ctrl-C [s]."""


class AsyncGraph:
    """Runs a graph: on hardware in real time, or in simulation in the order of events.

    There are two ways to run it. After ``start``, ``run_for`` and ``wait`` let the graph run, and the supervisor makes
    its own steps. After ``reset``, as in a gym environment, each ``step`` takes the supervisor's output from the caller
    and returns the supervisor's next step state. The graph stops when ``with graph:`` is left and when the interpreter
    exits.

    A failure stops all nodes at once: each node's ``stop`` is called in the node's thread after its last step. The call
    that waits for the graph raises the failure, with the node's name; if none waits, the next call does. A step that
    hangs is a failure too: its thread is busy, so another thread calls the node's ``stop``. The same applies to a node
    that is still in its startup when the graph stops.

    Args:
        nodes: The nodes, by name or as a list.
        supervisor: The node at whose steps ``reset``, ``step`` and ``run`` return, usually the policy.
        clock: The clock; a ``MonotonicClock`` is the wall clock with the time of this object, e.g. of a test.
        duration_s: Length of drawn timelines [s]; the simulated clock needs this or ``timeline``.
        timeline: Timelines to play; the graph state's ``eps`` selects the episode. Simulated clock only.
        timeout_s: Longest wait of a call for the next step, and of the supervisor for its caller [s].
        step_timeout_s: Time after which a step of any node counts as hanging, which stops the graph [s]; 0: never;
            default: ten periods of its node, at least 1 s. The caller's time does not count. Wall clock only.

    Raises:
        UsageError: The nodes do not form a graph, or an option does not fit the clock.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode] | Sequence[BaseNode],
        supervisor: BaseNode,
        clock: Clock | MonotonicClock = Clock.WALL_CLOCK,
        recorder: Recorder | None = None,
        duration_s: float | None = None,
        timeline: Timeline | None = None,
        timeout_s: float = 30.0,
        step_timeout_s: float | None = None,
    ) -> None:
        self.nodes = collect(nodes, supervisor)
        self.supervisor = supervisor
        own_time = isinstance(clock, MonotonicClock)
        self.clock = Clock.WALL_CLOCK if own_time else Clock(clock)
        self._monotonic = clock if own_time else MonotonicClock()
        self.recorder = recorder
        self._duration_s, self._timeline = duration_s, timeline
        self._timeout_s, self._step_timeout_s = timeout_s, step_timeout_s
        self._steppers = {name: Stepper(node) for name, node in self.nodes.items()}
        self._jit = True
        self._run: WallClockRun | SimulatedRun | None = None
        self._run_data: dict[str, NodeData] = {}
        self._lock = self._monotonic.lock()
        self._stops = 0
        self._check_options()

    def init(
        self, rng: Key | None, params: Mapping[str, PyTree] | None = None, order: Sequence[str] | None = None
    ) -> GraphState:
        """Return the state in which the graph starts; see ``init_graph_state`` for the arguments."""
        return init_graph_state(self.nodes, self.supervisor, rng, params, order)

    def warmup(self, graph_state: GraphState, jit_step: bool = True) -> None:
        """Compile all steps ahead of time for graph states like this one, unless they are compiled already.

        A step without side effects is then run once, which fills caches. A step with a callback or in plain Python is
        not run.

        Args:
            jit_step: Whether to compile the steps; nodes with ``jittable = False`` are never compiled.

        Raises:
            UsageError: A step's results do not fit its node's state or default output.
        """
        self._jit = jit_step
        self._prepare(graph_state)

    def start(self, graph_state: GraphState, timeout_s: float = 60.0) -> None:
        """Start an episode in which the supervisor's ``step`` is called like that of every other node.

        Args:
            timeout_s: Longest time of the nodes' startups [s]; after a failure, stopping may take as long again.

        Raises:
            UsageError: The graph is running.
            Sim2RealError: A startup failed, or another thread stopped the graph meanwhile. All nodes are then stopped.
        """
        if self.running:
            raise UsageError("the graph is running", hint="call stop() first")
        self._start(graph_state, autonomous=True, timeout_s=timeout_s)

    def stop(self, timeout_s: float = 10.0) -> None:
        """Stop the graph, at any time and from any thread; without effect on a stopped graph.

        A start in progress is ended too: after this call no node's startup is running or will run. Do not call this in
        a signal handler: raise an exception there, as Ctrl-C does, and leaving ``with graph:`` stops the graph.

        Raises:
            Sim2RealError: The failure that stopped the graph, if no call has raised it yet; or a node did not end.
        """
        with self._lock:
            self._stops += 1
            run = self._run
        try:
            if run is not None:
                run.stop(timeout_s)
        finally:
            if run is None or run.stopped:  # after an interruption, the interpreter's exit tries again
                atexit.unregister(self.stop)

    def run_for(self, duration_s: float) -> GraphState:
        """Let the graph run for ``duration_s``, with the supervisor's own ``step``; return the graph's state.

        On the simulated clock all steps are made that start within the next ``duration_s`` seconds. Returns early if
        another thread stops the graph. If the graph was started with ``reset``, the caller makes the steps again
        afterwards.
        """
        run = self._running()
        run.run_for(duration_s)
        return run.snapshot()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the graph is stopped, or reaches the end of the simulated timeline; False after a timeout."""
        if self._run is None:
            raise UsageError("the graph is not running", hint="call start() first")
        return self._run.wait(timeout_s)

    def reset(self, graph_state: GraphState, timeout_s: float = 60.0) -> tuple[GraphState, StepState]:
        """Start an episode, after stopping a running one; return the supervisor's first step state."""
        self.stop()
        run = self._start(graph_state, autonomous=False, timeout_s=timeout_s)
        step_state = run.observe(self._timeout_s)
        return run.snapshot(), step_state

    def step(
        self, graph_state: GraphState, step_state: StepState | None = None, output: PyTree = None
    ) -> tuple[GraphState, StepState]:
        """Make the supervisor's step and return its next step state.

        Args:
            graph_state: Without effect, as the nodes keep their states while the graph runs; ``CompiledGraph.step`` has
                the same signature.
            step_state: The supervisor's step state after the step; None: unchanged.
            output: The step's output; None: the supervisor's ``step`` is called.

        Raises:
            UsageError: ``reset`` was not called, the timeline is at its end, or the output does not have the form of
                the supervisor's default output (the same step can then be made again).
            GraphTimeout: There was no next step in time.
        """
        del graph_state
        run = self._running()
        run.observe(self._timeout_s)
        run.reply(self._reply(step_state, output))
        observed = run.observe(self._timeout_s)
        return run.snapshot(), observed

    def run(self, graph_state: GraphState) -> GraphState:
        """Run until the supervisor's own ``step`` has made its next step; start the graph if it is stopped."""
        run = self._run if self.running and self._run else self._restart(graph_state)
        run.observe(self._timeout_s)
        run.settle(run.reply(Reply()), self._timeout_s)
        return run.snapshot()

    @property
    def running(self) -> bool:
        """Whether an episode is running."""
        return self._run is not None and not self._run.ended

    @property
    def graph_state(self) -> GraphState:
        """The state of the running episode, or of the last one, after the last finished step of each node."""
        if self._run is None:
            raise UsageError("the graph has not run", hint="call start() or reset()")
        return self._run.snapshot()

    def statistics(self) -> dict[str, NodeStatistics]:
        """Return timing statistics of each node in the running episode, or in the last one."""
        return {} if self._run is None else self._run.statistics()

    def __enter__(self) -> AsyncGraph:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        with contextlib.nullcontext() if error is None else noted(error):
            self.stop()

    def _check_options(self) -> None:
        # Options of one clock only, and their ranges.
        simulated = self.clock is Clock.SIMULATED
        if simulated:
            if (self._duration_s is None) == (self._timeline is None):
                raise UsageError("the simulated clock takes a duration_s or a timeline, one of them")
            if self._step_timeout_s is not None:
                raise UsageError("step_timeout_s is for the wall clock")
        elif self._duration_s is not None or self._timeline is not None:
            raise UsageError("duration_s and timeline are for the simulated clock")
        if not ((self._step_timeout_s or 0.0) >= 0 and self._timeout_s > 0):
            raise UsageError("step_timeout_s must be at least 0, timeout_s must be positive")

        # Averaged inputs.
        for node in self.nodes.values():
            averaged = [c for c in node.inputs.values() if c.averaged]
            if averaged and not simulated:
                raise UsageError(
                    f"node {node.name!r}: input {averaged[0].name!r} averages over messages of the tick that has only "
                    "begun (interp='zoh_mean'), which the wall clock cannot",
                    hint="use interp='zoh', or leave simulated worlds out of a graph on the wall clock",
                )

        # The timeline has all nodes and connections.
        if self._timeline is not None:
            missing = [n for n in self.nodes if n not in self._timeline.vertices]
            edges = {(n, i) for n, node in self.nodes.items() for i in node.inputs}
            if missing or not edges <= set(self._timeline.edges):
                lacks = missing or [f"{n}/{i}" for n, i in edges - set(self._timeline.edges)]
                raise UsageError(
                    f"the timeline lacks {', '.join(lacks)}",
                    hint="draw the missing parts: sim2real.graph.schedule.draw(nodes, duration_s, recorded=timeline)",
                )

    def _prepare(self, graph_state: GraphState) -> dict[str, NodeData]:
        simulated = self.clock is Clock.SIMULATED
        data = {name: NodeData(node, graph_state, simulated) for name, node in self.nodes.items()}
        for name, stepper in self._steppers.items():
            stepper.prepare(data[name], self._jit)
        return data

    def _start(self, graph_state: GraphState, autonomous: bool, timeout_s: float) -> WallClockRun | SimulatedRun:
        stops = self._stops
        if self._run is not None:
            self._run.check()
            if self._run.alive:
                raise Sim2RealError(
                    f"{', '.join(self._run.alive)} did not end when the graph was stopped, and may still act",
                    hint="start a new process",
                )

        # Compile the steps, and make the run.
        data = self._prepare(graph_state)
        common = (self.nodes, self.supervisor.name, self._steppers, data, graph_state, self.recorder, autonomous)
        if self.clock is Clock.SIMULATED:
            run = SimulatedRun(*common, *self._timeline_of(graph_state))
        else:
            run = WallClockRun(*common, self._monotonic, self._timeout_s, self._step_timeout_s)

        # Publish the run, so that stop() in another thread finds it; then begin.
        with self._lock:
            if self._stops != stops:
                raise Sim2RealError("the graph was stopped while it started", hint="call start() or reset() again")
            self._run, self._run_data = run, data
        atexit.register(self.stop)
        try:
            run.begin(timeout_s)
        except BaseException as error:
            # Ctrl-C must be raised unchanged, and soon, even if a startup hangs and the stop fails.
            with noted(error):
                self.stop(timeout_s if isinstance(error, Exception) else min(timeout_s, _INTERRUPTED_S))
            raise
        return run

    def _timeline_of(self, graph_state: GraphState) -> tuple[Timeline, int]:
        """Return the timelines and the index of the episode to play.

        Timelines that are drawn here depend only on the graph state's ``eps`` and the supervisor's key.
        """
        eps = int(graph_state.eps)
        if self._timeline is not None:
            if not 0 <= eps < self._timeline.episodes:
                raise UsageError(f"there is no episode {eps}: the timeline has {self._timeline.episodes}")
            check_bursts(self.nodes, self._timeline[[eps]], graph_state.delays)
            return self._timeline, eps
        seed = [int(graph_state.eps), *key_numbers(graph_state.rng[self.supervisor.name])]
        timeline = draw(self.nodes, self._duration_s or 0.0, 1, np.random.default_rng(seed))
        check_bursts(self.nodes, timeline, graph_state.delays)
        return timeline, 0

    def _running(self) -> WallClockRun | SimulatedRun:
        if self._run is None:
            raise UsageError("the graph is not running", hint="call start() or reset() first")
        self._run.check()
        if self._run.ended:
            self._run.check()  # the run may have failed since the first check
            raise UsageError("the graph has been stopped", hint="call start() or reset() to run it again")
        return self._run

    def _restart(self, graph_state: GraphState) -> WallClockRun | SimulatedRun:
        self.stop()
        return self._start(graph_state, autonomous=False, timeout_s=self._timeout_s)

    def _reply(self, step_state: StepState | None, output: PyTree) -> Reply:
        if output is None:
            return Reply(step_state)
        return Reply(step_state, self._run_data[self.supervisor.name].form.pack(output))
