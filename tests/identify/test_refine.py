"""Refinement: from any start to the same minimum, never away from it, and it says whether it got there."""

from types import SimpleNamespace

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from sim2real.errors import Sim2RealError
from sim2real.identify import fit as fitting
from sim2real.identify.config import FitConfig
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.problem.problem import Evaluation
from sim2real.identify.search.refine import _Descent, refine, remaining
from sim2real.identify.uncertainty.uncertainty import from_linearised, linearise

WIDE = 20.0


def valley(x):
    """Rosenbrock's residuals, and a third: at the minimum they are not 0."""
    return jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0], 0.5 * (x[0] + x[1])])


def table_of(count):
    return ParameterTable([Parameter("abc"[i], "1", 0.0, -WIDE, WIDE, "linear") for i in range(count)])


class Stub:
    """What refinement asks of a problem: residuals as a function of values, in one segment without initial states.

    Args:
        residuals: Values ``(P,)`` -> ``(N,)``.
        table: The parameters; default: two between -20 and 20.
        prior: Values -> residuals of priors.
        slope: Maps values and the derivative ``(N, P)`` to the one that is told; default: the derivative itself.
        held: Maps residuals at a point, and where a round began, to those that the round sees; default: the same,
            as where initial states are linearised at every point.
        options: Of ``FitConfig``.
    """

    def __init__(
        self,
        residuals,
        table=None,
        prior=lambda x: x[:0],
        slope=lambda x, J: J,
        held=None,
        **options,
    ):
        self.table, self.channels, self.segment_s = table or table_of(2), (), 1.0
        count = residuals(jnp.zeros(len(self.table))).size
        self.data = SimpleNamespace(present=np.ones(len(self.table), bool), fitted=np.zeros(1), count=count)
        self.fields, self.measurements = ("a",), count
        self.config = FitConfig(**{"initial_state": "rest", "refine_steps": 60, **options})
        self.evaluator, self._held = self, held or (lambda r, x, begun: r)
        self.fresh, self.precision = held is None, 1e-6
        self._both = jax.jit(lambda x: ((residuals(x), prior(x)), (jax.jacfwd(residuals)(x), jax.jacfwd(prior)(x))))
        self._slope = slope

    def at(self, z, data=None, on_compile=None):
        x, stretch = self.table.scale(np.asarray(z, np.float64))
        values, slopes = jax.tree.map(lambda a: np.asarray(a, np.float64), self._both(jnp.asarray(x, jnp.float32)))
        r, J = values[0], self._slope(x, slopes[0]) * stretch
        loss = 0.5 * (np.sum(r**2) + np.sum(values[1] ** 2)) / self.measurements
        shaped = r.reshape(1, -1, 1)
        return Evaluation(
            shaped, J.reshape(*shaped.shape, -1), shaped, values[1], slopes[1] * stretch, float(np.float32(loss))
        )

    def compared(self, data=None):
        return np.ones((1, self.measurements), bool)

    def loss(self, z, data=None, on_compile=None):
        return self.at(z).loss

    def losses(self, candidates, around, data=None):
        return np.array([self.loss(z) for z in candidates])

    def around(self, z, data):
        """Return what a round sees: residuals and those of priors, and their derivative."""
        begun = self.values(z)

        def value(y):
            found = self.at(y)
            r = self._held(found.residuals.ravel(), self.values(y), begun)
            return np.concatenate([r, found.prior])

        def slope(y):
            found = self.at(y)
            return np.concatenate([found.jacobian.reshape(-1, y.size), found.prior_jacobian])

        return value, slope

    def refined(self, *starts, **options):
        """Refine from some values."""
        return refine(self, np.stack([self.table.at_scale(np.asarray(x, float)) for x in starts]), **options)

    def values(self, z):
        return self.table.scale(np.asarray(z, np.float64))[0]


@pytest.fixture(scope="module")
def minimum():
    """Where scipy finds the valley's bottom."""

    def residuals(z):
        return np.array([10.0 * (z[1] - z[0] ** 2), 1.0 - z[0], 0.5 * (z[0] + z[1])])

    return optimize.least_squares(residuals, [0.5, 0.5], xtol=1e-12, ftol=1e-12, gtol=1e-12)


