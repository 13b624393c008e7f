"""Residuals of a segment: its initial state is fitted, and to no more than it may be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_folds import BIAS, CONFIG, GAIN, NOISE, TAU_S, Model, lag_log

from sim2real.artifacts.identification import Noise
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.validation import prediction
from sim2real.stages.deploy.replay import _of_noise

LENGTH_S, SPLIT_S = 0.93, 0.4
SPANS = [Span(0, 0.4 + 0.9 * i, fitted=i != 4) for i in range(9)]
TRUE = {"gain": GAIN, "tau": TAU_S, "bias": BIAS, "square": 0.0, "offset": 0.0}


@pytest.fixture(scope="module")
def problem():
    return Problem(Model(), [lag_log(0)], SPANS, LENGTH_S, CONFIG)


@pytest.fixture(scope="module")
def values(problem):
    """The true parameters, with a bias that is a little off."""
    return {n: jnp.float32(v) for n, v in (TRUE | {"bias": BIAS + 0.01}).items()}


@pytest.mark.parametrize("fit_s", [None, SPLIT_S])
def test_an_initial_state_is_that_of_least_squares(problem, values, fit_s):
    """A lag is linear in it: numpy solves for it at once, with a prior around the estimate."""
    own, data = problem.residuals, problem.data
    found = jax.jit(lambda e: own.initial_state(values, e, data, fit_s))(2)
    run = jax.jit(lambda u: own.residuals(values, 2, u * own.prior, data))
    r = np.asarray(run(jnp.zeros(2)), np.float64).ravel()
    J = np.stack([np.asarray(run(jnp.eye(2)[i]), np.float64).ravel() - r for i in range(2)], axis=1)
    ts = np.asarray(data.ts[2])
    J, near = J * ((ts <= (fit_s or LENGTH_S)) & (ts >= 0))[:, None], r * (ts <= (fit_s or LENGTH_S))
    shift = -np.linalg.solve(J.T @ J + np.eye(2), J.T @ near)
    np.testing.assert_allclose(found.shift, shift, atol=2e-3 * np.abs(shift).max())
    np.testing.assert_allclose(found.residuals, run(jnp.asarray(found.shift)), atol=1e-3)
    assert np.sum(np.asarray(found.residuals) ** 2) < np.sum(r**2)


def test_a_state_that_is_known_close_by_is_stepped_to(problem, values):
    """The candidates of a generation have the states of its middle, and the step from there."""
    own, data = problem.residuals, problem.data
    other = values | {"gain": jnp.float32(1.02 * GAIN)}
    state = jax.jit(lambda e: own.initial_state(values, e, data))(3)
    stepped = jax.jit(lambda s: own.projected(other, 3, s, data))(state)
    exact = jax.jit(lambda e: own.initial_state(other, e, data))(3).residuals
    np.testing.assert_allclose(stepped, exact, atol=2e-3 * np.abs(exact).max())


def test_what_is_predicted_does_not_know_what_comes(problem):
    """Of held-out segments only the first part is told: measurements behind it change no prediction."""
    rows = {n: np.full(1, v) for n, v in TRUE.items()}
    where, fit_s = np.array([4]), np.array([SPLIT_S])
    before = problem.predict(rows, where, fit_s)
    other = Problem(Model(), [lag_log(0)], SPANS, LENGTH_S, CONFIG)
    late = np.asarray(other.data.ts) > SPLIT_S
    changed = {f: jnp.asarray(np.where(late, 9.0, m)) for f, m in other.data.measured.items()}
    other.data = other.data._replace(measured=changed)
    after = other.predict(rows, where, fit_s)
    ts = problem.ts[4]
    assert np.abs(before[0][(ts > 0)]).max() < 8.0, "it is a good model"
    np.testing.assert_allclose(after[0][ts <= SPLIT_S], before[0][ts <= SPLIT_S], atol=1e-4)
    ahead = ts > SPLIT_S
    predicted = problem.measured(0)[4][ahead] + NOISE * before[0][ahead, 0]
    np.testing.assert_allclose(9.0 + NOISE * after[0][ahead, 0], predicted, atol=1e-4)
    assert np.abs(problem.predict(rows, where, np.array([LENGTH_S])) - before).max() > 1e-3


def test_predictions_do_not_depend_on_how_many_there_are(problem):
    """They are made in parts of one size: as many rows as there are segments, more or fewer."""
    rng, every = np.random.default_rng(0), np.arange(9)
    many = np.concatenate([every, every[::-1], every])
    rows = {n: v + 0.01 * rng.normal(size=27) for n, v in TRUE.items()}
    fit_s = rng.uniform(0.2, 0.9, 27)
    whole = problem.predict(rows, many, fit_s)
    assert whole.shape == (27, *problem.ts.shape[1:], 1)
    for i in (0, 10, 26):
        one = problem.predict({n: v[i : i + 1] for n, v in rows.items()}, many[i : i + 1], fit_s[i : i + 1])
        np.testing.assert_allclose(one[0], whole[i], atol=1e-4)


@pytest.mark.parametrize(("tau_s", "least", "most"), [(TAU_S, 0.8, 1.3), (-0.2, 2.0, 20.0)])
def test_an_unchanged_robot_is_predicted_from_noisy_readings_as_well_as_its_equilibrium_allows(
    problem, tau_s, least, most
):
    """A lag forgets the error of its initial state; with the other sign the error grows by e each 0.2 s."""
    robot, every = TRUE | {"tau": tau_s}, np.ones(problem.segments, bool)
    columns = prediction.samples(problem, {"identified": robot}, SPLIT_S, every)
    (name,) = prediction.labels(problem)
    exact, noisy = (
        _of_noise(problem, columns, [Noise(name, "", deviation, 0.0, 0.0)], robot, SPLIT_S, LENGTH_S - SPLIT_S)[name]
        for deviation in (0.0, NOISE)
    )
    assert exact < 0.3 * noisy
    assert least * NOISE < noisy < most * NOISE


def test_where_the_models_own_motion_diverges_its_error_is_infinite(problem):
    """Not a number is no error: nothing can be compared with it."""
    columns = prediction.samples(problem, {"identified": TRUE}, SPLIT_S, np.ones(problem.segments, bool))
    (name,) = prediction.labels(problem)
    columns[f"{name}_identified"] = np.full_like(columns["into"], np.nan)
    noise = [Noise(name, "", NOISE, 0.0, 0.0)]
    assert _of_noise(problem, columns, noise, TRUE, SPLIT_S, LENGTH_S - SPLIT_S) == {name: np.inf}
