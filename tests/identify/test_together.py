"""Parameters of separate trees share the rollouts of finite differences, with the same derivatives."""

import numpy as np

from sim2real.identify.problem.together import Together

RESPONDS = np.array([[1, 0, 1, 0, 0], [1, 0, 0, 1, 0], [0, 1, 1, 0, 0]], bool)  # (columns, parameters)


def linear(rng):
    """Return a Jacobian ``(S, K, F, P)`` whose parameter 4 has no effect."""
    return rng.normal(size=(2, 6, 3, 5)) * RESPONDS


def along(J, groups):
    return np.stack([J[..., group].sum(axis=-1) for group in groups])


def test_groups_have_the_derivatives_of_each():
    J = linear(np.random.default_rng(0))
    together, present = Together(apart=True), np.ones(5, bool)
    alone = together.groups(present)
    assert alone == [[0], [1], [2], [3], [4]]
    np.testing.assert_array_equal(together.jacobian(along(J, alone), alone, 5), J)
    shared = together.groups(present)
    assert shared == [[0, 1], [2, 3], [4]]
    np.testing.assert_array_equal(together.jacobian(along(J, shared), shared, 5), J)
    # A parameter that is no part of the model is not moved.
    without = together.groups(np.array([False, True, True, True, True]))
    assert without == [[1, 3], [2], [4]]
    part = together.jacobian(along(J, without), without, 5)
    assert not part[..., 0].any()


def test_coupled_joints_are_moved_one_at_a_time():
    J = linear(np.random.default_rng(1))
    together = Together(apart=False)
    groups = together.groups(np.ones(5, bool))
    together.jacobian(along(J, groups), groups, 5)
    assert together.groups(np.ones(5, bool)) == [[0], [1], [2], [3], [4]]