def test_the_best_of_all_starts_ends_where_scipy_does(minimum):
    told, problem = [], Stub(valley)
    found = problem.refined([-1.2, 1.0], [3.0, -2.0], on_step=lambda loss, z: told.append((loss, z)))
    losses = [loss for loss, _ in told]
    np.testing.assert_allclose(problem.values(found.z), minimum.x, atol=2e-3)
    assert found.loss == pytest.approx(minimum.cost / 3, rel=1e-3)
    assert found.converged
    assert found.left < 0.1
    assert found.before == pytest.approx(0.5 * float(np.sum(valley(jnp.array([-1.2, 1.0])) ** 2)) / 3, rel=1e-3)
    assert found.steps > 3
    assert len(found.ends) == 2
    assert min(loss for _, loss in found.ends) >= found.loss
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] == pytest.approx(found.loss, rel=1e-6)
    np.testing.assert_allclose(problem.values(told[-1][1]), problem.values(found.z), atol=1e-3)


@settings(max_examples=25, derandomize=True)
@given(st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)))
def test_descents_from_all_starts_end_at_the_same_estimate(minimum, start):
    problem = VALLEY
    found = problem.refined(start)
    assert found.converged
    error = np.sqrt(np.diag(from_linearised(problem, linearise(problem, found.z)).scale_covariance))
    assert np.all(np.abs(problem.values(found.z) - minimum.x) < 0.1 * error)


VALLEY = Stub(valley)


@pytest.mark.parametrize("steps", [3, 25])
def test_progress_adds_up_to_at_most_one(steps):
    problem, told = Stub(valley, refine_steps=steps), []
    starts = np.stack([problem.table.at_scale(np.array(x)) for x in ([-1.2, 1.0], [3.0, -2.0])])
    fitting._refine(problem, starts, lambda phase, share, loss, z: told.append((phase, share)))
    assert {phase for phase, _ in told} == {"refine"}
    assert 0.0 < sum(share for _, share in told) <= 1.0 + 1e-6


def test_a_start_at_the_optimum_stays(minimum):
    problem = Stub(valley)
    found = problem.refined(minimum.x)
    assert found.loss <= found.before
    assert found.converged
    np.testing.assert_allclose(problem.values(found.z), minimum.x, atol=1e-3)


@pytest.mark.parametrize(("share", "moves"), [(0.5, True), (2.0, False)])
def test_a_round_ends_where_its_step_gains_less_than_is_asked(minimum, share, moves):
    problem = Stub(valley)
    near = problem.table.at_scale(minimum.x + np.array([0.02, 0.0]))
    gained = 1.0 - minimum.cost / 3 / problem.loss(near)
    found = refine(problem, near[None], settle=False, gain=share * gained)
    assert np.array_equal(found.z, near) != moves
    assert moves or found.steps <= 3


def test_a_coarse_descent_ends_early_and_within_percents(minimum):
    """As for a model to compare with."""
    problem = Stub(valley)
    fine, coarse = (problem.refined([-1.2, 1.0], coarse=c) for c in (False, True))
    assert coarse.steps < fine.steps
    assert fine.loss <= coarse.loss < 1.03 * minimum.cost / 3


def hidden(problem, start, radius):
    """Return the problem with a derivative that points uphill within a radius around a start."""
    turned = lambda x, J: np.where(np.linalg.norm(x - start) < radius, -J, J)  # noqa: E731
    problem._slope = turned
    return problem


def line(x):
    """Residuals of 60 measurements of two numbers, true at (1, -2), with noise."""
    X = jnp.asarray(np.random.default_rng(0).normal(size=(60, 2)), jnp.float32)
    noise = jnp.asarray(np.random.default_rng(1).normal(size=60), jnp.float32)
    return X @ (x - jnp.array([1.0, -2.0])) + noise


def best_line():
    zero = np.asarray(line(jnp.zeros(2)), np.float64)
    J = np.asarray(jax.jacfwd(line)(jnp.zeros(2)), np.float64)
    return np.linalg.lstsq(J, -zero, rcond=None)[0], np.linalg.inv(J.T @ J)


