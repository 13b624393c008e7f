"""Residuals, their derivatives and initial states of a lag, which is solved by hand."""

import numpy as np
import pytest
from lag import BIAS, CONFIG, GAIN, NOISE, PERIOD_S, TAU_S, TRUE, Lag, Model, lag_log
from scipy.optimize import least_squares

from sim2real.artifacts.identification import Noise
from sim2real.identification import predictions
from sim2real.identification.derivatives import Groups, Nearby
from sim2real.identification.residuals import Problem, robust
from sim2real.identification.segments import Span
from sim2real.stages.deploy.replay import _of_noise

LENGTH_S, SPLIT_S = 0.93, 0.4
SPANS = [Span(0, 0.4 + 0.9 * i, fitted=i != 4) for i in range(9)]
OFF = {"gain": 1.3 * GAIN, "tau": 0.8 * TAU_S, "bias": 0.1, "square": -0.2, "offset": 0.0}


class Outside(Lag):
    outside = True


class OutsideModel(Model):
    world = Outside


@pytest.fixture(scope="module")
def problem():
    return Problem(Model(), [lag_log(0)], SPANS, LENGTH_S, CONFIG)


def by_hand(problem, segment, values, start):
    """Return the residuals of a segment ``(K,)`` from a start: commands hold for a period and act at once."""
    ts = problem.ts[segment]
    first = round(problem.begins_s[segment] / PERIOD_S)
    u = lag_log(0).outputs["actuator"]["u"]
    y, found = start, []
    for k in range(len(ts)):
        found.append((y - problem.measured(0)[segment][k]) / NOISE if ts[k] >= 0 else 0.0)
        steady = values["gain"] * (u[first + k] + values["bias"] + values["square"] * u[first + k] ** 2)
        y = steady + (y - steady) * np.exp(-PERIOD_S / values["tau"])
    return np.array(found)


def rows(values, count):
    return {n: np.full(count, v) for n, v in values.items()}


@pytest.mark.parametrize("model", [Model, OutsideModel])
def test_errors_are_those_of_the_solution_by_hand_for_any_number_of_copies(model):
    problem = Problem(model(), [lag_log(0)], SPANS, LENGTH_S, CONFIG)
    rng = np.random.default_rng(0)
    segment, shift = rng.integers(0, 9, 300), rng.normal(size=(300, 2))
    gain = rng.uniform(1.0, 2.0, 300)
    values = rows(OFF, 300) | {"gain": gain}
    found = problem.errors(values, segment, shift)
    starts = problem.rollouts.starts(values, segment, shift, problem.data)[:, 0]
    for i in (0, 31, 299):
        expected = by_hand(problem, segment[i], OFF | {"gain": gain[i]}, starts[i])
        np.testing.assert_allclose(found[i, :, 0], expected, atol=2e-3 * np.abs(expected).max())
    alone = problem.errors({n: v[31:32] for n, v in values.items()}, segment[31:32], shift[31:32])
    np.testing.assert_allclose(alone[0], found[31], atol=1e-3)


def stacked(problem, x, part=None):
    """Return the robust residuals with each initial state solved for, all at once."""
    there = problem.near(x, part or problem.part())
    return robust(there.residuals(x), CONFIG.reach)[0]


def test_the_jacobian_is_that_of_the_residuals_with_the_best_initial_states(problem):
    x = problem.table.encode({"gain": 1.05 * GAIN, "tau": 0.97 * TAU_S, "bias": 0.18, "square": -0.03, "offset": 0.0})
    at = problem.linearise(x)
    np.testing.assert_allclose(at.residuals.ravel(), stacked(problem, x), atol=1e-3 * np.abs(at.residuals).max())
    for i in range(len(x)):
        h = 2e-3 * problem.table.span[i] * (np.arange(len(x)) == i)
        slope = (stacked(problem, x + h) - stacked(problem, x - h)) / (2 * h[i])
        assert np.linalg.norm(at.jacobian[..., i].ravel() - slope) < 0.05 * np.linalg.norm(slope)
    assert at.loss == pytest.approx(problem.loss(x), rel=1e-3)
    assert at.loss == pytest.approx(0.5 * np.mean(at.residuals[at.compared] ** 2), rel=1e-6)


