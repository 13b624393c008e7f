"""Draws come of all models that explain the recordings as well, each as if it were the only one."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from test_folds import CONFIG, LENGTH_S, TICK_S, Lag, Level, Model, lag_log, spans

from sim2real.identify.fit import fit
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty import ensemble
from sim2real.identify.uncertainty.uncertainty import from_linearised, linearise
from sim2real.identify.validation.optional_terms import Selection
from sim2real.stages.identify.judgement import Findings


def of(found, every=None, choice=None):
    at = linearise(found.problem, found.z)
    return ensemble.posterior(found, at, from_linearised(found.problem, at), every or found, choice)


def test_draws_are_of_all_near_models_by_their_weights_and_a_term_that_one_lacks_is_off():
    episode = lag_log(0)
    every = fit(Model(), [episode], spans(0), LENGTH_S, CONFIG)
    fewer = every.problem.table.with_terms(["bias"])
    found = fit(Model(), [episode], spans(0), LENGTH_S, CONFIG, fewer)
    near = np.array([[True, False], [True, True], [False, False]])
    choice = Selection(tuple(SimpleNamespace(present=k, z=every.z) for k in near), np.array([0.5, 0.3, 0.2]), ())
    posterior = of(found, every, choice)
    assert [(o.about, o.weight) for o in posterior.others] == [("with bias, square", 0.3)], "without bias it is worse"
    assert posterior.without == {"square": 0.0}
    (other,) = posterior.others
    whole = every.uncertainty()
    np.testing.assert_allclose(other.posterior.mean, every.problem.table.scale(every.z)[0], atol=2e-4)
    deviation = np.sqrt(np.diag(other.posterior.covariance))
    np.testing.assert_allclose(deviation, np.sqrt(np.diag(whole.scale_covariance)), rtol=0.3)
    drawn = posterior.sample(np.random.default_rng(0), 4000)
    assert set(drawn) == set(every.problem.table.names)
    assert np.mean(drawn["square"] != 0.0) == pytest.approx(0.3, abs=0.03)
    there = drawn["square"] != 0.0
    assert drawn["square"][there].std() == pytest.approx(deviation[-1], rel=0.1)


class Rooted(Model):
    """Its gain is the square of a number, whose sign nothing tells."""

    parameters = ParameterTable(
        [
            Parameter("root", "1", 1.0, -2.0, 2.0, "linear"),
            Parameter("gain", "1", 1.0, 0.1, 9.0, free=False, leaf="world.gain"),
            *(p for p in Model.parameters if p.name in ("tau", "bias", "offset")),
        ]
    )

    def params(self, values, start):
        return super().params({**values, "gain": values["root"] ** 2}, start)


def test_another_optimum_that_is_as_good_joins_and_one_that_is_worse_or_the_same_does_not():
    whole = fit(Rooted(), [lag_log(0)], spans(0), LENGTH_S, CONFIG)
    table = whole.problem.table
    starts = np.stack([whole.z, table.encode({"root": -1.0, "tau": 0.1, "bias": 0.0})])
    both = refine(whole.problem, starts)
    assert len(both.ends) == 2
    posterior = of(replace(whole, refined=(both,)))
    assert [o.weight for o in posterior.others] == [0.5]
    root = posterior.sample(np.random.default_rng(0), 1000)["root"]
    assert np.mean(root < 0.0) == pytest.approx(0.5, abs=0.05)
    np.testing.assert_allclose(np.abs(root), np.sqrt(1.7), atol=0.01)
    ends = ((whole.z, whole.loss), (both.ends[1][0], 2.0 * whole.loss))
    assert of(replace(whole, refined=(replace(both, ends=ends),))).others == ()


class Clipped(Lag):
    """A lag whose input is cut at a limit, which stands where the square does."""

    def step(self, step_state):
        p, command = step_state.params, step_state.inputs["actuator"][-1].data.u
        steady = p.gain * (jnp.clip(command, -p.square, p.square) + p.bias)
        new = Level(y=steady + (step_state.state.y - steady) * jnp.exp(-TICK_S / p.tau))
        return step_state.replace(state=new), new


class Limited(Model):
    """Inputs go up to 1; the data sheet says that its limit is 1.5."""

    world = Clipped
    parameters = ParameterTable(
        [
            *(p for p in Model.parameters if p.name != "square"),
            Parameter("most", "1", 1.5, 0.3, 3.0, begin=0.5, limits=True, leaf="world.square"),
        ]
    )


@pytest.mark.night
def test_a_limit_that_no_motion_reaches_is_the_data_sheets_and_draws_are_above_what_was_reached():
    found = Findings.of(fit(Limited(), [lag_log(0)], spans(0), LENGTH_S, CONFIG))
    names = found.fit.problem.table.names
    at = names.index("most")
    assert found.spread.verdict[at] == "not reached"
    assert found.fit.values["most"] == pytest.approx(1.5, rel=1e-3)
    assert found.fit.values["gain"] == pytest.approx(1.7, rel=0.01)
    assert 0.9 < found.spread.low[at] < 1.0
    drawn = ensemble.posterior(found.fit, found.at, found.spread, found.fit, None)
    most = drawn.sample(np.random.default_rng(0), 500)["most"]
    assert most.min() >= found.spread.low[at] * (1 - 1e-9)
    assert np.mean(most > 1.5) > 0.2