def test_a_start_from_which_all_steps_are_rejected_is_no_minimum():
    """The derivative points uphill, everywhere: no step is ever better, and that is not taken for convergence."""
    best, covariance = best_line()
    start = best + 3.0 * np.sqrt(np.diag(covariance))
    problem = hidden(Stub(line), start, np.inf)
    found = problem.refined(start)
    assert not found.converged
    assert found.left > 0.5
    assert found.loss < found.before, "points around were tried, and some are better"


def test_from_where_the_derivative_is_wrong_a_better_point_around_leads_on():
    """As where friction sticks."""
    best, covariance = best_line()
    error = np.sqrt(np.diag(covariance))
    start = best + 3.0 * error
    problem = hidden(Stub(line), start, 0.1 * error.min())
    found = problem.refined(start)
    assert found.converged
    assert np.all(np.abs(problem.values(found.z) - best) < 0.1 * error)


def test_a_descent_that_got_stuck_goes_on_from_the_best_point_that_it_has_seen():
    """A hidden Go2's ended in the middle of its delays' common shift: worse by 1 %, and no point around was better."""
    problem = Stub(line)
    descent = _Descent(problem, problem.data, None, None)
    best, stuck = (problem.table.at_scale(best_line()[0] + off) for off in (0.0, 3.0))
    lower = descent.at(best)
    assert descent.around(stuck, descent.at(stuck)).tolist() == best.tolist()
    assert descent.around(best, lower) is None


def test_a_minimum_between_kinks_is_one_although_a_step_is_left():
    """The derivative on either side of a kink never vanishes: no point around is better."""
    best, covariance = best_line()
    error = np.sqrt(np.diag(covariance))
    kinked = lambda x: jnp.concatenate([line(x), 30.0 * jnp.sqrt(1.0 + jnp.abs(x - best) / jnp.asarray(error))])  # noqa: E731
    problem = Stub(kinked)
    found = problem.refined(best + 0.3 * error)
    assert found.converged
    assert np.all(np.abs(problem.values(found.z) - best) < 0.05 * error)


@settings(max_examples=15, derandomize=True)
@given(st.integers(0, 1000))
def test_whatever_a_derivative_says_nothing_gets_worse(seed):
    noise = np.random.default_rng(seed).normal(size=(3, 2))
    problem = Stub(valley, slope=lambda x, J: J * noise)
    found = problem.refined([4.0, 4.5], [3.0, 3.0])
    assert found.loss <= found.before
    assert found.loss == problem.at(found.z).loss


@settings(max_examples=15, derandomize=True)
@given(st.floats(0.3, 3.0), st.floats(-1.0, 1.0))
def test_what_a_round_holds_does_not_decide(size, direction):
    """A round may hold what changes with the parameters: what is worse by the full loss is not accepted."""
    best, covariance = best_line()
    error = np.sqrt(np.diag(covariance))
    away = np.array([1.0, direction]) * error.mean()
    # Far from where a round began, all seems better along one direction.
    held = lambda r, x, begun: r * np.exp(-size * (x - begun) @ away / (away @ away))  # noqa: E731
    problem = Stub(line, held=held)
    found = problem.refined(best + 2.0 * error)
    assert found.loss <= found.before
    assert found.loss == problem.at(found.z).loss
    assert found.converged or found.loss < found.before


def test_rounds_end_where_nothing_is_held(minimum):
    """What is held is exact where a round begins: several rounds end at the minimum."""
    bent = lambda r, x, begun: r * (1.0 + 0.05 * np.tanh(np.sum(x - begun)))  # noqa: E731
    problem = Stub(valley, held=bent)
    found = problem.refined([-1.2, 1.0])
    assert found.loss == pytest.approx(minimum.cost / 3, rel=0.01)


def test_starts_that_cannot_be_simulated_are_passed_over(minimum):
    broken = Stub(lambda x: jnp.where(x[0] < -5.0, jnp.nan, valley(x)))
    found = broken.refined([-9.0, 0.0], [0.5, 0.5])
    np.testing.assert_allclose(broken.values(found.z), minimum.x, atol=2e-3)
    with pytest.raises(Sim2RealError, match="no start of the refinement can be simulated"):
        broken.refined([-9.0, 0.0])


