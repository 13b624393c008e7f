"""The residuals of a problem's first segment on C MuJoCo, between the two programs of its engine."""

import jax
import numpy as np


def residuals_on_c(problem, values, shift):
    """Return the residuals ``(K, F)`` with a shifted initial state ``(2 * channels,)``."""
    residuals, data = problem.residuals, problem.data
    inputs = jax.jit(lambda v: residuals.inputs(v, 0, shift, data))(values)
    moved = residuals.outside.step(jax.tree_util.tree_map(np.asarray, inputs))
    return jax.jit(lambda v, *moved: residuals.errors(v, 0, shift, moved, data))(values, *moved)
