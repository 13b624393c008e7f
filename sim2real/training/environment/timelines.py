"""Timelines for training, drawn from the times measured on the robot, with its pauses."""

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
from sim2real.runtime.compiled.placement import Placement, Placer

STRETCH_S = 1.0
"""Length of a stretch of a recording [s]: hiccups of a computer last tens of milliseconds."""
_MAX_PAUSES = (np.inf, 3.0, 2.0, 1.5, 1.25)
"""Longest allowed pauses between two policy steps, tried in this order [periods]."""
_LONG_STEP = 0.25
"""After the end of an episode, steps longer than this share of the policy's period are replaced."""
_MIN_SHARE = 0.5
"""Timelines whose first pause lies within this share of the episode are drawn again."""
_MAX_ROUNDS = 20


@dataclass
class Stretches:
    """Random stretches of the recording, common to all nodes and connections.

    A hiccup of the computer delays all nodes at once, so times that were measured together are drawn together.

    Attributes:
        pauses: Whether the long steps of the recording are used.
        calm_s: Shape ``(E,)``: time after which an episode has no long steps [s]; None: never.
    """

    seed: int
    pauses: bool = True
    calm_s: np.ndarray | None = field(default=None)

    def begins(self, episodes: int, count: int) -> np.ndarray:
        """Return the starts as a share of the recording, shape ``(episodes, count)``."""
        # Draw stretch by stretch, so that a larger count keeps the first stretches.
        return np.random.default_rng(self.seed).random((count, episodes)).T


class RecordedTimes(DelayDistribution):
    """Recorded times, drawn in stretches that all nodes share.

    Args:
        samples: Shape ``(N,)``: the time of each step or message [s], in their order.
        rate_hz: Number of samples in a second [Hz].
        long_s: Longer times are replaced by the median after ``calm_s`` [s].
    """

    def __init__(self, samples: np.ndarray, rate_hz: float, stretches: Stretches, long_s: float) -> None:
        self.samples, self.rate_hz, self.stretches, self.long_s = samples, rate_hz, stretches, long_s

    def __repr__(self) -> str:
        return f"RecordedTimes({self.samples.size} samples, {self.rate_hz:g} Hz)"

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return times [s] for E episodes, shape ``(E, N)``; ``stretches`` has drawn the random numbers."""
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
class RecordedTiming:
    """The computation and transport times of the robot as delay distributions of simulated nodes.

    Attributes:
        computation: Node -> distribution of its steps' computation times.
        transport: (reader, input) -> distribution of its messages' transport times.
    """

    stretches: Stretches
    computation: Mapping[str, DelayDistribution]
    transport: Mapping[tuple[str, str], DelayDistribution]

    @staticmethod
    def of(timing: Timing, rate_hz: float, seed: int, pauses: bool = True) -> RecordedTiming:
        """Return the times of a recording.

        Args:
            rate_hz: The policy's rate [Hz].
            pauses: Whether to keep the robot's pauses; otherwise steps longer than a quarter of the period are dropped.

        Raises:
            Sim2RealError: Most steps of a node took too long for a policy of this rate.
        """
        stretches, long_s = Stretches(seed, pauses), _LONG_STEP / rate_hz
        timing.computation(long_s)
        span_s = max((n.steps * (n.period.p50 or 0.0) for n in timing.nodes.values()), default=0.0)

        def times(samples: np.ndarray) -> RecordedTimes | None:
            valid = samples[np.isfinite(samples) & (samples >= 0.0)]
            return RecordedTimes(valid, valid.size / span_s, stretches, long_s) if valid.size > 1 and span_s else None

        computation = {n: d for n, s in timing.steps_s.items() if (d := times(s)) is not None}
        transport = {tuple(k.split("/", 1)): d for k, s in timing.transport_s.items() if (d := times(s)) is not None}
        return RecordedTiming(stretches, computation, transport)  # type: ignore[arg-type]  # split leaves two parts

    def set_transport(self, nodes: Mapping[str, BaseNode]) -> None:
        """Give the connections the recorded transport times; the nodes' phases stay as on the robot."""
        for (reader, name), dist in self.transport.items():
            if reader in nodes and name in nodes[reader].inputs:
                nodes[reader].inputs[name].delay_dist = dist


@dataclass(frozen=True)
class TimelineDraw:
    """Timelines, and figures of the pauses in them.

    Attributes:
        steps: Shape ``(E,)``: number of policy steps after which each episode ends.
        cut: Number of episodes that end early, before a pause that does not fit into the program's rows.
        redrawn: Number of timelines that were drawn again, because such a pause was in their first half.
        longest_pause_s: Longest time between two policy steps in any of them [s].
    """

    timeline: Timeline
    steps: np.ndarray
    cut: int
    redrawn: int
    longest_pause_s: float


