"""A second, slow implementation of the timing rules, message by message in Python integers, to test schedule.py."""

import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import cached_property
from typing import TypeVar

from oracles.hash_nodes import as_message, hash_step, mix

from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode, Connection, Jitter, Scheduling
from sim2real.graph.timeline import Timeline

T = TypeVar("T")
Windows = list[tuple[str, list[tuple[int, int, float]]]]
"""The inputs of a step, in the order of their names: the sender, and the entries of ``Reference.window``."""
Step = Callable[[int, T, Windows, Mapping[str, list[T]]], T]
"""Number of the step, state before, windows, all states so far -> state after."""


class Reference:
    """One episode of a graph, computed from its delays alone.

    Args:
        timeline: Source of the computation and communication delays and of the number of steps.

    Attributes:
        starts: Node -> start of each step [ticks].
        ends: Node -> end of each step [ticks].
        seq_in: (node, input) -> which step consumes each message; -1 if none does.
    """

    def __init__(self, nodes: Mapping[str, BaseNode], timeline: Timeline, episode: int = 0) -> None:
        self.nodes = nodes
        self.count = {n: int(timeline.vertices[n].count[episode]) for n in nodes}
        vertices = {n: timeline.vertices[n] for n in nodes}
        # Delays as plain numbers, from the timeline.
        self.busy = {n: [int(d) for d in (v.end - v.start)[episode]] for n, v in vertices.items()}
        self.travel = {
            (n, i): [int(d) for d in (e.received - vertices[e.sender].end)[episode]]
            for (n, i), e in timeline.edges.items()
        }
        self.starts: dict[str, list[int]] = {n: [] for n in nodes}
        self.ends: dict[str, list[int]] = {n: [] for n in nodes}
        self._received: dict[tuple[str, str], list[int]] = {key: [] for key in self.travel}
        self._drift = dict.fromkeys(nodes, 0)
        # Advance nodes until none can start another step.
        while any([self._advance(n) for n in nodes]):
            pass
        self.seq_in = {(n, i): self._consumers(c) for n, node in nodes.items() for i, c in node.inputs.items()}

    def phase(self, node: BaseNode) -> int:
        """Return a node's phase [ticks] (rule 1)."""
        return max([0, *(self.arrival(c) for c in node.inputs.values() if not c.skip)])

    def arrival(self, c: Connection) -> int:
        """Return the phase of a connection: the nominal arrival of its first message [ticks] (rule 1)."""
        return self.phase(c.output_node) + round(c.output_node.delay * 1e6) + round(c.delay * 1e6)

    def slot(self, node: BaseNode, k: int) -> int:
        """Return the slot of step ``k`` [ticks] (rule 2)."""
        return math.floor(Fraction(k * 1_000_000) / Fraction(node.rate) + Fraction(1, 2)) + self._phases[node.name]

    def group(self, c: Connection, k: int) -> list[int]:
        """Return the messages of a blocking input that step ``k`` waits for (rule 6)."""
        out, high = [], self.slot(c.input_node, k)
        low = self.slot(c.input_node, k - 1) if k else None
        for i in range(len(self.busy[c.output_node.name])):
            s = self.slot(c.output_node, i)
            if s > high:
                break
            after = low is None or (s >= low if c.skip else s > low)
            if after and not (c.skip and s == high):
                out.append(i)
        return out

    def received(self, c: Connection, i: int) -> int:
        """Return when message ``i`` is received [ticks] (rule 5)."""
        key = c.input_node.name, c.name
        arrivals = self._received[key]
        while len(arrivals) <= i:
            m = len(arrivals)
            direct = self.ends[c.output_node.name][m] + self.travel[key][m]
            arrivals.append(max([direct, *arrivals[-1:]]))
        return arrivals[i]

    def window(self, node: str, name: str, k: int) -> list[tuple[int, int, float]]:
        """Return the entries of the window that a step sees on an input, oldest first (rule 7).

        An entry is the message that holds; the next one; and the weight of the next one, above 0 between two messages
        of a trainable delay with ``linear``. -1 is the default output.
        """
        c = self.nodes[node].inputs[name]
        messages = [-1] * c.window + [m for m, s in enumerate(self.seq_in[node, name]) if 0 <= s <= k]
        dist = c.delay_dist
        if not isinstance(dist, TrainableDist):
            return [(m, m, 0.0) for m in messages[-c.window :]]
        delay, ends, start = round(float(dist.delay) * 1e6), self.ends[c.output_node.name], self.starts[node][k]
        before = 0 if dist.interp == "linear" else -(10**15)
        arrival = [ends[m] + delay if m >= 0 else before for m in messages]

        def last(t: int) -> int:
            come = (m < 0 or (at < t if c.skip else at <= t) for m, at in zip(messages, arrival, strict=True))
            return max(i for i, here in enumerate(come) if here)

        newest = max(last(start), c.window - 1)
        entries = []
        for i in range(newest - c.window + 1, newest + 1):
            t = start - arrival[newest] + arrival[i]
            held = last(t) if dist.interp == "linear" else i
            following = held + 1 if dist.interp == "linear" and held + 1 < len(messages) else held
            span = arrival[following] - arrival[held]
            weight = min(1.0, max(0.0, (t - arrival[held]) / span)) if span else 0.0
            entries.append((messages[held], messages[following], weight))
        return entries

    def message(self, node: str, state: int) -> int:
        """Return the number that a hash node sends in a state."""
        return as_message(mix(state, 7), getattr(self.nodes[node], "dtype", "uint32"))

    def hashes(self, states: Mapping[str, int], outputs: Mapping[str, int]) -> dict[str, list[int]]:
        """Return the state of each hash node after each of its steps."""

        def step(k: int, state: int, windows: Windows, made: Mapping[str, list[int]]) -> int:
            read = []
            for sender, entries in windows:
                seqs = [held for held, _, _ in entries]
                values = [self.message(sender, made[sender][m]) if m >= 0 else outputs[sender] for m in seqs]
                read.append((seqs, values))
            return hash_step(state, k, read)[0]

        return self._play(step, states)

    def floats(self, states: Mapping[str, float], outputs: Mapping[str, float]) -> dict[str, list[float]]:
        """Return the state of each contraction (``contractions``) after each of its steps, in double precision."""

        def step(k: int, state: float, windows: Windows, made: Mapping[str, list[float]]) -> float:
            means = []
            for sender, entries in windows:
                pairs = [[math.tanh(made[sender][m]) if m >= 0 else outputs[sender] for m in e[:2]] for e in entries]
                values = [a + e[2] * (b - a) for (a, b), e in zip(pairs, entries, strict=True)]
                means.append(sum(values) / len(values))
            return 0.5 * state + 0.4 * sum(means) / max(len(means), 1) + math.sin(1.3 * k)

        return self._play(step, states)

    def _play(self, step: Step[T], states: Mapping[str, T]) -> dict[str, list[T]]:
        """Make all steps, each after those whose messages it reads; return the states after them."""
        made: dict[str, list[T]] = {n: [] for n in self.nodes}
        order = [
            (k, n, [(c.output_node.name, self.window(n, i, k)) for i, c in sorted(self.nodes[n].inputs.items())])
            for _, k, n in sorted((self.starts[n][k], k, n) for n in self.nodes for k in range(self.count[n]))
        ]
        while order:  # steps that start at the same time may need each other's outputs: repeat until all are done
            waiting = []
            for k, n, windows in order:
                known = all(m < len(made[sender]) for sender, entries in windows for e in entries for m in e[:2])
                if known and len(made[n]) == k:
                    made[n].append(step(k, made[n][-1] if k else states[n], windows, made))
                else:
                    waiting.append((k, n, windows))
            if len(waiting) == len(order):
                raise ValueError(f"steps wait for each other: {waiting[:4]}")
            order = waiting
        return made

    @cached_property
    def _phases(self) -> dict[str, int]:
        return {n: self.phase(node) for n, node in self.nodes.items()}

    def _advance(self, name: str) -> bool:
        """Compute start and end of a node's next step (rules 3 and 4); False if it has none or cannot be known yet."""
        node, starts, ends = self.nodes[name], self.starts[name], self.ends[name]
        k, blocked = len(starts), 0
        if k == len(self.busy[name]):
            return False
        # Wait for the messages of the blocking inputs.
        for c in node.inputs.values():
            if c.blocking:
                group = self.group(c, k)
                if group and group[-1] >= len(self.ends[c.output_node.name]):
                    return False
                if group:
                    blocked = max(blocked, self.received(c, group[-1]))
        # Start at the schedule, unless all inputs are blocking and the node advances.
        previous = ends[-1] if ends else 0
        begin = max(previous, blocked)
        if not (node.advance and all(c.blocking for c in node.inputs.values())):
            begin = max(begin, self.slot(node, k) + self._drift[name])
        # An overrun moves the later schedule.
        if node.scheduling is Scheduling.FREQUENCY:
            self._drift[name] += max(0, previous - self.slot(node, k) - self._drift[name])
        starts.append(begin)
        ends.append(begin + self.busy[name][k])
        return True

    def _consumers(self, c: Connection) -> list[int]:
        """Return which step consumes each message; -1 if none does."""
        name = c.input_node.name
        sent = self.count[c.output_node.name]
        out, head = [-1] * sent, 0
        for k in range(self.count[name]):
            group = self.group(c, k) if c.blocking else []
            while head < sent and (head in group if c.blocking else self._takes(c, k, head)):
                out[head] = k
                head += 1
        return out

    def _takes(self, c: Connection, k: int, message: int) -> bool:
        """Return whether step ``k`` takes a message of a non-blocking input, all earlier ones being taken (rule 6)."""
        t, r = self.starts[c.input_node.name][k], self.received(c, message)
        if c.averaged:
            return r < t + round(c.input_node.delay * 1e6)
        arrived = r < t if c.skip else r <= t
        if c.jitter is Jitter.BUFFER:
            nominal = self.slot(c.output_node, message) - self._phases[c.output_node.name] + self.arrival(c)
            arrived = arrived and nominal <= t
        return arrived
