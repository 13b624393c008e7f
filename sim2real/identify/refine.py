"""Local refinement by Levenberg-Marquardt, from the best candidates of a search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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
_TOLERANCE, _TOLERANCE_C = (1e-5, 1e-6), (1e-4, 1e-4)
"""Relative and absolute change of point and loss at which a round ends. Finer steps are lost in the noise of finite
differences: an arm on C took twice the steps to the same point."""


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

    Raises:
        Sim2RealError: When no start has a finite loss.
    """
    data = data or problem.part()
    if ("improve", steps) not in problem.programs:
        with telling(on_compile):
            like = jnp.asarray(starts[0], jnp.float32)
            columns, _ = problem.at(like, data)
            problem.programs["improve", steps] = _program(problem, steps).lower(like, columns, data).compile()
    improve = problem.programs["improve", steps]
    begin = [problem.at(s, data) for s in starts]
    first = [loss for _, loss in begin]
    if not np.isfinite(first).any():
        raise Sim2RealError(
            "no start of the refinement can be simulated: every loss is infinite or no number",
            hint="search first, with generations above 0, or check the nominal values",
        )
    best, best_loss, taken = np.asarray(starts[int(np.nanargmin(first))]), float(np.nanmin(first)), 0
    going = [(jnp.asarray(z, jnp.float32), columns, loss) for z, (columns, loss) in zip(starts, begin, strict=True)]
    ends: list[tuple[np.ndarray, float]] = []
    for turn in range(rounds):
        ended = []
        for z, columns, loss in going:
            moved, count = improve(z, columns, data)
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


def _program(problem: Problem, steps: int) -> Any:
    """Return one round of Levenberg-Marquardt, jitted: ``z, columns, data -> (z, steps taken)``."""
    import optimistix  # 0.5 s

    rtol, atol = _TOLERANCE_C if problem.engine.name == "c" else _TOLERANCE
    solver = optimistix.LevenbergMarquardt(rtol=rtol, atol=atol)
    scale = 1.0 / np.sqrt(max(problem.measurements, 1))

    def improve(z: Any, columns: Any, data: Data) -> tuple[Any, Any]:
        def weighed(y: Any) -> Any:
            residuals = problem.stacked(y, columns, data).reshape(-1)
            return scale * jnp.concatenate([residuals, problem.table.prior_residuals(y)])

        residuals = by_jacobian(problem.differentiable(weighed))
        found = optimistix.least_squares(
            lambda y, _: residuals(y), solver, z, options={"jac": "fwd"}, max_steps=steps, throw=False
        )
        return found.value, found.stats["num_steps"]

    return program(improve)
