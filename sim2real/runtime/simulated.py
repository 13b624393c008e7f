"""A graph on the simulated clock: runs the steps of a timeline in order, on the caller's thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.delays import TrainableDist
from sim2real.graph.episode import MessageRecord, Recorder, StepRecord
from sim2real.graph.node import TICKS_PER_S, BaseNode, to_ticks
from sim2real.graph.rules import at_delay, next_drift, slot
from sim2real.graph.schedule import topological
from sim2real.graph.timeline import Timeline
from sim2real.graph.times import Edge
from sim2real.runtime.failure import GraphTimeout, named
from sim2real.runtime.statistics import NodeStatistics, StepLog
from sim2real.runtime.steps import Message, NodeData, Reply, Result, Stepper, overwritten, snapshot

_NEVER = 2**62


class _Link:
    """One connection of the timeline: the messages that each step consumes, and those that the log records.

    The two differ for a trainable delay. The window takes messages in as if the delay were the smallest, and the step
    picks those that have arrived at the current delay; the log has the arrivals at the current delay.
    """

    def __init__(self, edge: Edge, recorded: Edge, episode: int, steps: int) -> None:
        self.waiting: dict[int, list[np.ndarray]] = {}
        self.sender = edge.sender
        self.recorded_received: list[int] = recorded.received[episode].tolist()
        self.recorded_seq_in: list[int] = recorded.seq_in[episode].tolist()
        self._recorded = np.flatnonzero(recorded.seq_in[episode] >= 0)
        self._recorded_bounds = np.searchsorted(recorded.seq_in[episode][self._recorded], np.arange(steps + 1)).tolist()
        self.received: list[int] = edge.received[episode].tolist()
        self.seq_in: list[int] = edge.seq_in[episode].tolist()
        self.used = np.flatnonzero(edge.seq_in[episode] >= 0)
        self.bounds: list[int] = np.searchsorted(edge.seq_in[episode][self.used], np.arange(steps + 1)).tolist()

    def consumed(self, k: int) -> list[int]:
        """Return the messages that step ``k`` consumes, oldest first."""
        return self.used[self.bounds[k] : self.bounds[k + 1]].tolist()

    def recorded(self, k: int) -> list[int]:
        """Return the messages that step ``k`` consumes in the log, oldest first."""
        return self._recorded[self._recorded_bounds[k] : self._recorded_bounds[k + 1]].tolist()

    def put(self, m: int, leaves: list[np.ndarray]) -> None:
        """Store message ``m`` if a step will consume it."""
        if self.seq_in[m] >= 0:
            self.waiting[m] = leaves


class _Player:
    """One node's steps in the timeline; ``k`` is the next one."""

    def __init__(self, stepper: Stepper, data: NodeData, timeline: Timeline, episode: int) -> None:
        self.stepper, self.data = stepper, data
        node, vertex = stepper.node, timeline.vertices[stepper.node.name]
        steps = int(vertex.count[episode])
        self.begins: list[int] = [*vertex.start[episode, :steps].tolist(), _NEVER]
        self.ends: list[int] = vertex.end[episode, :steps].tolist()
        self.slots: list[int] = slot(node, np.arange(steps + 1)).tolist()
        self.links = {
            i: _Link(timeline.edges[node.name, i], _recorded_edge(data, i, timeline), episode, steps)
            for i in node.inputs
        }
        self.outputs: list[_Link] = []
        self.k = 0
        self.drift = 0
        # With a trainable delay the step itself picks the message; the timeline does not say which.
        self.log = StepLog(n for n, c in node.inputs.items() if not c.trainable)

    def blocked(self, k: int) -> int:
        """Return the last arrival among the messages that step ``k`` waited for [ticks]; 0 if there are none."""
        awaited = [link for name, link in self.links.items() if self.stepper.node.inputs[name].blocking]
        return max((link.received[m] for link in awaited for m in link.consumed(k)[-1:]), default=0)

    def ready(self, players: Mapping[str, _Player]) -> bool:
        """Return whether all messages that the next step consumes have been sent."""
        for link in self.links.values():
            last = link.bounds[self.k + 1]
            if last and link.used[last - 1] >= players[link.sender].k:
                return False
        return True


