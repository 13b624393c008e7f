"""Tests whether the robot of a later log has changed since the identification: each parameter, and known causes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr, stdtrit

from sim2real.artifacts.deployment import Changed, Drift
from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.posterior import Posterior, Transform
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.residuals import Linearised, Problem
from sim2real.identification.uncertainty import loss_variance

LEVEL = 0.05
"""False-alarm rate of the drift test, per log."""
_SIZES = (-0.4, -0.25, -0.12, -0.05, 0.05, 0.12, 0.25, 0.4)
"""Sizes of changes that are tried first, as shares of the range between the bounds."""
_TURNS = 3
"""Rounds of trials; each round lies between the neighbours of the best size so far."""
_FELT = 1e-3
"""A log tests a change if it moves the residuals by at least this much between the bounds [variances]."""
_SMALL = 0.05
"""A factor nearer to 1, or a smaller share of the round-trip delay, counts as no change: small errors of a good model
are significant, too. Of 16 unchanged SO-101 three seemed to have 8 to 14 % more friction, and a pendulum's delay of 54
ms seemed to be 0.4 ms longer a minute after its identification.
"""
_LEAST = 0.1
"""A change raises an alarm only if it explains at least this share of the error. In 112 changed robots the right change
explained 0.2 or more; in nine unchanged robots a torque limit explained 0.05 at most.
"""


@dataclass(frozen=True)
class Way:
    """A change to test: its name, and a direction ``(P,)`` on the parameters' scales."""

    name: str
    along: np.ndarray