@pytest.mark.parametrize("end", ["low", "high"])
def test_at_a_bound_the_derivative_is_taken_inside(problem, end):
    table = problem.table
    x = table.encode(TRUE | {"gain": table["gain"].low if end == "low" else table["gain"].high})
    at, inside = problem.linearise(x), problem.linearise(x + (1e-3 if end == "low" else -1e-3) * table.span)
    own, expected = at.jacobian[..., 0], inside.jacobian[..., 0]
    assert np.linalg.norm(own - expected) < 0.05 * np.linalg.norm(expected)


def test_what_is_left_out_counts_nowhere(problem):
    x, gone = problem.table.encode(OFF), problem.train[[0, 3]]
    at, rest = problem.linearise(x), problem.linearise(x, problem.part(gone))
    kept = ~np.isin(problem.train, gone)
    np.testing.assert_allclose(rest.residuals[kept], at.residuals[kept], atol=1e-3 * np.abs(at.residuals).max())
    assert not rest.residuals[~kept].any()
    assert not rest.compared[~kept].any()
    fewer = problem.linearise(x, problem.part(present=np.array([True, True, False, False])))
    assert not fewer.jacobian[..., 2:].any()
    without = problem.linearise(problem.table.encode(OFF | {"bias": 0.0, "square": 0.0}))
    np.testing.assert_allclose(fewer.raw, without.raw, atol=1e-3 * np.abs(without.raw).max())


def test_programs_are_compiled_once_for_all_problems_of_a_model(problem):
    x = problem.table.encode(TRUE)
    problem.linearise(x)
    compiled = {n: p._cache_size() for n, p in problem.rollouts.programs.items()}
    other = problem.recut([Span(0, s.begin_s + 0.3, s.fitted) for s in SPANS[:-1]] + [SPANS[-1]], LENGTH_S)
    other.linearise(x, other.part(present=np.arange(4) < 2))
    assert {n: p._cache_size() for n, p in problem.rollouts.programs.items()} == compiled


def test_each_run_is_compared_up_to_its_own_end(problem):
    runs = problem.recut([Span(0, 0.4, False), Span(0, 3.0, False)], LENGTH_S, ends_s=[0.5, LENGTH_S])
    last = runs.ts.max(axis=1)
    assert last[0] == pytest.approx(0.5, abs=PERIOD_S)
    assert last[1] == pytest.approx(LENGTH_S, abs=PERIOD_S)


@pytest.mark.parametrize("fit_s", [LENGTH_S, SPLIT_S])
def test_an_initial_state_is_that_of_least_squares(problem, fit_s):
    """A lag is linear in it: numpy solves for it at once, with a prior around the estimate."""
    values, segment = rows(TRUE | {"bias": BIAS + 0.01}, 1), np.array([2])
    found, start = problem.simulated(values, segment, np.array([fit_s]))
    run = lambda u: problem.errors(values, segment, np.asarray(u, float)[None]).ravel()  # noqa: E731
    r, ts = run([0.0, 0.0]), problem.ts[2]
    J = np.stack([run(np.eye(2)[i]) - r for i in range(2)], axis=1)
    counts = (ts >= 0) & (ts <= fit_s)
    shift = -np.linalg.solve((J * counts[:, None]).T @ J + np.eye(2), J.T @ (r * counts))
    np.testing.assert_allclose(found[0, :, 0], r + J @ shift, atol=2e-2)
    expected = problem.rollouts.starts(values, segment, shift[None], problem.data)
    np.testing.assert_allclose(start, expected, atol=1e-3)


def test_what_is_predicted_does_not_know_what_comes(problem):
    """Of held-out segments only the first part is told: measurements behind it change no prediction."""
    where, fit_s, ts = np.array([4]), np.array([SPLIT_S]), problem.ts[4]
    before = problem.predict(rows(TRUE, 1), where, fit_s)
    late = np.where(problem.ts > SPLIT_S, 9.0, problem.measured(0))
    after = problem.with_readings({"y": late}).predict(rows(TRUE, 1), where, fit_s)
    assert np.abs(before[0][ts > 0]).max() < 8.0, "it is a good model"
    np.testing.assert_allclose(after[0][ts <= SPLIT_S], before[0][ts <= SPLIT_S], atol=1e-4)
    ahead = ts > SPLIT_S
    predicted = problem.measured(0)[4][ahead] + NOISE * before[0][ahead, 0]
    np.testing.assert_allclose(9.0 + NOISE * after[0][ahead, 0], predicted, atol=1e-4)