def test_a_descent_gets_past_what_cannot_be_simulated(minimum):
    holed = Stub(lambda x: jnp.where(jnp.abs(x[0] - 2.0) < 0.3, jnp.nan, valley(x)))
    np.testing.assert_allclose(holed.values(holed.refined([3.0, -2.0]).z), minimum.x, atol=2e-3)


@pytest.mark.parametrize("share", [1.0001, 1.1])
@pytest.mark.parametrize("weight", [1.0, 5.0])
def test_a_friction_without_effect_comes_back(minimum, share, weight):
    """Next to its bound it has hardly a derivative, so a step would have to be long, and the others move first."""
    low, dry = 1e-5, 1.2
    table = ParameterTable([*table_of(2), Parameter("dry", "1", 1.0, low, 10.0, "log")])
    problem = Stub(lambda x: jnp.concatenate([valley(x[:2]), weight * (jnp.exp(x[2:]) - dry)]), table)
    values = problem.values(problem.refined([-1.2, 1.0, np.log(share * low)], settle=False).z)
    np.testing.assert_allclose(values[:2], minimum.x, atol=2e-3)
    assert np.exp(values[2]) == pytest.approx(dry, rel=1e-2)


def test_an_absent_effect_stays_at_its_bound():
    table = ParameterTable([Parameter(name, "1", 1.0, 0.0, 10.0, "linear") for name in ("dry", "viscous")])
    problem = Stub(lambda x: jnp.stack([x[0] - 1.2, 3.0 * (x[1] + 0.1)]), table)
    values = problem.values(problem.refined([2.0, 0.0], settle=False).z)
    np.testing.assert_allclose(values, [1.2, 0.0], atol=2e-3)


def test_priors_take_part():
    table = ParameterTable([Parameter("a", "1", 0.0, -WIDE, WIDE, "linear", prior=distrax.Normal(6.0, 0.5))])
    problem = Stub(lambda x: x - 1.0, table, prior=lambda x: 2.0 * (x - 6.0))
    np.testing.assert_allclose(problem.values(problem.refined([0.0]).z), [5.0], atol=1e-3)


@pytest.mark.parametrize(("weight", "expected"), [(1e-4, -3.0), (10.0, 9.0)])
def test_a_parameter_that_hardly_acts_stays_at_its_nominal_value(weight, expected):
    """Else recordings that do depend on it are predicted wrongly: the stop of a joint went from -1.03 rad to -3."""
    table = ParameterTable([*table_of(2), Parameter("stop", "1", -3.0, -WIDE, WIDE, "linear")])
    problem = Stub(lambda x: jnp.concatenate([line(x[:2]), weight * (x[2:] - 9.0)]), table)
    for start in (-3.0, -18.0):
        found = problem.refined([0.0, 0.0, start])
        assert found.converged
        assert problem.values(found.z)[2] == pytest.approx(expected, abs=0.05)


def test_what_is_left_is_the_next_step_in_standard_errors():
    """Of a linear model: how far the point is from the estimate, whatever the units are."""
    best, covariance = best_line()
    off = np.array([0.3, -0.8]) * np.sqrt(np.diag(covariance))
    problem = Stub(line)
    variance = np.sum(np.asarray(line(jnp.asarray(best + off)), np.float64) ** 2) / 58
    left = remaining(problem, problem.table.at_scale(best + off))
    spread = from_linearised(problem, linearise(problem, problem.table.at_scale(best + off)))
    assert left == pytest.approx(0.8 / np.sqrt(variance * spread.inflation), rel=0.02)
    units = ParameterTable([Parameter(p.name, "1", 0.0, 1e3 * p.low, 1e3 * p.high, "linear") for p in problem.table])
    scaled = Stub(lambda x: line(1e-3 * x), units)
    assert remaining(scaled, units.at_scale(1e3 * (best + off))) == pytest.approx(left, rel=1e-3)


