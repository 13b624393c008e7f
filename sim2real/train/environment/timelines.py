"""Timelines for training, drawn from how long everything took on the robot, with its pauses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import TICKS_PER_S, BaseNode
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import bursty_episodes
from sim2real.runtime.compilation.placement import Placement, Placer

STRETCH_S = 1.0
"""Length of what is taken from a recording in one piece [s]: hiccups of a computer last tens of milliseconds."""
_PAUSES = (np.inf, 3.0, 2.0, 1.5, 1.25)
"""Longest pauses between two policy steps that are tried, in periods."""
_LONG = 0.25
"""Steps that took longer than this share of the policy's period are left out where an episode is over."""
_SHORTEST = 0.5
"""Timelines with a pause in this share of the episode, from its start, are drawn again."""
_ROUNDS = 20


@dataclass
class Stretches:
    """Where in the recording the stretches begin: at the same moments for all nodes and connections.

    A hiccup of the computer hits all nodes at once. So what the nodes did at the same time stays together.

    Attributes:
        seed: Of the moments.
        pauses: Whether long steps are kept at all.
        calm_s: Shape ``(E,)``: from when on an episode has no long steps [s]; None: never.
    """

    seed: int
    pauses: bool = True
    calm_s: np.ndarray | None = field(default=None)

    def begins(self, episodes: int, count: int) -> np.ndarray:
        """Return where stretches begin, as a share of the recording, ``(episodes, count)``."""
        return np.random.default_rng(self.seed).random((count, episodes)).T  # in this order: more of them begin alike


