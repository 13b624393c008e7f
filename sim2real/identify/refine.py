"""Local refinement by damped least squares, from the best candidates of a search.

Where rollouts are part of a program, so is the whole descent: optimistix's Levenberg-Marquardt. On C its steps are
scipy's, which takes derivatives of accepted steps alone; optimistix takes them of rejected ones, too. From one start a
quadruped of 16 parameters ended after 14 Jacobians instead of 25, at the same loss: 10.6 instead of 18 s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.identify.derivative import by_jacobian
from sim2real.identify.problem import Problem
from sim2real.identify.programs import program
from sim2real.identify.search import telling
from sim2real.identify.segments import Data

_GAIN = 1e-4
"""A round that gains a smaller share of the loss is the last."""
_STEPS = 8
"""Most steps of a short round, on C: of a quadruped the loss is within 0.01 % of its end after four."""
_TOLERANCE = (1e-5, 1e-6)
"""Relative and absolute change of point and loss at which a round of a program ends."""
_LEAST, _MOST = 1e-4, 1e-3
"""Relative change at which one on C does, from the finest to the coarsest: a round's own gain in between. Finer steps
are lost in the noise of finite differences: an arm took twice the steps to the same point."""
Improve = Callable[[Any, Any, Data, float, float], tuple[Any, Any]]
"""One round: ``z, columns, data``, least gain of a step on C, its least move in a program ``-> (z, steps taken)``."""


@dataclass(frozen=True)
class Refined:
    """Where refinement ended.

    Attributes:
        z: Shape ``(P,)``: the best point; where nothing got better, the best start.
        loss: Its loss.
        before: Loss of the best start.
        steps: Steps of Levenberg-Marquardt, of all starts.
        ends: Where each start's first round ended, ``(P,)``, and the loss there.
    """

    z: np.ndarray
    loss: float
    before: float
    steps: int
    ends: tuple[tuple[np.ndarray, float], ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether refinement made the loss smaller."""
        return self.loss < self.before