@pytest.mark.parametrize(("reach", "loss"), [(5.0, "soft_l1"), (np.inf, "linear")])
def test_the_robust_loss_is_scipys(reach, loss):
    r = np.array([-4e3, -30.0, -1.0, -1e-6, 0.0, 0.3, 7.0, 1e3])
    cost = [least_squares(lambda x, v=v: x * 0 + v, [1.0], loss=loss, f_scale=5.0, max_nfev=1).cost for v in r]
    found, slope = robust(r, reach)
    np.testing.assert_allclose(0.5 * found**2, cost, rtol=1e-9, atol=1e-14)
    h = 1e-5 * np.maximum(np.abs(r), 1.0)
    np.testing.assert_allclose(slope, (robust(r + h, reach)[0] - robust(r - h, reach)[0]) / (2 * h), rtol=1e-4)


def test_a_jacobian_is_corrected_until_it_no_longer_predicts_the_step():
    A, computed = np.random.default_rng(0).normal(size=(6, 2)), []
    there = Nearby(lambda y: A @ y, lambda y: computed.append(1) or A.T.copy())
    for y in ([0.0, 0.0], [1.0, 0.5], [2.0, -1.0]):
        np.testing.assert_allclose(there.jacobian(np.array(y)), A.T)
    assert len(computed) == 1
    # A step that failed may ask for a computed one, once.
    assert (there.renew(np.array(y)), there.renew(np.array(y)), len(computed)) == (True, False, 2)
    computed.clear()
    slope = lambda y: computed.append(1) or np.diag(9.0 * np.cos(9.0 * y))  # noqa: E731
    for most, count in ((None, 3), (1, 1)):
        there = Nearby(lambda y: np.sin(9.0 * y), slope, most=most)
        for y in (0.0, 1.0, 2.0):
            there.jacobian(np.array([y]))
        assert len(computed) == count
        computed.clear()


def test_columns_of_separate_trees_are_moved_together():
    """Two legs of two joints each, of which the second moves with the first, and a delay of all."""
    J, width = np.zeros((5, 3, 4)), np.full(5, 2.0)
    J[0, :, :2] = J[2, :, 2:] = 1.0
    J[1, :, 1] = J[3, :, 3] = J[4] = 2.0
    groups = Groups(apart=True)
    assert groups.members(range(5)) == [[0], [1], [2], [3], [4]]
    np.testing.assert_array_equal(groups.spread(2.0 * J, groups.members(range(5)), width), J)
    together = groups.members(range(5))
    assert sorted(map(sorted, together)) == [[0, 2], [1, 3], [4]]
    changes = np.stack([2.0 * J[g].sum(axis=0) for g in together])
    np.testing.assert_array_equal(groups.spread(changes, together, width), J)
    assert Groups(apart=False).members(range(2)) == [[0], [1]]
    # Initial states belong to their whole tree: at another point more of it may respond.
    states = Groups(apart=True, by_tree=True)
    states.spread(J[:4], [[0], [1], [2], [3]], width[:4])
    assert states.members(range(4)) == [[0, 2], [1, 3]]


POSITIONS = (predictions.Position("y", "y", "", NOISE),)


@pytest.mark.parametrize(("tau_s", "least", "most"), [(TAU_S, 0.8, 1.3), (-0.2, 2.0, 20.0)])
def test_an_unchanged_robot_is_predicted_from_noisy_readings_as_well_as_its_equilibrium_allows(
    problem, tau_s, least, most
):
    """A lag forgets the error of its initial state; with the other sign the error grows by e each 0.2 s."""
    robot, every = TRUE | {"tau": tau_s}, np.ones(problem.segments, bool)
    columns = predictions.samples(problem, {"identified": robot}, SPLIT_S, every)
    (name,) = predictions.labels(problem)
    exact, noisy = (
        _of_noise(
            problem, POSITIONS, columns, [Noise(name, "", deviation, 0.0, 0.0)], robot, SPLIT_S, LENGTH_S - SPLIT_S
        )[name]
        for deviation in (0.0, NOISE)
    )
    assert exact < 0.3 * noisy
    assert least * NOISE < noisy < most * NOISE


def test_where_the_models_own_motion_diverges_its_error_is_infinite(problem):
    """Not a number is no error: nothing can be compared with it."""
    columns = predictions.samples(problem, {"identified": TRUE}, SPLIT_S, np.ones(problem.segments, bool))
    (name,) = predictions.labels(problem)
    columns[f"{name}_identified"] = np.full_like(columns["into"], np.nan)
    noise = [Noise(name, "", NOISE, 0.0, 0.0)]
    assert _of_noise(problem, POSITIONS, columns, noise, TRUE, SPLIT_S, LENGTH_S - SPLIT_S) == {name: np.inf}