def _recorded_edge(data: NodeData, name: str, timeline: Timeline) -> Edge:
    """Return an input's messages at its current delay, which for a trainable delay may differ from the timeline's."""
    node = data.node
    edge, dist = timeline.edges[node.name, name], data.windows[name].state.delay_dist
    if not isinstance(dist, TrainableDist):
        return edge
    reader, sender = timeline.vertices[node.name], timeline.vertices[edge.sender]
    return at_delay(node.inputs[name], edge, reader, sender, to_ticks(float(dist.delay)))


class SimulatedRun:
    """One episode on the simulated clock.

    Args:
        recorder: Receives all steps and messages, or None.
    """

    def __init__(
        self,
        nodes: Mapping[str, BaseNode],
        supervisor: str,
        steppers: Mapping[str, Stepper],
        data: dict[str, NodeData],
        graph_state: GraphState,
        recorder: Recorder | None,
        autonomous: bool,
        timeline: Timeline,
        episode: int,
    ) -> None:
        self._nodes, self._supervisor, self._data = nodes, supervisor, data
        self._graph_state, self._recorder, self._autonomous = graph_state, recorder, autonomous
        # Senders before readers: of two steps that start at the same time, the sender's comes first.
        self._players = {n: _Player(steppers[n], data[n], timeline, episode) for n in topological(nodes)}
        for player in self._players.values():
            for link in player.links.values():
                self._players[link.sender].outputs.append(link)
        self._now = 0
        self._pending: StepState | None = None
        self._stopping = threading.Event()
        self._stop_lock = threading.Lock()
        self.stopped = False

    @property
    def ended(self) -> bool:
        """Whether the graph has stopped."""
        return self._stopping.is_set()

    @property
    def alive(self) -> list[str]:
        """Nodes whose threads have not ended: none, as this runtime has no threads."""
        return []

    def begin(self, timeout_s: float) -> None:
        """Start the clock."""
        del timeout_s
        for node in self._nodes.values():
            node.set_clock(lambda: self._now / TICKS_PER_S)
        if self._recorder is not None:
            self._recorder.start(time.time_ns(), time.monotonic_ns())

    def observe(self, timeout_s: float) -> StepState:
        """Run the graph to the supervisor's next step and return its step state."""
        if self._autonomous:
            raise UsageError(
                f"the supervisor {self._supervisor!r} makes its own steps",
                hint="call reset() instead of start() to make them yourself",
            )
        # Run events until the supervisor has a step to make.
        deadline = time.monotonic() + timeout_s
        player = self._players[self._supervisor]
        while self._pending is None:
            if player.begins[player.k] == _NEVER:
                raise UsageError(
                    f"the timeline ends after step {player.k - 1} of the supervisor {self._supervisor!r}",
                    hint="reset the graph, or give AsyncGraph a longer duration_s or timeline",
                )
            if time.monotonic() > deadline:
                raise GraphTimeout(f"no step of the supervisor {self._supervisor!r} within {timeout_s:g} s")
            if self.ended:
                raise Sim2RealError("the graph was stopped while a step was awaited", hint="call reset()")
            self._event()
        return self._pending

    def reply(self, reply: Reply) -> int:
        """Make the supervisor's step with the caller's reply; return its number of steps."""
        offered, self._pending = self._pending, None
        if offered is None:
            raise UsageError("no step is on offer", hint="call reset() first")
        player = self._players[self._supervisor]
        self._make(player, offered, reply)
        return player.k

    def settle(self, finished: int, timeout_s: float) -> None:
        """Do nothing: a step is finished when ``reply`` returns."""

    def run_for(self, duration_s: float) -> None:
        """Run all steps that start within the next ``duration_s``, with the supervisor's own ``step``."""
        self._run_until(self._now + to_ticks(duration_s), None)

    def wait(self, timeout_s: float | None) -> bool:
        """Run to the timeline's end; return whether it was reached in time."""
        return self._run_until(_NEVER - 1, None if timeout_s is None else time.monotonic() + timeout_s)

    def check(self) -> None:
        """Do nothing: a failure is raised where it happens."""

    def stop(self, timeout_s: float) -> None:
        """End the episode."""
        del timeout_s
        self._stopping.set()
        with self._stop_lock:
            if self.stopped:
                return
            self.stopped = True
        # Record the messages that no step consumed.
        for node in self._nodes.values():
            node.set_clock(None)
        if self._recorder is not None:
            for player in self._players.values():
                for name, link in player.links.items():
                    for m in range(self._players[link.sender].k):
                        if not 0 <= link.recorded_seq_in[m] < player.k:
                            self._recorder.message(self._message_record(player, name, m, -1))

    def snapshot(self) -> GraphState:
        """Return the graph's state as of each node's last finished step."""
        return snapshot(self._graph_state, self._data, self._supervisor)

    def statistics(self) -> dict[str, NodeStatistics]:
        """Return timing statistics of each node, in simulated time."""
        return {name: self._players[name].log.summary() for name in self._nodes}

    def _run_until(self, limit: int, deadline: float | None) -> bool:
        """Run all steps that start before ``limit`` [ticks]; return False if ``deadline`` [s] came first."""
        autonomous, self._autonomous = self._autonomous, True
        try:
            if self._pending is not None:
                self.reply(Reply())
            while not self.ended and min(p.begins[p.k] for p in self._players.values()) < limit:
                if deadline is not None and time.monotonic() > deadline:
                    return False
                self._event()
        finally:
            self._autonomous = autonomous
        self._now = max(self._now, limit) if limit < _NEVER - 1 else self._now
        return True

    def _event(self) -> None:
        """Make the next step, or offer it to the caller if it is the supervisor's; do nothing in a stopped graph."""
        # Choose the earliest step whose messages have all been sent.
        ready = [p for p in self._players.values() if p.begins[p.k] < _NEVER and p.ready(self._players)]
        if not ready:
            raise Sim2RealError(
                "no node can step: the timeline has steps that wait for messages without a sender",
                hint="draw it with sim2real.graph.schedule.draw for these nodes",
            )
        player = min(ready, key=lambda p: p.begins[p.k])  # at equal times, the first node in the graph's order
        begin = player.begins[player.k]
        self._now = max(self._now, begin)
        # Take in the messages that the step consumes.
        for name, link in player.links.items():
            messages = [self._message(link, m) for m in link.consumed(player.k)]
            player.data.windows[name].push(messages)
            if not player.data.node.inputs[name].trainable:
                player.log.read(name, begin, messages[-1].sent if messages else None)
        step_state = player.data.step_state(player.k, begin)
        if player.data.node.name == self._supervisor and not self._autonomous:
            self._pending = step_state
        else:
            self._make(player, step_state, Reply())

    def _make(self, player: _Player, offered: StepState, reply: Reply) -> None:
        """Make a step, send its output and record it."""
        # Make the step; an exception ends the episode.
        node, k = player.data.node, player.k
        begin, end = player.begins[k], player.ends[k]
        ages = player.data.ages(begin)
        try:
            result = player.stepper.answer(player.data, offered, ages, reply)
            moved = overwritten(result.ts, begin, end, node.name)
        except Exception as error:
            self.stop(0.0)
            failure = named(error, node.name, f"step {k}")
            raise failure from failure.__cause__

        # Send the output, then update the drift, the statistics and the log.
        player.k += 1
        for link in player.outputs:
            link.put(k, result.leaves)
        player.data.keep(result.changed)
        before = player.ends[k - 1] if k else 0
        later = int(next_drift(node.scheduling, player.slots[k], player.drift, before))
        player.log.add(begin, begin, before > max(player.slots[k] + player.drift, player.blocked(k)))
        self._record(player, k, moved, result)
        player.drift = later

    def _record(self, player: _Player, k: int, moved: int, result: Result) -> None:
        if self._recorder is None:
            return
        begin, name = player.begins[k], player.data.node.name
        record = StepRecord(name, k, player.slots[k], begin, begin, moved, player.ends[k], player.drift)
        self._recorder.step(record, player.data.form.unpack(result.leaves))
        for input_name, link in player.links.items():
            for m in link.recorded(k):
                self._recorder.message(self._message_record(player, input_name, m, k))

    def _message(self, link: _Link, m: int) -> Message:
        sender = self._players[link.sender]
        return Message(m, sender.ends[m], link.received[m], link.waiting.pop(m))

    def _message_record(self, player: _Player, name: str, m: int, seq_in: int) -> MessageRecord:
        link = player.links[name]
        sent = self._players[link.sender].ends[m]
        return MessageRecord(player.data.node.name, name, m, seq_in, sent, link.recorded_received[m])
