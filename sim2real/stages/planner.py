"""What recordings of commands would tell of a robot, and motions that tell most of what is still uncertain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim2real.artifacts.design import Expected
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.hardware.gate import GateConfig
from sim2real.identify.design import Knowledge, Scatter, choose, informations
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem import Problem
from sim2real.identify.segments import Span
from sim2real.identify.uncertainty import linearise, time_shift
from sim2real.robots.loop_robot import LoopRobot
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.cutting import reach
from sim2real.stages.design_config import DesignConfig
from sim2real.stages.excitation import excitation
from sim2real.stages.motions import motions
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.planned import simulate
from sim2real.stages.replaying import known_table
from sim2real.stages.robot import moving_robot

_ODD = 0.5
"""Motions of which identification cannot read a segment's start off the samples around it, so that it would be off by
so many deviations of the measurement though nothing is wrong, are left out, unless the usual excitation is as odd."""
_USUAL = 4
"""Every fourth motion is of the usual excitation: what is tuned by hand is hard to find by chance."""
_TRIES = 20
"""So many motions are left out, one after the other, if the design as a whole would leave the gate's limits."""
_TELLS = 0.02
"""A design that narrows no interval by this share tells nothing."""


def gated_robot(pipeline: Pipeline, world: str | None = None) -> LoopRobot:
    """Return a pipeline's robot, whose gate's limits are known before it is opened.

    Args:
        pipeline: The pipeline.
        world: World that it is simulated in; None: its own.

    Raises:
        UsageError: There is no robot to record, or it does not say what its gate lets through.
    """
    robot = moving_robot(pipeline, world)
    if not isinstance(robot, LoopRobot):
        raise UsageError(
            f"{type(robot).__name__} does not say what its safety gate lets through: nothing can be designed within it",
            hint="robots that inherit from LoopRobot have a method gate()",
        )
    return robot


@dataclass(frozen=True)
class Told:
    """What commands would give.

    Attributes:
        episode: The log.
        middles_s: Shape ``(S,)``: where the middles of its segments are [s].
        each: Shape ``(S, Q, Q)``: their information, if residuals had a variance of 1.
        variance: Shape ``(S,)``: mean variance of their residuals.
        odd: Shape ``(S,)``: how far what identification would simulate is off the log, though nothing is wrong
            [deviations of the measurement].
    """

    episode: Episode
    middles_s: np.ndarray
    each: np.ndarray
    variance: np.ndarray
    odd: np.ndarray

    @property
    def information(self) -> np.ndarray:
        """Of all segments ``(Q, Q)``."""
        return self.each.sum(axis=0) / self.variance.mean()


