"""The residuals of a problem at every possible delay of a measurement, and their derivative by its unknowns."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.identify.delays.hidden_delays import Linearise
from sim2real.identify.delays.likelihood import DelayEvidence
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.programs import Program
from sim2real.identify.problem.segments import Data
from sim2real.types import Array, Scalar

_STEP_S = 0.001
"""Distance of the delays at which the motion is predicted [s]."""


@dataclass(frozen=True)
class Watched:
    """A problem for the search of hidden delays.

    Unknowns are the entries of ``z`` that are no delays and, where they are fitted, the initial states of segments.

    Attributes:
        linearise: From unknowns and a delay to the linearised measurements.
        x: Shape ``(P,)``: the unknowns at the estimate.
        delay_s: The measurements' delay at the estimate [s].
        again: Shape ``(N,)``, bool: whether a measurement repeats the previous values.
    """

    linearise: Linearise
    x: np.ndarray
    delay_s: float
    again: np.ndarray


def motion(problem: Problem, z: np.ndarray, late: str, delay_s: float) -> Watched:
    """Return the motion of a problem.

    Args:
        z: Shape ``(P,)``: the estimate.
        delay_s: The measurements' delay there [s].
    """
    data, table = problem.data, problem.table
    pick = _apart(problem)
    moved = np.array([i for i, c in enumerate(table.columns) if c.parameter.kind != "delay"], int)
    delays = np.linspace(0.0, table[late].high, max(2, round(table[late].high / _STEP_S) + 1))
    states = 2 * len(problem.channels) if problem.config.initial_state == "free" else 0
    x = np.concatenate([np.asarray(z, np.float64)[moved], np.zeros(states * len(pick))])
    curves, slopes = _programs(problem, jnp.asarray(z, jnp.float32), late, pick, data, delay_s, moved)
    ts = np.asarray(slopes(jnp.asarray(x[: len(moved)], jnp.float32), _shifts(x, moved, states, pick), delay_s)[2])
    counts = ts >= 0.0
    recording, stamps = problem.recording[pick], (ts + problem.begins_s[pick][:, None])
    for r in np.unique(recording):
        stamps[recording == r] -= stamps[recording == r][counts[recording == r]].mean()
    stretch = np.abs(table.scale(np.asarray(z))[1])[moved] / table.span[moved]
    prior = np.diag(np.concatenate([12.0 * stretch**2 + 1e-6, np.ones(states * len(pick))]))

    def linearise(x: np.ndarray, about_s: float) -> DelayEvidence:
        at, shift = jnp.asarray(x[: len(moved)], jnp.float32), _shifts(x, moved, states, pick)
        errors = np.asarray(curves(at, shift, jnp.asarray(delays, jnp.float32)), np.float64)  # (G, E, C, F)
        by_value, by_state, _ = (np.asarray(a, np.float64) for a in slopes(at, shift, about_s))
        jacobian = np.zeros((*by_value.shape[1:], len(x)))
        jacobian[..., : len(moved)] = np.moveaxis(by_value, 0, -1)
        for e in range(len(pick) if states else 0):
            jacobian[e, :, :, len(moved) + states * e : len(moved) + states * (e + 1)] = np.moveaxis(by_state[e], 0, -1)
        return DelayEvidence(stamps[counts], delays, np.moveaxis(errors, 0, -1)[counts], jacobian[counts], prior)

    return Watched(linearise, x, delay_s, _again(problem, data, pick)[counts])


def _programs(
    watched: Problem, z: jax.Array, late: str, pick: np.ndarray, data: Data, delay_s: float, moved: np.ndarray
) -> tuple[Program, Program]:
    """Return two compiled functions of unknowns, shifts of initial states ``(E, states)`` and delays.

    The first returns residuals ``(G, E, C, F)``. The second returns their derivative by the unknowns
    ``(P, E, C, F)`` and by the states ``(E, states, C, F)``, and the times of the measurements ``(E, C)``.
    """
    every, problem = jnp.asarray(pick), watched.residuals

    def residuals(at: jax.Array, shifts: jax.Array, delay: Scalar) -> tuple[jax.Array, jax.Array]:
        values = {**problem.table.decode(z.at[moved].set(at)), late: jnp.asarray(delay, jnp.float32)}
        if problem.table[late].per_recording:
            values[late] = jnp.full(problem.table.recordings, values[late])

        def one(eps: Array, shift: Array) -> tuple[jax.Array, jax.Array]:
            # The world is the same for all delays; only the time of the measurement differs.
            same = problem.start(eps, delay_s, data) - problem.start(eps, delay, data)
            error = problem.residuals(values, eps, shift * problem.prior + same, data)
            return error, data.ts[eps]

        return jax.vmap(one)(every, shifts)

    def curves(at: jax.Array, shifts: jax.Array, delays: jax.Array) -> jax.Array:
        return jax.lax.map(lambda d: residuals(at, shifts, d)[0], delays)

    def slopes(at: jax.Array, shifts: jax.Array, delay: Scalar) -> tuple[jax.Array, jax.Array, jax.Array]:
        f = problem.differentiable(lambda a: residuals(a, shifts, delay)[0])
        by_value = jax.vmap(lambda d: jax.jvp(f, (at,), (d,))[1])(jnp.eye(len(moved), dtype=at.dtype))
        size = shifts.shape[1]
        g = problem.differentiable(lambda u: residuals(at, shifts + u, delay)[0], 0.03)
        by_state = jax.vmap(lambda d: jax.jvp(g, (jnp.zeros(size),), (d,))[1])(jnp.eye(size))
        return by_value, jnp.swapaxes(by_state, 0, 1), residuals(at, shifts, delay)[1]

    return Program(curves), Program(slopes)


def _shifts(x: np.ndarray, moved: np.ndarray, states: int, pick: np.ndarray) -> jax.Array:
    """Return the initial states' shifts ``(E, 2 * channels)``; without any where they are not fitted."""
    return jnp.asarray(x[len(moved) :].reshape(len(pick), -1), jnp.float32) if states else jnp.zeros((len(pick), 1))


def _apart(problem: Problem) -> np.ndarray:
    """Return fitted segments that do not overlap, in the order of time: no measurement counts twice."""
    chosen: list[int] = []
    for e in sorted(problem.train, key=lambda e: (problem.recording[e], problem.begins_s[e])):
        same = bool(chosen) and problem.recording[chosen[-1]] == problem.recording[e]
        if not same or problem.begins_s[e] >= problem.begins_s[chosen[-1]] + problem.segment_s - 1e-9:
            chosen.append(int(e))
    if not chosen:
        raise UsageError("there is no fitted segment to find delays in")
    return np.array(chosen)


def _again(problem: Problem, data: Data, pick: np.ndarray) -> np.ndarray:
    """Return which measurements ``(E, C)`` have the values of the one before."""
    same = np.ones((len(pick), data.ts.shape[1]), bool)
    same[:, 0] = False
    for field, _, entry in problem.fields:
        rows = np.asarray(entry(np.asarray(data.measured[field])), np.float64)[pick]
        same[:, 1:] &= rows[:, 1:] == rows[:, :-1]
    return same