def effort(problem: Problem, rounds: int = 1) -> tuple[int, int]:
    """Return most steps of a round, and most rounds, for a descent that begins near its end: on C short ones.

    A fit from far keeps long rounds: with short ones a quadruped's ended 0.3 % above another optimum.

    Args:
        problem: The residuals.
        rounds: Most rounds of as many steps as are configured.
    """
    steps = problem.config.refine_steps
    if problem.engine.name != "c" or steps <= _STEPS:
        return steps, rounds
    return _STEPS, -(-rounds * steps // _STEPS) if rounds > 1 else 1


def refine(
    problem: Problem,
    starts: np.ndarray,
    steps: int = 25,
    rounds: int = 3,
    on_round: Callable[[float, np.ndarray], None] | None = None,
    data: Data | None = None,
    on_compile: Callable[[bool], None] | None = None,
    gain: float = _GAIN,
    enough: float = 0.0,
) -> Refined:
    """Improve each start by a round, the best of them by further ones; one that does not lower the loss is dropped.

    How residuals depend on initial states is linearised once a round.

    Args:
        problem: The residuals.
        starts: Shape ``(K, P)``.
        steps: Most steps of a round.
        rounds: Most rounds.
        on_round: Called after each round with the best loss and point so far.
        data: What is fitted; default: the problem's logs.
        on_compile: Called with True before a program is compiled, and with False afterwards.
        gain: A round that gains a smaller share of the loss is the last.
        enough: In a program, a step that moves the residuals by a smaller share of their size is its round's last: for
            a descent that begins near its end; far from it a step around a bend moves them as little.

    Raises:
        Sim2RealError: When no start has a finite loss.
    """
    data = data or problem.part()
    if ("improve", steps) not in problem.programs:
        with telling(on_compile):
            problem.programs["improve", steps] = _improve(problem, steps, jnp.asarray(starts[0], jnp.float32), data)
    improve = problem.programs["improve", steps]
    begin = [problem.at(s, data) for s in starts]
    first = [loss for _, loss in begin]
    _require_finite(first)
    best, best_loss, taken = np.asarray(starts[int(np.nanargmin(first))]), float(np.nanmin(first)), 0
    going = [(jnp.asarray(z, jnp.float32), columns, loss) for z, (columns, loss) in zip(starts, begin, strict=True)]
    ends: list[tuple[np.ndarray, float]] = []
    for turn in range(rounds):
        ended = []
        for z, columns, loss in going:
            moved, count = improve(z, columns, data, gain, enough)
            taken += int(count)
            after, new = problem.at(moved, data)
            better = bool(jnp.all(jnp.isfinite(moved))) and new < loss
            if better and new < best_loss:
                best, best_loss = np.asarray(moved), new
            if turn == 0:
                ends.append((np.asarray(moved), new) if better else (np.asarray(z), loss))
            if better and loss - new >= gain * abs(loss):
                ended.append((moved, after, new))
            if on_round:
                on_round(best_loss, best)
        # A round nearly ends a descent: only the best goes on, if it is one of those that still gain.
        going = [e for e in ended if e[2] == best_loss]
    return Refined(best, best_loss, float(np.nanmin(first)), taken, tuple(ends))


def _require_finite(losses: Sequence[float]) -> None:
    if not np.isfinite(losses).any():
        raise Sim2RealError(
            "no start of the refinement can be simulated: every loss is infinite or no number",
            hint="search first, with generations above 0, or check the nominal values",
        )


def _improve(problem: Problem, steps: int, like: Any, data: Data) -> Improve:
    """Return one round of descent, compiled for points like this one."""
    columns, _ = problem.at(like, data)
    scale = 1.0 / np.sqrt(max(problem.measurements, 1))

    def weighed(y: Any, columns: Any, data: Data) -> Any:
        residuals = problem.stacked(y, columns, data).reshape(-1)
        return scale * jnp.concatenate([residuals, problem.table.prior_residuals(y)])

    if problem.engine.name == "c":
        return _on_host(problem, weighed, steps, (like, columns, data))
    compiled = _as_program(problem, weighed, steps).lower(like, columns, data, jnp.float32(0.0)).compile()
    return lambda z, columns, data, _, enough: compiled(z, columns, data, jnp.float32(enough))


def _on_host(problem: Problem, weighed: Callable[..., Any], steps: int, like: Any) -> Improve:
    """Return a round of scipy's trust-region method."""
    from scipy.optimize import least_squares  # 0.2 s

    def columns_of(y: Any, columns: Any, data: Data) -> Any:
        f = problem.differentiable(lambda x: weighed(x, columns, data))
        return jax.vmap(lambda d: jax.jvp(f, (y,), (d,))[1], out_axes=-1)(jnp.eye(y.size, dtype=y.dtype))

    value, slope = (program(f).lower(*like).compile() for f in (weighed, columns_of))

    def improve(z: Any, columns: Any, data: Data, gain: float, _: float) -> tuple[Any, Any]:
        def of(f: Callable[..., Any]) -> Callable[[np.ndarray], np.ndarray]:
            return lambda y: np.asarray(f(jnp.asarray(y, jnp.float32), columns, data), np.float64)

        if not np.isfinite(of(value)(z)).all():
            return z, 0
        least = float(np.clip(gain, _LEAST, _MOST))
        jac: Any = of(slope)  # scipy's stubs know the names of its own differences alone
        found = least_squares(of(value), np.asarray(z, np.float64), jac, ftol=least, xtol=_LEAST, max_nfev=steps)
        return jnp.asarray(found.x, jnp.float32), found.njev

    return improve


def _as_program(problem: Problem, weighed: Callable[..., Any], steps: int) -> Any:
    """Return a round of optimistix's Levenberg-Marquardt, jitted.

    By itself it ends when no residual changes any more, which in single precision rarely comes: it takes all its steps.
    Where less will do, a step that moves the residuals by less than a share of their size is the last: near the optimum
    it gains the square of that share of the loss.
    """
    import optimistix  # 0.5 s

    def improve(z: Any, columns: Any, data: Data, enough: Any) -> tuple[Any, Any]:
        residuals = by_jacobian(problem.differentiable(lambda y: weighed(y, columns, data)))
        size = jnp.linalg.norm(weighed(z, columns, data))
        tolerance: Any = [jnp.where(enough > 0, a, b) for a, b in zip((0.0, enough * size), _TOLERANCE, strict=True)]

        def norm(x: Any) -> Any:  # of the point's change over its tolerance, and of that of the residuals
            coarse = jnp.linalg.norm(x) if x.size != z.size else 0.0
            return jnp.where(enough > 0, coarse, jnp.max(jnp.abs(x)))

        solver = optimistix.LevenbergMarquardt(*tolerance, norm=norm)
        found = optimistix.least_squares(
            lambda y, _: residuals(y), solver, z, options={"jac": "fwd"}, max_steps=steps, throw=False
        )
        return found.value, found.stats["num_steps"]

    return program(improve)