def draw_timelines(
    nodes: Mapping[str, BaseNode],
    supervisor: str,
    episode_s: float,
    count: int,
    seed: int,
    recorded: RecordedTiming | None,
) -> TimelineDraw:
    """Draw timelines.

    A row of the program has one policy step and a fixed number of world ticks. After a pause of several periods a robot
    makes several steps in quick succession, which do not fit into rows. So such an episode ends before the pause.

    Args:
        recorded: The robot's times; None: draw from the nodes' own delay distributions.
    """
    if recorded is None:
        timeline = draw(nodes, episode_s, count, np.random.default_rng(seed))
        return _with_figures(timeline, supervisor, timeline.vertices[supervisor].count, 0, 0)

    # Draw timelines without long steps, which determine the cost of a row.
    recorded.stretches.calm_s = np.zeros(count)
    calm = draw(nodes, episode_s, count, seed)
    if not recorded.stretches.pauses:
        return _with_figures(calm, supervisor, calm.vertices[supervisor].count, 0, 0)
    calm_cost = _row_cost(nodes, supervisor, calm)

    # Allow the longest pauses that do not make a row more expensive.
    for periods in _MAX_PAUSES:
        drawn = _draw_with_pauses(nodes, supervisor, episode_s, count, seed, recorded, periods)
        if drawn is None or bursty_episodes(nodes, drawn.timeline).any():
            continue
        if _row_cost(nodes, supervisor, drawn.timeline) <= calm_cost:
            return drawn
    raise Sim2RealError(
        "nearly every timeline drawn from this log has a pause of the policy",
        hint="record on a less busy machine, or train shorter episodes with --episode-s",
    )


def _draw_with_pauses(
    nodes: Mapping[str, BaseNode],
    supervisor: str,
    episode_s: float,
    count: int,
    seed: int,
    recorded: RecordedTiming,
    periods: float,
) -> TimelineDraw | None:
    """Return timelines that end before pauses longer than ``periods``; None if too many of them end early."""
    # Draw again until enough timelines have room between pauses.
    accepted: list[Timeline] = []
    steps: list[np.ndarray] = []
    missing, redrawn = count, 0
    for attempt in range(_MAX_ROUNDS):
        recorded.stretches.seed, recorded.stretches.calm_s = seed + 1000 * attempt, None
        timeline, last = _end_at_pauses(nodes, supervisor, episode_s, count, recorded.stretches, periods)
        # Accept timelines that are long enough, up to the missing number.
        long = last >= _MIN_SHARE * timeline.vertices[supervisor].count
        long &= np.cumsum(long) <= missing
        if long.any():
            accepted.append(timeline[long])
            steps.append(last[long])
        missing -= int(long.sum())
        if not missing:
            timeline, ends = Timeline.stack(accepted), np.concatenate(steps)
            cut = int((ends < timeline.vertices[supervisor].count).sum())
            return _with_figures(timeline, supervisor, ends, cut, redrawn)
        redrawn += missing
    return None


def _end_at_pauses(
    nodes: Mapping[str, BaseNode], supervisor: str, episode_s: float, count: int, stretches: Stretches, periods: float
) -> tuple[Timeline, np.ndarray]:
    """Return timelines without long steps after a first pause, and the number of policy steps until then ``(E,)``."""
    last = np.full(count, np.iinfo(np.int64).max)
    rate_hz = nodes[supervisor].rate
    while True:
        # Find the first pause of each timeline; calming one moves the steps after it, so repeat until none is earlier.
        timeline = draw(nodes, episode_s, count, stretches.seed)
        vertex = timeline.vertices[supervisor]
        gaps = np.diff(vertex.start[:, : int(vertex.count.min())], axis=1)
        first = np.where(gaps > periods * TICKS_PER_S / rate_hz, np.arange(1, gaps.shape[1] + 1), last[:, None])
        earlier = first.min(axis=1, initial=np.iinfo(np.int64).max) < last
        if not earlier.any():
            return timeline, np.minimum(last, vertex.count)
        last = np.where(earlier, first.min(axis=1), last)
        before = np.take_along_axis(vertex.start, np.minimum(last, gaps.shape[1])[:, None] - 1, axis=1)[:, 0]
        calm_s = np.full(count, np.inf) if stretches.calm_s is None else stretches.calm_s
        stretches.calm_s = np.where(earlier, np.minimum(calm_s, before / TICKS_PER_S), calm_s)


def _row_cost(nodes: Mapping[str, BaseNode], supervisor: str, timeline: Timeline) -> tuple[int, float]:
    """Return the policy's slots in a row, and the slots for each tick of the world."""
    placement: Placement = Placer(nodes, supervisor, timeline).place()
    return placement.slots.count(supervisor), len(placement.slots) / placement.ticks


def _with_figures(timeline: Timeline, supervisor: str, steps: np.ndarray, cut: int, redrawn: int) -> TimelineDraw:
    vertex = timeline.vertices[supervisor]
    gaps = np.diff(vertex.start[:, : int(vertex.count.min())], axis=1)
    return TimelineDraw(timeline, np.asarray(steps), cut, redrawn, float(gaps.max(initial=0)) / TICKS_PER_S)