@dataclass(frozen=True)
class Fitted:
    """The fit of one change to a log, without other changes.

    Attributes:
        size: Distance along the change.
        by_log: Variance of ``size`` due to the log's residuals.
        by_posterior: Variance of ``size`` due to the posterior.
        segments: Effective number of segments that determine the size.
        loss: Loss of the log with this change, the other parameters within the posterior.
    """

    way: Way
    size: float
    by_log: float
    by_posterior: float
    segments: float
    loss: float

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the whole variance (Satterthwaite, Biometrics Bulletin 2, 1946).

        The log's part has as many as effective segments, minus 1: a segment in which a pendulum stands upright tells
        nothing. The posterior's part counts as exact.
        """
        return max(self.segments - 1.0, 1.0) * ((self.by_log + self.by_posterior) / max(self.by_log, 1e-300)) ** 2


def ways(table: ParameterTable) -> list[Way]:
    """Return the changes to test: of each parameter, and of causes that move several identified ones, and no other."""
    kinds = [c.kind for c in table.columns]
    names = [ROUND_TRIP if k == "delay" and kinds.count(k) == 1 else n for k, n in zip(kinds, table.names, strict=True)]
    changes = [Way(n, np.eye(len(table))[i]) for i, n in enumerate(names)]
    for cause in dict.fromkeys(cause for p in table for cause in p.causes):
        shares = {p.name: p.causes[cause] for p in table if cause in p.causes}
        if len(shares) > 1 and set(shares) <= set(table.names):
            changes.append(Way(cause, np.array([shares.get(n, 0.0) for n in table.names])))
    return changes


def drift(problem: Problem, posterior: Posterior, widening: float) -> tuple[Drift, np.ndarray]:
    """Test whether a log agrees with the identified robot.

    Each change is fitted alone, because a short log of a policy that soon stands still cannot determine all parameters.
    A linear step from the estimate would not do: with twice the friction a joint may stand still, and derivatives at
    the estimate describe a joint that moves.

    Args:
        posterior: The identification; other parameters of the problem had their nominal values.
        widening: Factor on the posterior's standard deviations that covers errors of the model, which act like other
            parameters in each motion.

    Returns:
        The tests, and the point ``(P,)`` on the parameters' scales that explains the log best: with the best change, or
        the estimate.

    Raises:
        UsageError: Parameters of the posterior are not tested.
    """
    # Fit each change alone, with the other parameters within the posterior.
    table = problem.table
    posterior = _with_known(posterior, table)
    values, axes = np.linalg.eigh(posterior.covariance)
    root = widening * axes * np.sqrt(np.maximum(values, 0.0))
    tried = [_alone(problem, posterior.mean, root, way) for way in ways(table)]
    fitted = [one for one in tried if one is not None]
    if not fitted:
        raise Sim2RealError("this log determines no parameter", hint="deploy a policy that moves the robot")
    # Compare with the loss without a change.
    at = _finite(problem.linearise(table.within(posterior.mean)))
    now = _with_the_rest(at, root, loss_variance(problem, at))
    fitted.sort(key=lambda one: one.loss)
    # Return the better of the best change and the estimate.
    seconds = problem.segment_s * len(problem.train)
    ends = (posterior.mean + fitted[0].size * fitted[0].way.along, posterior.mean)
    losses = [problem.loss(table.within(x)) for x in ends]
    return weigh(fitted, now, table, posterior, seconds), ends[int(losses[1] < losses[0] or not np.isfinite(losses[0]))]


def _with_known(posterior: Posterior, table: ParameterTable) -> Posterior:
    """Return the posterior of all parameters; those that were not identified are nominal, without error."""
    if lacking := [name for name in posterior.names if name not in table.names]:
        raise UsageError(
            f"the log is tested for {', '.join(table.names)}, but {', '.join(lacking)} were identified, too"
        )

    at = [table.names.index(name) for name in posterior.names]
    mean = np.array([c.to_scale(c.nominal) for c in table.columns])
    covariance = np.zeros((len(mean), len(mean)))
    mean[at], covariance[np.ix_(at, at)] = posterior.mean, posterior.covariance
    transform: tuple[Transform, ...] = tuple(c.transform for c in table.columns)
    return Posterior(table.names, transform, mean, covariance, table.low, table.high)


def _alone(problem: Problem, mean: np.ndarray, root: np.ndarray, way: Way) -> Fitted | None:
    """Fit one change to a log, and return the variance of its size for an unchanged robot.

    Args:
        mean: Shape ``(P,)``: the estimate, on the parameters' scales.
        root: Shape ``(P, P)``: a root of the posterior's covariance.

    Returns:
        The change; None if the log does not depend on it, such as a torque limit that its motion does not reach.
    """
    table = problem.table

    def point(size: float) -> np.ndarray:
        return table.within(mean + size * way.along)

    # Find the size of the change that fits best.
    moving = way.along != 0.0
    unit = float(np.min(table.span[moving] / np.abs(way.along[moving])))
    size = _best(problem, point, unit)
    at = _finite(problem.linearise(point(size)))
    # A log that does not depend on the change tests nothing.
    variance, informed = loss_variance(problem, at), float(np.sum((at.jacobian @ way.along) ** 2))
    if informed * unit**2 <= _FELT * variance:
        return None
    step, by_log, by_posterior, segments = _beside_the_rest(at, way, root, variance)
    return Fitted(way, size + step, by_log, by_posterior, segments, _with_the_rest(at, root, variance))


def _best(problem: Problem, point: Callable[[float], np.ndarray], unit: float) -> float:
    """Return the size of a change that fits the log best.

    Args:
        point: Size of the change -> a point ``(P,)``.
        unit: The size between the bounds.
    """
    size, sizes = 0.0, unit * np.array(sorted([0.0, *_SIZES]))
    for _ in range(_TURNS):
        tried = np.array([point(s) for s in sizes])
        trials = problem.losses(tried, point(size))
        best = int(np.argmin(np.where(np.isfinite(trials), trials, np.inf)))
        size = float(sizes[best])
        sizes = np.linspace(sizes[max(best - 1, 0)], sizes[min(best + 1, len(sizes) - 1)], len(sizes))
    return size


def _beside_the_rest(at: Linearised, way: Way, root: np.ndarray, variance: float) -> tuple[float, float, float, float]:
    """Return a change's step with all other parameters free within the posterior, and its variances.

    Generalised least squares gives most weight to samples that only this change explains: in slow motion a weaker motor
    looks like a longer delay, at the start of a quick step it does not.

    The log's variance is the larger of two estimates: from each segment's residuals with their correlation in time, and
    from the sum of squares of the segments' effects on the size (a sandwich estimate).

    Args:
        root: Shape ``(P, P)``: a root of the posterior's covariance.

    Returns:
        The step; its variances due to the log's residuals and due to the posterior; the effective number of segments
        that determine it.
    """
    along, residuals = at.jacobian @ way.along, at.residuals.reshape(len(at.residuals), -1)
    unit = 1.0 / float(np.linalg.norm(along))
    # In units of the posterior's deviations: a delay with a deviation of 1 us would make the sum ill-conditioned.
    columns = np.concatenate([unit * along[..., None], at.jacobian @ root], axis=-1)
    columns = columns.reshape(len(residuals), -1, 1 + len(root))
    precision = np.diag([0.0] + [1.0] * len(root))
    inverse = np.linalg.inv(np.einsum("sna,snb->ab", columns, columns) / variance + precision)
    moved = -inverse @ np.einsum("sna,sn->a", columns, residuals) / variance
    weights = columns @ inverse[0]  # weight of each residual in the size
    pulls = np.sum(weights * (residuals + columns @ moved), axis=1) / variance
    informed = np.sum(weights**2, axis=1)
    segments = float(informed.sum() ** 2 / np.sum(informed**2))
    # Fast motion has large residuals and informs most: each segment counts with its own residuals.
    squares, counted = np.sum(residuals**2, axis=1), at.compared.sum(axis=1) * at.residuals.shape[-1]
    uneven = squares / np.maximum(counted, 1) * counted.sum() / max(float(squares.sum()), 1e-300)
    spread = float(np.sum(pulls**2)) * segments / max(segments - 1.0, 0.5)
    by_log = unit**2 * max(float(informed @ uneven) / variance, spread)
    return unit * float(moved[0]), by_log, unit**2 * float(np.sum(inverse[0, 1:] ** 2)), segments


def _with_the_rest(at: Linearised, root: np.ndarray, variance: float) -> float:
    """Return the loss at a point after all parameters moved within the posterior.

    With the right change, the other parameters move little; a wrong one needs large moves, which the posterior
    penalises.

    Args:
        root: Shape ``(P, P)``: a root of the posterior's covariance.
    """
    flat, rest = at.jacobian.reshape(-1, len(at.x)), at.residuals.reshape(-1)
    # In units of the posterior's deviations: a delay with a deviation of 1 us would make the sum ill-conditioned.
    pulled, informed = root.T @ (flat.T @ rest), root.T @ (flat.T @ flat) @ root
    gain = pulled @ np.linalg.solve(informed + variance * np.eye(len(root)), pulled)
    return float(rest @ rest - gain) / max(at.count, 1)


def _finite(at: Linearised) -> Linearised:
    """Return the linearisation without segments whose simulation diverges."""
    whole = np.isfinite(at.residuals).all(axis=(1, 2)) & np.isfinite(at.jacobian).all(axis=(1, 2, 3))
    gone = lambda a: np.where(whole.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0)  # noqa: E731
    compared = at.compared & np.asarray(whole)[:, None]
    return replace(at, residuals=gone(at.residuals), jacobian=gone(at.jacobian), raw=gone(at.raw), compared=compared)


def weigh(fitted: Sequence[Fitted], loss: float, table: ParameterTable, posterior: Posterior, seconds: float) -> Drift:
    """Return the significant changes: all tests together raise an alarm for 5 % of unchanged robots.

    Tests use Holm's correction (Scandinavian Journal of Statistics 6, 1979) and Student's distribution. A factor is
    compared with a small one instead of with 1, a delay with a small share of the round trip instead of with 0.

    Args:
        fitted: The fit of each change, the one that explains most first.
        loss: Loss of the log without any change.
        seconds: Length of the log [s].
    """
    rows = []
    for one in fitted:
        error = (one.by_log + one.by_posterior) ** 0.5
        reach = error * float(stdtrit(one.freedom, 0.975))
        small = _small(one.way.name, table, posterior)
        p = sum(float(stdtr(one.freedom, (sign * small - abs(one.size)) / error)) for sign in (1, -1))
        ends = (one.size, one.size - reach, one.size + reach)
        explains = 1.0 - one.loss / max(loss, 1e-300)
        rows.append(Changed(one.way.name, *_values(one.way.name, ends, table, posterior), max(explains, 0.0), p))
    return Drift(tuple(rows), LEVEL, tuple(_holm(rows)), seconds)


def _holm(rows: Sequence[Changed]) -> list[str]:
    """Return the names of the significant changes, over all tests together."""
    alarms: list[str] = []
    for i, row in enumerate(sorted(rows, key=lambda row: row.p)):
        if row.p > LEVEL / (len(rows) - i):
            break
        alarms.append(row.name)
    explains = {row.name: row.explains for row in rows}
    return [name for name in alarms if explains[name] >= _LEAST]


def _small(name: str, table: ParameterTable, posterior: Posterior) -> float:
    """Return the largest size that counts as no change, on the parameter's scale: 0 for a payload or an offset."""
    column = table.columns[table.names.index(name)] if name in table.names else None
    if name == ROUND_TRIP or (column is not None and column.kind == "delay"):
        return _SMALL * _round_trip_s(table, posterior)
    return _SMALL if column is None or column.transform == "log" else 0.0


def _round_trip_s(table: ParameterTable, posterior: Posterior) -> float:
    """Return the sum of the identified and the fixed delays [s]."""
    identified = sum(x for x, c in zip(posterior.mean, table.columns, strict=True) if c.kind == "delay")
    return float(identified + sum(p.nominal for p in table if p.kind == "delay" and not p.free))


def _values(
    name: str, ends: Sequence[float], table: ParameterTable, posterior: Posterior
) -> tuple[str, float, float, float, float]:
    """Return the unit, the value before, and the values after moves by ``ends`` on the scale; factors for a cause."""
    if name == ROUND_TRIP and name not in posterior.names:
        total = _round_trip_s(table, posterior)
        now, low, high = (float(max(total + e, 0.0)) for e in ends)
        return "s", total, now, low, high
    if name not in posterior.names:
        now, low, high = (float(np.exp(e)) for e in ends)
        return "", 1.0, now, low, high
    i = posterior.names.index(name)
    parameter = table.columns[i]
    before, now, low, high = (float(parameter.from_scale(posterior.mean[i] + e)) for e in (0.0, *ends))
    return parameter.unit, before, now, low, high
