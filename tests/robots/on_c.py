"""The residuals of a problem's segments on C MuJoCo, between the two programs of its engine."""

import jax
import numpy as np


def residuals_on_c(problem):
    """Return a function of values, a shift of the initial state and a segment: its residuals ``(K, F)``."""
    residuals, data = problem.residuals, problem.data
    inputs = jax.jit(lambda v, shift, e: residuals.inputs(v, e, shift, data))
    errors = jax.jit(lambda v, shift, e, moved: residuals.errors(v, e, shift, moved, data))

    def run(values, shift, segment=0):
        moved = residuals.outside.step(jax.tree_util.tree_map(np.asarray, inputs(values, shift, segment)))
        return errors(values, shift, segment, moved)

    return run
