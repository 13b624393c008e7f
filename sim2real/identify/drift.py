"""Whether a later log is still of the robot that was identified: a test of each parameter, and of their causes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr, stdtrit

from sim2real.artifacts.drift import Changed, Drift
from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.posterior import Posterior
from sim2real.errors import UsageError
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem import Problem
from sim2real.identify.refine import refine
from sim2real.identify.uncertainty import Linearised, from_linearised, linearise

LEVEL = 0.05
"""Share of robots that did not change for which there is an alarm."""
_STEPS, _ROUNDS = 15, 2
"""Most steps and rounds of the refinement."""
Causes = Mapping[str, Mapping[str, float]]
"""Name of a cause -> parameter -> by how much it moves on its scale when what is named grows by a factor of e."""


@dataclass(frozen=True)
class Step:
    """How far a log moves the parameters away from what was identified, on their scales; the delays as their sum.

    Attributes:
        names: Q of them.
        step: Shape ``(Q,)``: how far.
        covariance: Shape ``(Q, Q)``: of ``step`` for a robot that did not change.
        freedom: Degrees of freedom of the log's part of it.
        seconds: Length of the log [s].
        z: Shape ``(P,)``: all parameters as the log has them, as ``ParameterTable.decode`` takes them.
    """

    names: tuple[str, ...]
    step: np.ndarray
    covariance: np.ndarray
    freedom: float
    seconds: float
    z: np.ndarray


def moved(problem: Problem, posterior: Posterior, widening: float = 1.0) -> Step:
    """Return how far a log moves the parameters from what was identified, by refinement from there.

    A single linear step does not do: where friction has doubled a joint stands still that should move, and there the
    derivatives are those of another motion (of eight changed pendulums it named four right, refinement all).

    What the way would be for a robot that did not change has two parts. The log's own is that of ``uncertainty``:
    residuals that are correlated in time count less, and blocks of the log that disagree widen it (a sandwich
    estimate). The identification's is its posterior, as much wider as covers the errors of its model: a robot that is
    not of the model's form acts, from motion to motion, like one with other parameters, and a policy moves otherwise
    than an excitation.

    Args:
        problem: The log, all of its segments fitted.
        posterior: What was identified.
        widening: Factor on the posterior's deviations that covers the model's errors.

    Raises:
        UsageError: When the parameters are others than the posterior's.
    """
    table = problem.table
    if table.names != posterior.names:
        raise UsageError(
            f"the log is tested for {', '.join(table.names)}, identified were {', '.join(posterior.names)}"
        )
    z = refine(problem, table.at_scale(posterior.mean)[None], _STEPS, _ROUNDS).z
    at = _finite(linearise(problem, z))
    merge, names = _merged(table)
    own = merge @ from_linearised(problem, at).scale_covariance @ merge.T
    before = merge @ posterior.covariance @ merge.T * widening**2
    freedom, seconds = max(len(problem.train) - 1.0, 1.0), problem.segment_s * len(problem.train)
    return Step(names, merge @ (at.x - posterior.mean), own + before, freedom, seconds, z)


def _finite(at: Linearised) -> Linearised:
    """Return the same without segments that cannot be simulated: of an unstable motion, say, that runs away."""
    whole = np.isfinite(at.residuals).all(axis=(1, 2)) & np.isfinite(at.jacobian).all(axis=(1, 2, 3))
    gone = lambda a: np.where(whole.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)  # noqa: E731
    return replace(at, residuals=gone(at.residuals), jacobian=gone(at.jacobian), raw=gone(at.raw))


def _merged(table: ParameterTable) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the map ``(Q, P)`` of parameters to those with the delays as their sum, and their names.

    A log tells of the delays on either side of the world their sum alone.
    """
    delays = np.array([c.parameter.kind == "delay" for c in table.columns])
    if delays.sum() < 2:
        return np.eye(len(table)), table.names
    rows = [*np.eye(len(table))[~delays], delays.astype(float)]
    return np.stack(rows), (*(n for n, late in zip(table.names, delays, strict=True) if not late), ROUND_TRIP)


def weigh(found: Step, table: ParameterTable, posterior: Posterior, causes: Causes) -> Drift:
    """Test each parameter, and each cause that moves several of them.

    The change of one alone that explains the step best is its generalised least squares estimate; the chi-square that
    it takes off is a score test. All tests together raise an alarm for 5 % of the robots that did not change, by Holm's
    correction (Scandinavian Journal of Statistics 6, 1979), with Student's distribution for the blocks of the log.

    Args:
        found: How far the log moves the parameters.
        table: The parameters.
        posterior: What was identified.
        causes: Known causes; those that move a parameter that was not identified are left out.
    """
    precision = np.linalg.inv(found.covariance)
    ways = {name: np.eye(len(found.names))[i] for i, name in enumerate(found.names)}
    for cause, shares in causes.items():
        if set(shares) <= set(found.names):
            ways[cause] = np.array([shares.get(n, 0.0) for n in found.names])
    reach = float(stdtrit(found.freedom, 0.975))
    rows = []
    for name, way in ways.items():
        information = float(way @ precision @ way)
        size, error = float(way @ precision @ found.step) / information, information**-0.5
        chi2 = (size / error) ** 2
        p = 2.0 * float(stdtr(found.freedom, -abs(size) / error))
        ends = (size, size - reach * error, size + reach * error)
        rows.append(Changed(name, *_values(name, ends, table, posterior), chi2, p))
    rows.sort(key=lambda row: -row.chi2)
    return Drift(tuple(rows), LEVEL, tuple(_holm(rows)), found.seconds)


def _holm(rows: Sequence[Changed]) -> list[str]:
    """Return the names of what is significant, all tests together."""
    alarms: list[str] = []
    for i, row in enumerate(sorted(rows, key=lambda row: row.p)):
        if row.p > LEVEL / (len(rows) - i):
            break
        alarms.append(row.name)
    return alarms


def _values(
    name: str, ends: Sequence[float], table: ParameterTable, posterior: Posterior
) -> tuple[str, float, float, float, float]:
    """Return the unit, the value before, and those after moving by ``ends`` on the scale; of a cause factors."""
    if name == ROUND_TRIP and name not in posterior.names:
        total = sum(x for x, c in zip(posterior.mean, table.columns, strict=True) if c.parameter.kind == "delay")
        now, low, high = (float(max(total + e, 0.0)) for e in ends)
        return "s", float(total), now, low, high
    if name not in posterior.names:
        now, low, high = (float(np.exp(e)) for e in ends)
        return "", 1.0, now, low, high
    i = posterior.names.index(name)
    parameter = table.columns[i].parameter
    before, now, low, high = (float(parameter.from_scale(posterior.mean[i] + e)) for e in (0.0, *ends))
    return parameter.unit, before, now, low, high