def test_at_a_bound_nothing_is_left_of_a_step_beyond_it():
    table = ParameterTable(
        [Parameter("a", "1", 0.0, -1.0, 1.0, "linear"), Parameter("b", "1", 0.0, -9.0, 9.0, "linear")]
    )
    problem = Stub(lambda x: line(jnp.stack([x[0] - 3.0, x[1]])), table)  # the best a is 4
    found = problem.refined([0.0, 0.0])
    assert found.converged
    assert problem.values(found.z)[0] == pytest.approx(1.0, abs=0.01)


@pytest.fixture(scope="module")
def refined(fitted):
    """The pendulum, refined from three places away."""
    starts = fitted.found.z + 0.3 * np.random.default_rng(0).standard_normal((3, 5))
    return [refine(fitted.problem, start[None]) for start in starts]


def test_the_pendulum_is_found_from_nearby(fitted, refined):
    for found in refined:
        assert found.converged
        assert found.loss < 0.1 * found.before
        assert found.loss < 1.001 * fitted.found.loss
        values = fitted.problem.table.decode(jnp.asarray(found.z))
        for group in ("gain", "gravity", "damping", "friction"):
            assert float(values[group]) == pytest.approx(fitted.truth[group], rel=0.03)
        total = float(values["sensor_delay"] + values["actuator_delay"])
        assert total == pytest.approx(fitted.truth["sensor_delay"] + fitted.truth["actuator_delay"], abs=0.001)


def test_the_pendulums_estimate_does_not_depend_on_the_start(fitted, refined):
    table, error = fitted.problem.table, np.sqrt(np.diag(fitted.spread.scale_covariance))
    x = np.array([table.scale(found.z)[0] for found in refined])
    assert np.all(np.ptp(x, axis=0) < 0.3 * error), np.ptp(x, axis=0) / error
    assert np.ptp([found.loss for found in refined]) < 2e-3 * refined[0].loss


def test_no_point_around_the_pendulums_estimate_is_better(fitted, refined):
    """Other points than those that refinement tries, by losses alone."""
    problem, found = fitted.problem, min(refined, key=lambda r: r.loss)
    error = np.sqrt(np.diag(fitted.spread.scale_covariance))
    at = problem.table.scale(found.z)[0]
    moves = np.random.default_rng(7).normal(size=(64, 5)) * error * np.random.default_rng(8).uniform(0.1, 1.0, (64, 1))
    around = np.array([problem.at(problem.table.at_scale(at + m)).loss for m in moves])
    assert around.min() > (1.0 - 2e-3) * found.loss


def test_the_pendulum_is_where_scipy_finds_it(fitted, refined):
    """Its other trust region, from a point nearby."""
    problem, here = fitted.problem, refined[0]

    def at(z):
        found = problem.at(z)
        return found.residuals.ravel(), found.jacobian.reshape(found.residuals.size, -1)

    start = here.z + np.array([0.1, -0.1, 0.1, -0.1, 0.05])
    found = optimize.least_squares(lambda z: at(z)[0], start, jac=lambda z: at(z)[1], x_scale="jac", method="dogbox")
    assert here.loss < 1.002 * found.cost / int(problem.data.count)
    decode = problem.table.decode
    theirs, ours = decode(jnp.asarray(found.x, jnp.float32)), decode(jnp.asarray(here.z))
    for group in ("gain", "gravity", "damping", "friction"):
        assert float(theirs[group]) == pytest.approx(float(ours[group]), rel=0.01)


def test_what_doubles_do_not_resolve_is_refined_all_the_same():
    """Two parameters of which the recording tells the sum alone, a million times, and one that it does not feel."""
    column = jnp.asarray(np.random.default_rng(0).normal(size=60), jnp.float32)
    noise = jnp.asarray(np.random.default_rng(1).normal(size=60), jnp.float32)
    problem = Stub(lambda x: 1e6 * column * (x[0] + x[1] - 3.0) + noise + 0.0 * x[2], table_of(3))
    found = problem.refined([0.5, 0.5, 1.0])
    x = problem.values(found.z)
    assert x[0] + x[1] == pytest.approx(3.0, abs=1e-4)
    assert np.isfinite(found.left)
