"""Measures the delay between a command and the motion that answers it, by a few small steps on the robot."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from sim2real.errors import SafetyStop, Sim2RealError

if TYPE_CHECKING:
    from sim2real.hardware.clock import Clock
    from sim2real.hardware.device import Reading
    from sim2real.hardware.safety.rig import Rig

_PERIOD_S, _WATCHED_S = 0.004, 0.16
"""Time between two samples; how long the answer to a step is measured [s]."""
_BUSY_S, _TRIES, _FEWEST = 0.012, 5, 4
"""A step with a longer pause between two samples is repeated [s]. Most steps, as a multiple of ``_STEPS``; fewest
undisturbed steps.
"""
_RISE_RAD = 0.05
"""The answer is fitted up to this angle [rad]: beyond it, a polynomial does not describe weight and friction."""
_GRID_S = 0.0005
_TURNS = 10
"""Rounds of the fit; more rounds change the median delay of embedded robots by less than a step of the grid."""
_AGAIN = 5
"""A command is sent again after this many samples, because it must not become stale."""
_STILL_RAD_S, _STILL_S, _REST_S = 0.05, 0.1, 3.0
_JOINT, _STEPS = 0, 8
"""The joint that is stepped, and the number of steps."""


@dataclass(frozen=True)
class StepAnswers:
    """Delays of the answers to some steps.

    Attributes:
        delays_s: Shape ``(N,)``: time from each command's departure to the fitted begin of the motion, by time stamps
            of measurements [s].
        lag_s: See ``Probe``.
    """

    delays_s: np.ndarray
    lag_s: tuple[float, float] = (0.0, 0.0)

    @property
    def between_s(self) -> tuple[float, float]:
        """The shortest and the longest delay that explain the median of the answers [s]."""
        seen = float(np.median(self.delays_s))
        return seen - self.lag_s[1], seen - self.lag_s[0]

    @property
    def delay_s(self) -> float:
        """The middle of ``between_s`` [s]."""
        return float(np.mean(self.between_s))

    @property
    def jitter_s(self) -> float:
        """The range of the middle half of ``delays_s`` [s]."""
        return float(np.subtract(*np.quantile(self.delays_s, [0.75, 0.25])))


@dataclass(frozen=True)
class Probe:
    """Small steps of the first joint, by which a robot's delay is measured.

    Attributes:
        step: Size of a step [the command's unit].
        lag_s: Smallest and largest time by which an answer seems to begin too late, because motion starts softly [s]:
            for half to twice the robot's friction. A policy is refused only if no time in between explains the answers.
    """

    step: float
    lag_s: tuple[float, float] = (0.0, 0.0)


@dataclass
class Witness:
    """Makes the steps, and stores measurements and commands, which also serve as a recording.

    Attributes:
        rig: The robot.
        measured: For each measurement: times of request and answer on the device's clock [ns], and the reading.
        sent: For each command: start and end of sending [ns], and the command after the gate ``(n,)``.
    """

    rig: Rig
    measured: list[tuple[int, int, Reading]] = field(default_factory=list)
    sent: list[tuple[int, int, np.ndarray]] = field(default_factory=list)

    @property
    def clock(self) -> Clock:
        """The device's clock."""
        return self.rig.clock

    def measure(self) -> Reading:
        """Measure all joints; see `Rig.measure`."""
        reading = self.rig.measure()
        self.measured.append((reading.transaction.t_sent_ns, self.clock.now_ns(), reading))
        return reading

    def command(self, command: np.ndarray) -> None:
        """Send a command through the gate; see `Rig.command`."""
        begin_ns = self.clock.now_ns()
        allowed = self.rig.command(command, 0.0, 1e-9 * begin_ns)
        self.sent.append((begin_ns, self.clock.now_ns(), allowed))


def measure_delay(witness: Witness, probe: Probe) -> StepAnswers:
    """Step one joint to and fro, through the gate, and measure its answers; torque is off before and afterwards.

    Args:
        witness: Has the robot, at rest; its earlier measurements are dropped.

    Raises:
        Sim2RealError: The joint does not answer.
        SafetyStop: This machine is too busy to measure, or the gate stopped the robot.
    """
    witness.measured, witness.sent = [], []
    with witness.rig.running():
        answers = _answers(witness, probe)
    return replace(delays_of(answers), lag_s=probe.lag_s)


def delays_of(answers: Sequence[np.ndarray]) -> StepAnswers:
    """Return the start of each answer.

    An answer is 0 until the delay is over; then it is a curve ``a t^2 + b t^3``, common to all answers, times a factor
    of each answer, as weight and friction depend on the angle. Curve, delays and factors are fitted in turn, starting
    from the delay that fits all answers best.

    Args:
        answers: Each of shape ``(N, 2)``: time since the command [s], and motion since then in its direction [rad].
    """
    if np.median([np.max(a[:, 1]) for a in answers]) < _RISE_RAD:
        raise Sim2RealError(
            "the robot does not answer the steps by which its delay is measured",
            hint="is it blocked, or its supply off? without this check: --no-measure-delay",
        )
    end_s = float(np.median([a[np.argmax(a[:, 1] >= _RISE_RAD), 0] for a in answers if a[:, 1].max() >= _RISE_RAD]))
    # A fast joint arrives within a few samples: the answer began in the first of them.
    grid = np.arange(0.0, max(end_s - 4 * _PERIOD_S, _PERIOD_S), _GRID_S)
    # Compare all delays on the same samples: otherwise a delay without samples would fit best.
    answers = [a[: max(2, int(np.sum(a[:, 0] <= end_s)))] for a in answers]
    samples = np.concatenate(answers)
    residual = [np.linalg.lstsq(_powers(samples[:, 0], d), samples[:, 1], rcond=None)[1].sum() for d in grid]
    delays, factors = [grid[np.argmin(residual)]] * len(answers), [1.0] * len(answers)
    for _ in range(_TURNS):
        powers = [f * _powers(a[:, 0], d) for a, d, f in zip(answers, delays, factors, strict=True)]
        curve = np.linalg.lstsq(np.concatenate(powers), samples[:, 1], rcond=None)[0]
        best = [min(_scaled(a, d, curve) for d in grid) for a in answers]
        delays, factors = [d for _, d, _ in best], [f for *_, f in best]
    return StepAnswers(np.array(delays))


def _answers(witness: Witness, probe: Probe) -> list[np.ndarray]:
    """Return the answers to some steps; a step during which this machine was busy is repeated."""
    answers: list[np.ndarray] = []
    for before, goal in itertools.islice(itertools.cycle(_steps(witness.rig, probe)), _TRIES * _STEPS):
        answer = _answer(witness, before, goal)
        answers += [] if answer is None else [answer]
        if len(answers) == _STEPS:
            return answers
    if len(answers) >= _FEWEST:
        return answers
    raise SafetyStop(
        f"the delay cannot be measured: this machine was busy during all but {len(answers)} of "
        f"{_TRIES * _STEPS} small steps",
        hint="close what else runs on it; without this check: --no-measure-delay",
    )


def _steps(rig: Rig, probe: Probe) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return for each step the commands before and after it: from rest and back, or to both sides of zero."""
    rest, away = rig.gate.fallback, rig.gate.fallback
    away[_JOINT] += probe.step
    if rig.gate.config.stale == "zero":
        return [(rest, away), (rest, -away)]
    if np.any(away > rig.gate.config.range[1]):
        away[_JOINT] -= 2 * probe.step
    return [(rest, away), (away, rest)]


def _answer(witness: Witness, before: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
    """Return the answer to a step: times since the command [s], and motion in its direction [rad]; None: too few."""
    _settle(witness, before)
    clock, begin, rows = witness.clock, witness.measure().position_rad[_JOINT], []
    left_ns = clock.now_ns()
    witness.command(goal)
    sent_s = 1e-9 * (clock.now_ns() - left_ns)
    while (now_ns := clock.now_ns()) < left_ns + round(1e9 * _WATCHED_S):
        reading = witness.measure()
        rows.append((1e-9 * (reading.transaction.t_sent_ns - left_ns), reading.position_rad[_JOINT] - begin))
        if len(rows) % _AGAIN == 0:
            witness.command(goal)
        clock.sleep(max(0.0, _PERIOD_S - 1e-9 * (clock.now_ns() - now_ns)))
    if witness.rig.gate.config.stale == "zero":
        witness.command(before)
    longest_s = max(sent_s, *np.diff([0.0, *(t_s for t_s, _ in rows)]))
    return np.array(rows) * [1.0, np.sign(goal[_JOINT] - before[_JOINT])] if longest_s < _BUSY_S else None


def _settle(witness: Witness, command: np.ndarray) -> None:
    begin_ns = still_ns = witness.clock.now_ns()
    while (now_ns := witness.clock.now_ns()) - still_ns < 1e9 * _STILL_S and now_ns - begin_ns < 1e9 * _REST_S:
        if np.max(np.abs(witness.measure().velocity_rad_s)) > _STILL_RAD_S:
            still_ns = witness.clock.now_ns()
        witness.command(command)
        witness.clock.sleep(0.01)


def _powers(t_s: np.ndarray, delay_s: float) -> np.ndarray:
    since = np.maximum(0.0, t_s - delay_s)[:, None] / _WATCHED_S
    return since ** np.array([2, 3])


def _scaled(answer: np.ndarray, delay_s: float, curve: np.ndarray) -> tuple[float, float, float]:
    """Return the misfit of the curve after a delay, the delay, and the best factor on the curve."""
    shape = _powers(answer[:, 0], delay_s) @ curve
    factor = float(shape @ answer[:, 1] / max(shape @ shape, 1e-12))
    return float(np.sum((answer[:, 1] - factor * shape) ** 2)), delay_s, factor
