"""What evaluates residuals on C MuJoCo, and what does in a program: the same numbers."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_robot import VALUES
from test_engines import MAX_DELAY_S, SEGMENT_S, converged_robot, pair_log

from sim2real.identification.config import FitConfig
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span

pytestmark = pytest.mark.night  # MJX compiles for two minutes

TRUTH = {**VALUES, "stribeck": 0.5, "sensor_delay": 0.006, "actuator_delay": 0.011}
SHIFT = (0.02, -0.01, 0.1, -0.2)


def shown_by(problem):
    """Return what a robot from other initial states than those of the log would have measured, with noise."""
    every, rng = np.arange(problem.segments), np.random.default_rng(0)
    values = {p.name: np.full(len(every), TRUTH.get(p.name, p.nominal)) for p in problem.table}
    shift = np.repeat(np.array(SHIFT)[None] / problem.rollouts.prior, len(every), axis=0)
    errors = problem.errors(values, every, shift)
    read = {f: np.array(rows, np.float64) for f, rows in problem.readings.items()}
    for i, (field, sigma, _) in enumerate(problem.fields):
        channel = problem.channels[i // 2]
        read[field][..., channel.index] += sigma * (errors[..., i] + rng.normal(size=errors.shape[:2]))
    return read


@pytest.fixture(scope="module", params=["free", "measured"])
def problems(request):
    """The same segments on both engines; one of them is held out."""
    made = {}
    for engine in ("c", "compiled"):
        config = FitConfig(max_delay_s=MAX_DELAY_S, initial_state=request.param, engine=engine)
        model, spans = converged_robot().identifiable(MAX_DELAY_S), [Span(0, b, b != 0.4) for b in BEGINS_S]
        made[engine] = Problem(model, [pair_log()], spans, SEGMENT_S, config)
    measured = shown_by(made["c"])
    return SimpleNamespace(**{engine: problem.with_readings(measured) for engine, problem in made.items()})


BEGINS_S = (0.2, 0.3, 0.4, 0.5, 0.55)


def near(problems, held, given=2e-3):
    """Return how close values are to be [deviations]: C holds the slopes of an initial state, and programs do not."""
    return {"rtol": 1e-3, "atol": held if problems.c.config.initial_state == "free" else given}


def test_both_engines_evaluate_alike(problems):
    """Residuals, derivatives and losses by way of C's evaluator and by programs."""
    c, compiled = problems.c, problems.compiled
    z = c.table.encode({**TRUTH, "gain": 1.05 * VALUES["gain"]})
    one, other = c.linearise(z), compiled.linearise(z)
    assert np.abs(other.raw).max() > 5.0
    np.testing.assert_allclose(one.raw, other.raw, **near(problems, 0.25, 0.01))
    np.testing.assert_allclose(one.residuals, other.residuals, **near(problems, 0.25, 0.01))
    assert np.linalg.norm(one.jacobian - other.jacobian) < 0.1 * np.linalg.norm(other.jacobian)
    assert one.loss == pytest.approx(other.loss, rel=0.01)
    candidates = z + 0.01 * c.table.span * np.random.default_rng(0).normal(size=(3, len(z)))
    np.testing.assert_allclose(c.losses(candidates, z), compiled.losses(candidates, z), rtol=0.05)
    # A descent keeps the derivatives by initial states of the first point, an estimate's are taken again.
    assert c.losses(z[None], z)[0] == pytest.approx(one.loss, rel=2e-3)


def test_both_engines_predict_alike(problems):
    c, compiled = problems.c, problems.compiled
    rows = {p.name: np.full(2, TRUTH.get(p.name, p.nominal)) for p in c.table}
    one, other = (p.predict(rows, np.array([1, 2]), np.array([0.2, 0.3])) for p in (c, compiled))
    np.testing.assert_allclose(one, other, **near(problems, 0.05, 0.01))
