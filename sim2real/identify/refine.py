"""Local refinement by Levenberg-Marquardt, from the best candidates of a search."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.identify.derivative import by_jacobian
from sim2real.identify.problem import Data, Problem
from sim2real.identify.search import telling


@dataclass(frozen=True)
class Refined:
    """Where refinement ended.

    Attributes:
        z: Shape ``(P,)``: the best point; where nothing got better, the best start.
        loss: Its loss.
        before: Loss of the best start.
        steps: Steps of Levenberg-Marquardt, of all starts.
    """

    z: np.ndarray
    loss: float
    before: float
    steps: int

    @property
    def accepted(self) -> bool:
        """Whether refinement made the loss smaller."""
        return self.loss < self.before


def refine(
    problem: Problem,
    starts: np.ndarray,
    steps: int = 25,
    rounds: int = 3,
    on_round: Callable[[float, np.ndarray], None] | None = None,
    data: Data | None = None,
    on_compile: Callable[[bool], None] | None = None,
) -> Refined:
    """Improve each start, and return the best result; a round that does not lower the loss is dropped.

    How residuals depend on initial states is linearised once a round.

    Args:
        problem: The residuals.
        starts: Shape ``(K, P)``.
        steps: Most steps of a round.
        rounds: Most rounds from a start; the first that gains less than 0.01 % is the last.
        on_round: Called after each round with the best loss and point so far.
        data: What is fitted; default: the problem's logs.
        on_compile: Called with True before a program is compiled, and with False afterwards.

    Raises:
        Sim2RealError: When no start has a finite loss.
    """
    data = data or problem.part()
    if ("improve", steps) not in problem.programs:
        with telling(on_compile):
            like = jnp.asarray(starts[0], jnp.float32)
            problem.programs["improve", steps] = _program(problem, steps).lower(like, data).compile()
    improve = problem.programs["improve", steps]
    of_data = problem.programs.setdefault("loss", jax.jit(lambda z, d: problem.losses(z[None], z, data=d)[0]))
    full_loss = functools.partial(of_data, d=data)
    first = [float(full_loss(jnp.asarray(s, jnp.float32))) for s in starts]
    if not np.isfinite(first).any():
        raise Sim2RealError(
            "no start of the refinement can be simulated: every loss is infinite or no number",
            hint="search first, with generations above 0, or check the nominal values",
        )
    best, best_loss, taken = np.asarray(starts[int(np.nanargmin(first))]), float(np.nanmin(first)), 0
    for start, loss in zip(starts, first, strict=True):
        z = jnp.asarray(start, jnp.float32)
        for _ in range(rounds):
            moved, count = improve(z, data)
            taken += int(count)
            new = float(full_loss(moved))
            better = bool(jnp.all(jnp.isfinite(moved))) and new < loss
            gain = loss - new
            if better:
                z, loss = moved, new
                if new < best_loss:
                    best, best_loss = np.asarray(z), new
            if on_round:
                on_round(best_loss, best)
            if not better or gain < 1e-4 * abs(loss):
                break
    return Refined(best, best_loss, float(np.nanmin(first)), taken)


def _program(problem: Problem, steps: int) -> Any:
    """Return one round of Levenberg-Marquardt, jitted: ``z, data -> (z, steps taken)``."""
    import optimistix  # 0.5 s

    rtol, atol = problem.tolerance
    solver = optimistix.LevenbergMarquardt(rtol=rtol, atol=atol)
    scale = 1.0 / np.sqrt(max(problem.measurements, 1))

    def improve(z: Any, data: Data) -> tuple[Any, Any]:
        columns = problem.sensitivities(z, data=data)

        def weighed(y: Any) -> Any:
            residuals = problem.stacked(y, columns, data).reshape(-1)
            return scale * jnp.concatenate([residuals, problem.table.prior_residuals(y)])

        residuals = by_jacobian(problem.differentiable(weighed))
        found = optimistix.least_squares(
            lambda y, _: residuals(y), solver, z, options={"jac": "fwd"}, max_steps=steps, throw=False
        )
        return found.value, found.stats["num_steps"]

    return jax.jit(improve)