@dataclass(frozen=True)
class Planner:
    """Simulates commands and says what a recording of them would tell.

    Attributes:
        robot: The robot.
        model: Its model.
        table: The parameters.
        values: Their values by name.
        known: What is known of them.
        scatter: How far measurements lie off the model.
        fitting: How a log is cut and simulated.
        config: What to design.
    """

    robot: LoopRobot
    model: IdentifiableModel
    table: ParameterTable
    values: Mapping[str, Any]
    known: Knowledge
    scatter: Scatter
    fitting: IdentifyConfig
    config: DesignConfig

    @staticmethod
    def of(pipeline: Pipeline, found: Identification | None, config: DesignConfig) -> Planner:
        """Return a planner with what was identified, or with the data sheet.

        Args:
            pipeline: The robot.
            found: What was identified; None: the data sheet.
            config: What to design.

        Raises:
            UsageError: What was identified is of other parameters, or was interrupted.
        """
        robot = gated_robot(pipeline, None if found is None else found.world)
        # A robust loss would count what one sample says less where it is far off: here all are where they should be.
        fitting = replace(pipeline.identify, loss="squared")
        if found is None:
            model = robot.identifiable(fitting.max_delay_s)
            table = model.parameters.for_recordings(1)
            values = table.of_recording(table.decode(table.start()), 0)
            return Planner(robot, model, table, values, Knowledge.of(table, None), Scatter(), fitting, config)
        model = robot.identifiable(fitting.max_delay_s)
        table = known_table(model.parameters, found).for_recordings(1)
        if found.posterior is None or found.posterior.names != table.names:
            known = "what was interrupted" if found.posterior is None else ", ".join(found.posterior.names)
            raise UsageError(
                f"the robot's parameters are {', '.join(table.names)}, identified were {known}",
                hint=f"sim2real identify {pipeline.name}",
            )
        known = Knowledge.of(table, None if config.forget else found.posterior)
        return Planner(robot, model, table, found.values, known, Scatter.of(found), fitting, config)

    @property
    def commands(self) -> int:
        """How many commands a step has."""
        return len(self.robot.action)

    @property
    def rest(self) -> np.ndarray:
        """The command around which excitations are played ``(actions,)``."""
        return self.robot.around(np.zeros((1, self.commands)))[0]

    @property
    def gate(self) -> GateConfig:
        """The limits of the robot's safety gate."""
        return self.robot.gate(self.config.record.gate)

    @property
    def segment_s(self) -> float:
        """Length of the segments into which identification cuts a log [s]."""
        return self.fitting.settle_s + self.fitting.horizon_s

    @property
    def share(self) -> float:
        """Share of a recording that identification fits."""
        gaps = max(1.0, self.fitting.spacing_s / self.segment_s)
        return (1.0 - self.fitting.held_out) / gaps

    @property
    def count(self) -> int:
        """How many motions make up the design."""
        return max(1, round(self.config.duration_s / self.config.motion_s))

    @property
    def samples(self) -> int:
        """Steps of each motion."""
        return int(self.config.duration_s * self.robot.rate_hz / self.count)

    def motion(self, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [rad] and magnitudes of the speeds [rad/s] of the joints, each ``(T, joints)``."""
        read, channels = episode.outputs[self.model.sensor], self.model.channels
        position = np.stack([np.asarray(c.of(read[c.position]), np.float64) for c in channels], axis=-1)
        rows = [np.asarray(c.of(read[c.velocity]), np.float64) for c in channels if c.velocity is not None]
        if len(rows) == len(channels):
            return position, np.abs(np.stack(rows, axis=-1))
        return position, np.abs(np.gradient(position, 1.0 / self.robot.rate_hz, axis=0))

    def usual(self, seconds: float, seed: int) -> np.ndarray:
        """Return commands ``(N, actions)`` of the usual excitation, around 0.

        Args:
            seconds: How long [s].
            seed: Of its phases.
        """
        config = replace(self.config.record, duration_s=max(seconds, 1.0), seed=seed)
        found = excitation(config, self.robot.rate_hz, self.commands).reshape(-1, self.commands)
        return found[: round(seconds * self.robot.rate_hz)]

    def told(self, signal: np.ndarray) -> Told:
        """Return what commands ``(N, actions)`` would give, segment by segment, as identification cuts a log."""
        episode = simulate(self.model, self.robot, signal, self.values, self.fitting, self.config.seed)
        begin, end = reach(episode, self.fitting)
        begins = np.arange(begin, end - self.segment_s + 1e-6, self.segment_s)
        spans = [Span(0, float(b)) for b in begins]
        problem = Problem(self.model, [episode], spans, self.segment_s, self.fitting, self.table)
        at = linearise(problem, problem.table.encode(self.values))
        each = self.share * informations(problem, at, self.known)
        odd = np.sqrt(np.mean(at.residuals**2, axis=(1, 2)))
        return Told(episode, begins + 0.5 * self.segment_s, each, self.variances(episode, begins) + odd**2, odd)

    def variances(self, episode: Episode, begins_s: np.ndarray) -> np.ndarray:
        """Return the mean variance of a residual in each segment ``(S,)`` [deviations of the measurement squared].

        Args:
            episode: The predicted log.
            begins_s: Shape ``(S,)``: where segments begin [s].
        """
        t_s, read = episode.steps[self.model.sensor].begun_s, episode.outputs[self.model.sensor]
        columns = [(c, f, sigma) for c in self.model.channels for f, sigma in c.fields]
        rates = [np.gradient(np.asarray(c.of(read[f]), np.float64), t_s) / sigma for c, f, sigma in columns]
        total = np.concatenate([[0.0], np.cumsum(np.mean(np.square(rates), axis=0))])
        first, last = np.searchsorted(t_s, begins_s), np.searchsorted(t_s, begins_s + self.segment_s)
        return self.scatter.white + self.scatter.jitter_s2 * (total[last] - total[first]) / np.maximum(last - first, 1)

    def pool(self, usual: Told) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return motions within the limits ``(M, N, actions)``, their information ``(M, Q, Q)`` and variance ``(M,)``.

        All of them are simulated in a row, as they will be played.

        Args:
            usual: What the usual excitation would give.

        Raises:
            Sim2RealError: Too few stay within the limits.
        """
        config, rate_hz = self.config, self.robot.rate_hz
        rest = self.rest
        gate = self.gate
        # A joint may go beyond the goal that it is told, a voltage is what it is.
        goals = any(c.goal is not None for c in self.model.channels)
        low, high = (
            (config.margin if goals else 1.0) * (np.broadcast_to(end, self.commands) - rest) for end in gate.range
        )
        band_hz = (config.record.low_hz / 2, min(2 * config.record.high_hz, rate_hz / 4))
        shape = config.motions, self.samples
        rng = np.random.default_rng([config.seed, 1])
        slew_per_s = config.margin * (gate.slew_per_s or np.inf)
        given = [self.usual(self.samples / rate_hz, int(s)) for s in rng.integers(0, 2**31, config.motions // _USUAL)]
        drawn = motions(rng, shape, rate_hz, band_hz, (low, high), slew_per_s, np.array(given))
        told = self.told(rest + drawn.reshape(-1, self.commands))
        position, _ = self.motion(told.episode)
        least = np.array([c.position_sigma for c in self.model.channels])
        if np.all(np.ptp(position, axis=0) < least):
            raise Sim2RealError(
                "no command moves the model: there is nothing to design",
                hint="check its gains, friction and the gate's limits; `sim2real check PIPELINE --plan` shows motions",
            )
        owner = np.minimum((told.middles_s * rate_hz).astype(int) // self.samples, config.motions - 1)
        good = self.inside(told.episode, config.motions)
        good[owner[~(told.odd < max(_ODD, usual.odd.max()))]] = False
        each = np.zeros((config.motions, *told.each.shape[1:]))
        variance, parts = np.zeros(config.motions), np.maximum(np.bincount(owner, minlength=config.motions), 1)
        np.add.at(each, owner, told.each)
        np.add.at(variance, owner, told.variance)
        if good.sum() < self.count:
            raise Sim2RealError(
                f"of {shape[0]} motions {good.sum()} stay within {config.margin:.0%} of the gate's limits, of the "
                f"{self.count} that {config.duration_s:g} s take",
                hint="lower --record.high-hz, raise --motions, or widen the limits if the robot bears it",
            )
        return rest + drawn[good], each[good], (variance / parts)[good]

    def inside(self, episode: Episode, count: int) -> np.ndarray:
        """Return which of ``count`` motions in a row stay within the limits of speed and position, with a margin."""
        gate, margin = self.gate, self.config.margin
        position, speed = self.motion(episode)
        fine = np.isfinite(position).all(axis=1) & np.isfinite(speed).all(axis=1)
        if gate.max_speed_rad_s is not None:
            fine &= np.all(speed <= margin * np.asarray(gate.max_speed_rad_s), axis=1)
        if gate.envelope_rad is not None:
            low, high = (np.broadcast_to(end, position.shape[1:]) for end in gate.envelope_rad)
            spare = 0.5 * (1.0 - margin) * (high - low)
            fine &= np.all((position >= low + spare) & (position <= high - spare), axis=1)
        t_s = episode.steps[self.model.sensor].begun_s
        owner = np.minimum((t_s * self.robot.rate_hz + 1e-6).astype(int) // self.samples, count - 1)
        good = np.ones(count, bool)
        good[owner[~fine]] = False
        return good

    def composed(self, pool: np.ndarray, each: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, Told]:
        """Return the commands ``(N, actions)``, and what they would give.

        The most telling motion comes first: what identification holds out, at the end, tells least.

        Args:
            pool: Shape ``(M, N, actions)``: the motions.
            each: Shape ``(M, Q, Q)``: their information.
            variance: Shape ``(M,)``: mean variance of their residuals.

        Raises:
            Sim2RealError: What was chosen leaves the limits when it is played in a row.
        """
        count, left = self.count, np.arange(len(pool))
        for _ in range(_TRIES):
            chosen = left[choose(self.known.precision, each[left], variance[left], count)]
            signal = pool[chosen].reshape(-1, self.commands)
            told = self.told(signal)
            good = self.inside(told.episode, count)
            if good.all():
                return signal, told
            left = np.setdiff1d(left, chosen[~good])
            if len(left) < count:
                break
        raise Sim2RealError(
            "no row of motions stays within the gate's limits, though each of them does by itself",
            hint="lower --margin, or raise --motions",
        )

    def expected(self, usual: Told, told: Told) -> list[Expected]:
        """Return the intervals to expect.

        Args:
            usual: What the usual excitation would give.
            told: What the design would give.

        Raises:
            Sim2RealError: No interval gets narrower.
        """
        now, other, after = (1.96 * self.known.deviations(more) for more in (0.0, usual.information, told.information))
        if np.all(after > (1.0 - _TELLS) * now):
            raise Sim2RealError(
                "no motion within the gate's limits tells more than is known",
                hint="fix what is known with `identify --fix`, or widen the limits if the robot bears it",
            )
        rows = []
        several = bool(time_shift(self.table).any())
        for i, column in enumerate(self.known.rest):
            parameter = self.table.columns[column].parameter
            late = parameter.kind == "delay"
            name = ROUND_TRIP if late and several else self.table.names[column]
            if parameter.transform == "log":
                scale: Callable[[float], float] = lambda d: float(np.expm1(min(d, 50.0)))  # noqa: E731
            else:
                size = parameter.high - parameter.low if late else abs(float(np.ravel(self.values[parameter.name])[0]))
                scale = lambda d, size=size: float(d / max(size, 1e-12))  # noqa: E731
            rows.append(Expected(name, *(scale(float(d[i])) for d in (now, other, after))))
        return rows