class RecordedTimes(DelayDistribution):
    """Recorded times, taken in stretches that all nodes share.

    Args:
        samples: Shape ``(N,)``: what each step or message took [s], in their order.
        rate_hz: How many there are a second [Hz].
        long_s: Longer ones are replaced by the median from ``calm_s`` on [s].
    """

    def __init__(self, samples: np.ndarray, rate_hz: float, stretches: Stretches, long_s: float) -> None:
        self.samples, self.rate_hz, self.stretches, self.long_s = samples, rate_hz, stretches, long_s

    def __repr__(self) -> str:
        return f"RecordedTimes({self.samples.size} samples, {self.rate_hz:g} Hz)"

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return times [s] for E episodes, shape ``(E, N)``; the stretches say which."""
        del rng
        episodes, length = shape
        size = min(max(1, round(STRETCH_S * self.rate_hz)), self.samples.size)
        begins = self.stretches.begins(episodes, -(-length // size)) * (self.samples.size - size)
        index = np.round(begins).astype(int)[..., None] + np.arange(size)
        times = self.samples[index].reshape(episodes, -1)[:, :length]
        if self.stretches.calm_s is None:
            return times
        over = np.arange(length) / self.rate_hz >= self.stretches.calm_s[:, None] - 1.0 / self.rate_hz
        return np.where(over & (times > self.long_s), np.median(self.samples), times)

    def quantile(self, q: float) -> float:
        """Return a quantile of the record [s]."""
        return float(np.quantile(self.samples, q))


@dataclass(frozen=True)
class Recorded:
    """How long everything took on the robot, as nodes of a simulation can be told.

    Attributes:
        stretches: Where times are taken from.
        computation: Node -> distribution of what its steps take.
        transport: (reader, input) -> distribution of what its messages take.
    """

    stretches: Stretches
    computation: Mapping[str, DelayDistribution]
    transport: Mapping[tuple[str, str], DelayDistribution]

    @staticmethod
    def of(timing: Timing, rate_hz: float, seed: int, pauses: bool = True) -> Recorded:
        """Return the times of a recording.

        Args:
            rate_hz: The policy's rate [Hz].
            pauses: Whether the robot's pauses are kept; otherwise steps of more than a quarter of the period are left
                out.

        Raises:
            Sim2RealError: When most steps of a node took so long that no policy of this rate runs in time.
        """
        stretches, long_s = Stretches(seed, pauses), _LONG / rate_hz
        timing.computation(long_s)
        span_s = max((n.steps * (n.period.p50 or 0.0) for n in timing.nodes.values()), default=0.0)

        def times(samples: np.ndarray) -> RecordedTimes | None:
            there = samples[np.isfinite(samples) & (samples >= 0.0)]
            return RecordedTimes(there, there.size / span_s, stretches, long_s) if there.size > 1 and span_s else None

        computation = {n: d for n, s in timing.steps_s.items() if (d := times(s)) is not None}
        transport = {tuple(k.split("/", 1)): d for k, s in timing.transport_s.items() if (d := times(s)) is not None}
        return Recorded(stretches, computation, transport)  # type: ignore[arg-type]  # split leaves two parts

    def transport_to(self, nodes: Mapping[str, BaseNode]) -> None:
        """Make messages of the graph as late as they were; phases stay those of the nodes on the robot."""
        for (reader, name), dist in self.transport.items():
            if reader in nodes and name in nodes[reader].inputs:
                nodes[reader].inputs[name].delay_dist = dist


@dataclass(frozen=True)
class Drawn:
    """Timelines, and what became of the robot's pauses.

    Attributes:
        timeline: The timelines.
        steps: Shape ``(E,)``: after how many policy steps each episode ends.
        cut: How many of them end early, before a pause that the program cannot hold.
        again: How many were drawn again, because that would have been in their first half.
        longest_pause_s: Longest time between two policy steps in any of them [s].
    """

    timeline: Timeline
    steps: np.ndarray
    cut: int
    again: int
    longest_pause_s: float


def draw_timelines(
    nodes: Mapping[str, BaseNode], supervisor: str, episode_s: float, count: int, seed: int, recorded: Recorded | None
) -> Drawn:
    """Draw timelines.

    A row of the program holds one policy step and a fixed number of world ticks. After a pause of several periods a
    robot makes the steps that it missed one right after the other, and they do not fit into rows. Such an episode ends
    before the pause.

    Args:
        episode_s: Length of an episode [s].
        recorded: How long everything takes; None: as the nodes say.

    Raises:
        Sim2RealError: When most timelines have a pause in their first half.
    """
    if recorded is None:
        timeline = draw(nodes, episode_s, count, np.random.default_rng(seed))
        return _drawn(timeline, supervisor, timeline.vertices[supervisor].count, 0, 0)
    recorded.stretches.calm_s = np.zeros(count)
    quiet = draw(nodes, episode_s, count, seed)
    if not recorded.stretches.pauses:
        return _drawn(quiet, supervisor, quiet.vertices[supervisor].count, 0, 0)
    calm = _shape(nodes, supervisor, quiet)
    for periods in _PAUSES:
        drawn = _with_pauses(nodes, supervisor, episode_s, count, seed, recorded, periods)
        if drawn is None or bursty_episodes(nodes, drawn.timeline).any():
            continue
        if _shape(nodes, supervisor, drawn.timeline) <= calm:
            return drawn
    raise Sim2RealError(
        "nearly every timeline drawn from this log holds a pause of the policy",
        hint="record on a less busy machine, or train shorter episodes with --episode-s",
    )


def _with_pauses(
    nodes: Mapping[str, BaseNode],
    supervisor: str,
    episode_s: float,
    count: int,
    seed: int,
    recorded: Recorded,
    periods: float,
) -> Drawn | None:
    """Return timelines that end before pauses above so many periods; None: too many of them do so early."""
    kept: list[Timeline] = []
    steps: list[np.ndarray] = []
    missing, again = count, 0
    for attempt in range(_ROUNDS):
        recorded.stretches.seed, recorded.stretches.calm_s = seed + 1000 * attempt, None
        timeline, last = _cut(nodes, supervisor, episode_s, count, recorded.stretches, periods)
        good = last >= _SHORTEST * timeline.vertices[supervisor].count
        good &= np.cumsum(good) <= missing
        if good.any():
            kept.append(timeline[good])
            steps.append(last[good])
        missing -= int(good.sum())
        if not missing:
            whole, ends = Timeline.stack(kept), np.concatenate(steps)
            cut = int((ends < whole.vertices[supervisor].count).sum())
            return _drawn(whole, supervisor, ends, cut, again)
        again += missing
    return None


def _cut(
    nodes: Mapping[str, BaseNode],
    supervisor: str,
    episode_s: float,
    count: int,
    stretches: Stretches,
    periods: float,
) -> tuple[Timeline, np.ndarray]:
    """Return timelines, calm from their first pause on, and how many policy steps come before it ``(E,)``."""
    last = np.full(count, np.iinfo(np.int64).max)
    rate_hz = nodes[supervisor].rate
    while True:
        timeline = draw(nodes, episode_s, count, stretches.seed)
        vertex = timeline.vertices[supervisor]
        gaps = np.diff(vertex.start[:, : int(vertex.count.min())], axis=1)
        first = np.where(gaps > periods * TICKS_PER_S / rate_hz, np.arange(1, gaps.shape[1] + 1), last[:, None])
        earlier = first.min(axis=1, initial=np.iinfo(np.int64).max) < last
        if not earlier.any():
            return timeline, np.minimum(last, vertex.count)
        last = np.where(earlier, first.min(axis=1), last)
        before = np.take_along_axis(vertex.start, np.minimum(last, gaps.shape[1])[:, None] - 1, axis=1)[:, 0]
        own = np.full(count, np.inf) if stretches.calm_s is None else stretches.calm_s
        stretches.calm_s = np.where(earlier, np.minimum(own, before / TICKS_PER_S), own)


def _shape(nodes: Mapping[str, BaseNode], supervisor: str, timeline: Timeline) -> tuple[int, float]:
    """Return what rows cost: the policy's slots in each, and slots for each tick of the world."""
    placed: Placement = Placer(nodes, supervisor, timeline, frozenset()).place()
    return placed.slots.count(supervisor), len(placed.slots) / placed.ticks


def _drawn(timeline: Timeline, supervisor: str, steps: np.ndarray, cut: int, again: int) -> Drawn:
    vertex = timeline.vertices[supervisor]
    gaps = np.diff(vertex.start[:, : int(vertex.count.min())], axis=1)
    return Drawn(timeline, np.asarray(steps), cut, again, float(gaps.max(initial=0)) / TICKS_PER_S)
