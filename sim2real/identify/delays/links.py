"""Links from one log: mean, deviation and losses of the measurements' link and its clock's drift, with the dynamics.

The delay of each measurement is hidden, and with it the time of the measured motion. ``hidden`` sums over it: the
shares of all delays are unknowns beside the dynamics, the initial states and the noise. The commands' delay moves the
motion as a whole. Its mean adds to that of the measurements, and a log determines only the sum.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.identification import Link, Ranged
from sim2real.errors import UsageError
from sim2real.identify.delays.delay_residuals import motion
from sim2real.identify.delays.hidden_delays import Hidden, Linearise, hidden
from sim2real.identify.delays.likelihood import Likelihood
from sim2real.identify.delays.lost_messages import Losses, losses
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem

_LOST = 0.5
"""Probability of a loss from which on a repeated value counts as lost; below, its delay counts as the others do."""
_WIDTH = 1.96
"""Half the width of an interval, in standard errors."""


@dataclass(frozen=True)
class StreamEstimate:
    """Delays and losses of one stream of measurements.

    Attributes:
        hidden: The delays of messages that arrived, and the unknowns of the model.
        losses: Losses of the other messages.
    """

    hidden: Hidden
    losses: Losses


def find(linearise: Linearise, x: np.ndarray, delay_s: float, again: np.ndarray) -> StreamEstimate:
    """Estimate delays, losses, drift, noise and the unknowns of a model together.

    Args:
        x: Shape ``(P,)``: a first estimate of the unknowns.
        delay_s: A first estimate of the mean delay [s].
        again: Shape ``(N,)``, bool: measurements that repeat the previous values. Either the message was lost, or it
            came and shows the same motion: the robot rests, or its device measures more seldom than it is read.
    """
    first = np.maximum.accumulate(np.where(again, 0, np.arange(len(again))))

    def estimated(came: np.ndarray, x: np.ndarray, delay_s: float) -> tuple[float, StreamEstimate]:
        estimate = hidden(lambda x, about_s: linearise(x, about_s).rows(came), x, delay_s)
        evidence = linearise(estimate.x, estimate.mean[0])
        density = Likelihood(evidence, estimate.delays, estimate.drift)(estimate.place)[2]
        # How probable a repetition is if the message came: the density of its age over that of the new value's.
        chance = np.exp(np.minimum(density - density[first], 0.0))
        lost = losses(again, chance)
        share = np.clip(lost.each.mean(), 0.5 / len(again), 0.5)
        height = np.where(again, np.log(share + (1.0 - share) * chance), np.log(1.0 - share) + density)
        return float(height.sum()), StreamEstimate(estimate, lost)

    # Estimate from new values; then, too, from repeated ones that came, which have longer delays.
    best = estimated(~again, x, delay_s)
    came = ~again | (best[1].losses.each < _LOST)
    if (came != ~again).any():
        best = estimated(came, best[1].hidden.x, best[1].hidden.mean[0])
    # The repetitions of a slow device are older than any new value: compare with an estimate in which all came.
    if not came.all():
        best = max(best, estimated(np.ones_like(again), x, delay_s), key=lambda one: one[0])
    return best[1]


def links(problem: Problem, z: np.ndarray) -> tuple[Link, ...]:
    """Return the links of a problem.

    Args:
        z: Shape ``(P,)``: the estimate of a fit, from which dynamics and delays are estimated together.

    Raises:
        UsageError: When no delay of the measurements is identified.
    """
    late, table = measured(problem.table), problem.table
    # Give both sides of the world half of the delay, so that those of single measurements can be shorter or longer.
    values = {n: np.asarray(v, np.float64) for n, v in table.decode(jnp.asarray(z, jnp.float32)).items()}
    commands = [c.parameter.name for c in table.columns if c.parameter.side == "command"]
    half_s = (float(values[late]) + sum(float(values[n]) for n in commands)) / 2.0
    if commands and not table[late].free:
        values = values | {late: np.float64(half_s), commands[0]: np.float64(half_s)}
    z = table.encode(values)
    evidence = motion(problem, z, late, float(values[late]))
    estimate = find(evidence.linearise, evidence.x, evidence.delay_s, evidence.again)
    held, parts = _commands(table, z)
    return (describe(late, (late, *parts), estimate, held),)


def measured(table: ParameterTable) -> str:
    """Return the name of the measurements' delay."""
    names = sorted({p.name for p in table if p.side == "measurement"})
    if len(names) != 1 or not any(c.parameter.kind == "delay" for c in table.columns):
        raise UsageError(
            f"links need an identified delay and one of the measurements, and there is {', '.join(names) or 'none'}",
            hint="do not hold the delay with --fix, or remove --links",
        )
    return names[0]


def describe(name: str, parts: tuple[str, ...], estimate: StreamEstimate, held_s: float = 0.0) -> Link:
    """Return an estimate as numbers with intervals.

    Args:
        held_s: The sum of the other parts, which were held constant [s].
    """
    hidden_delays = estimate.hidden
    (mean, mean_error), (deviation, error) = hidden_delays.mean, hidden_delays.deviation
    p95, low, high = hidden_delays.quantile(0.95, _WIDTH)
    return Link(
        name=name,
        parts=parts,
        mean=_around(mean + held_s, mean_error, 0.0),
        deviation=_around(deviation, error, 0.0),
        p95=Ranged(p95 + held_s, max(low + held_s, 0.0), high + held_s),
        lost=estimate.losses.share,
        burst=estimate.losses.burst,
        drift=_around(hidden_delays.drift, hidden_delays.drift_error, -np.inf),
        delays=hidden_delays.delays + held_s,
        share=hidden_delays.share,
    )


def _around(value: float, error: float, least: float) -> Ranged:
    return Ranged(value, max(value - _WIDTH * error, least), value + _WIDTH * error)


def _commands(table: ParameterTable, z: np.ndarray) -> tuple[float, tuple[str, ...]]:
    """Return the sum of the commands' identified delays [s], and their names."""
    values = table.unscale(table.scale(np.asarray(z))[0])
    entries = [i for i, c in enumerate(table.columns) if c.parameter.side == "command"]
    return float(values[entries].sum()), tuple(table.names[i] for i in entries)
