"""Links from one log: mean, jitter and losses of the measurements' link and its clock's drift, with the dynamics.

What is hidden: how long each measurement was under way, and so the motion that it shows. It is summed out, with the
shares of all delays as unknowns beside the dynamics, the initial states and the noise (``hidden``). The commands' own
delay moves the motion as a whole. Its mean adds to that of the measurements, and only the sum is known; its deviation
is found afterwards, from what late commands do to the motion (``jitter``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.estimation.links import Link, Ranged
from sim2real.errors import UsageError
from sim2real.identify.delays import jitter
from sim2real.identify.delays.delay_residuals import Watched, motion
from sim2real.identify.delays.hidden_delays import Hidden, Linearise, hidden
from sim2real.identify.delays.likelihood import Likelihood, Seen
from sim2real.identify.delays.lost_messages import Losses, losses
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem

_AT_REST, _MOVES = 0.02, 2.0
"""Where the value before is as probable as this, or the joint moves less than this many counts and deviations of the
noise from one measurement to the next, a repeated value says nothing about losses: a joint at rest repeats its counts,
however noisy the rest of the motion is."""
_WIDTH = 1.96
"""Half the width of an interval, in standard errors."""


@dataclass(frozen=True)
class Found:
    """Delays and losses of one stream of measurements.

    Attributes:
        hidden: The delays of messages that arrived, and the unknowns of the model.
        losses: The others.
    """

    hidden: Hidden
    losses: Losses


def find(linearise: Linearise, x: np.ndarray, delay_s: float, again: np.ndarray, quantum: np.ndarray) -> Found:
    """Find delays, losses, drift, noise and the unknowns of a model together.

    Args:
        linearise: The model; see ``hidden``.
        x: Shape ``(P,)``: about the unknowns.
        delay_s: About the mean delay [s].
        again: Shape ``(N,)``, bool: measurements with the values of the one before, which may be lost messages.
        quantum: Shape ``(F,)``: resolution of the measurements, in their deviations.
    """

    def fresh(x: np.ndarray, about_s: float) -> Seen:
        return linearise(x, about_s).rows(~again)

    found = hidden(fresh, x, delay_s)
    chance = np.ones(len(again))
    if again.any():
        seen = linearise(found.x, found.mean[0])
        density = Likelihood(seen.rows(again), found.delays, found.drift)(found.place)[2]
        share = np.exp(density - 0.5 * len(quantum) * np.log(2 * np.pi)) * quantum.prod()
        slopes = seen.at(np.full((len(again), 1), found.mean[0]))[1][:, :, 0]
        moved = np.abs(slopes) * np.diff(seen.stamps, prepend=seen.stamps[0])[:, None]
        moves = np.any(moved > _MOVES * np.maximum(quantum, found.noise), axis=1)
        informative = moves[again] & (share < _AT_REST)
        chance[again] = np.where(informative, share, 1.0)
    return Found(found, losses(again, chance))


def links(problem: Problem, z: np.ndarray) -> tuple[Link, ...]:
    """Return the links of a problem.

    Args:
        z: Shape ``(P,)``: the estimate of a fit, from which dynamics and delays are estimated together.

    Raises:
        UsageError: When no delay of the measurements is identified.
    """
    late = measured(problem.table)
    seen = motion(problem, z, late)
    found = find(seen.linearise, seen.x, seen.delay_s, seen.again, seen.quantum)
    held, parts = _commands(problem.table, z)
    return (replace(describe(late, (late, *parts), found, held), jitter=_jitter(problem, z, seen, found)),)


def _jitter(problem: Problem, z: np.ndarray, watched: Watched, found: Found) -> Ranged:
    """Return the deviation of the commands' delays."""
    counts = watched.counts.copy()
    counts[watched.counts] = ~watched.again
    own, delay_s = found.hidden, found.hidden.mean[0]
    late = jitter.late_commands(problem, z, watched.pick, counts)
    seen = watched.linearise(own.x, delay_s).rows(~watched.again)
    delays = delay_s + own.drift * seen.stamps
    return jitter.deviation(seen, delays, own.deviation[0], own.noise, late)


def measured(table: ParameterTable) -> str:
    """Return the name of the measurements' delay.

    Raises:
        UsageError: When none is identified, or several are.
    """
    names = sorted({c.parameter.name for c in table.columns if c.parameter.side == "measurement"})
    if len(names) != 1:
        raise UsageError(
            f"links are found by the measurements' delay, and what is identified has {', '.join(names) or 'none'}",
            hint="do not hold the measurements' delay with --fix, or leave --links out",
        )
    return names[0]


def describe(name: str, parts: tuple[str, ...], found: Found, held_s: float = 0.0) -> Link:
    """Return what was found as numbers with intervals.

    Args:
        held_s: The sum of the other parts, at which they were held [s].
    """
    own = found.hidden
    (mean, mean_error), (deviation, error) = own.mean, own.deviation
    p95, low, high = own.quantile(0.95, _WIDTH)
    return Link(
        name=name,
        parts=parts,
        mean=_around(mean + held_s, mean_error),
        deviation=replace(_around(deviation, error), low95=max(deviation - _WIDTH * error, 0.0)),
        p95=Ranged(p95 + held_s, low + held_s, high + held_s),
        lost=found.losses.share,
        burst=found.losses.burst,
        drift=_around(own.drift, own.drift_error),
        delays=own.delays + held_s,
        share=own.share,
    )


def _around(value: float, error: float) -> Ranged:
    return Ranged(value, value - _WIDTH * error, value + _WIDTH * error)


def _commands(table: ParameterTable, z: np.ndarray) -> tuple[float, tuple[str, ...]]:
    """Return the sum of the commands' delays that were identified [s], and their names."""
    values = table.unscale(table.scale(np.asarray(z))[0])
    own = [i for i, c in enumerate(table.columns) if c.parameter.side == "command"]
    return float(values[own].sum()), tuple(table.names[i] for i in own)
