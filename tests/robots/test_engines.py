"""Segments of a servo robot on C MuJoCo and in the compiled graph: the same numbers, and those of a loop by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_robot import SERVOS, SHEET, VALUES, PairRobot, play_on_c

from sim2real.graph.episode import Episode, Steps
from sim2real.identification.config import FitConfig
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span

MAX_DELAY_S = 0.03
LIMITS = {"gain": (2.0, 8.0), "damping": (0.05, 0.4), "armature": (0.003, 0.03), "friction_left": (0.01, 0.1)}
LIMITS |= {"stribeck": (0.05, 2.0)}
TRUTH = {**VALUES, "stribeck": 0.5, "sensor_delay": 0.006, "actuator_delay": 0.011}
WORN = replace(SERVOS, sheet=replace(SHEET, stribeck_rad_s=0.5))
"""Servos whose friction wears off with speed."""


def recorded(stamp, sent, position, velocity, goals):
    """Return an episode of samples and goals, at times [us]."""
    none = np.zeros_like(sent)
    sensor = Steps(stamp, stamp, stamp, stamp, stamp + 10, none)
    actuator = Steps(sent, sent, sent, none - 1, sent, none)
    outputs = {"sensor": {"position": position, "velocity": velocity}, "actuator": {"goal": goals}}
    return Episode(steps={"sensor": sensor, "actuator": actuator}, messages={}, outputs=outputs)


@pytest.fixture(scope="module")
def episode():
    """Goals and samples off every grid, some goals in a burst; what was measured does not matter here."""
    rng, count = np.random.default_rng(1), 60
    slots = np.arange(count) * 20_000
    stamp = slots + rng.integers(0, 8000, count)
    sent = slots + rng.integers(0, 15_000, count)
    sent[20] = sent[21] - 300
    goals = np.cumsum(rng.uniform(-0.1, 0.1, (count, 2)), axis=0)
    return recorded(stamp, sent, np.zeros((count, 2)), np.zeros((count, 2)), goals)


def on_both(robot, episode, begins_s, initial_state):
    made = {}
    for engine in ("c", "compiled"):
        config = FitConfig(max_delay_s=MAX_DELAY_S, initial_state=initial_state, engine=engine)
        spans = [Span(0, b, b != 0.4) for b in begins_s]  # one may be held out
        made[engine] = Problem(robot.identifiable(MAX_DELAY_S), [episode], spans, 0.4, config)
        assert made[engine].engine.name == engine
    return made


@pytest.fixture(scope="module", params=[SERVOS, WORN], ids=["constant", "worn"])
def engines(request, episode):
    """Two segments on both engines. What is worn has a term more than what is constant: otherwise the same robot."""
    made = on_both(PairRobot(request.param, converged=True), episode, (0.2, 0.55), "measured")
    return SimpleNamespace(**made, worn=request.param is WORN)


def played(problem, values, shift=(0.2, -0.1, 1.0, -2.0)):
    """Return the residuals of all segments [deviations]."""
    every = np.arange(problem.segments)
    rows = {p.name: np.full(len(every), values.get(p.name, p.nominal)) for p in problem.table}
    return problem.errors(rows, every, np.repeat(np.array(shift)[None] / problem.rollouts.prior, len(every), axis=0))


def si(problem, residuals):
    return residuals * np.array([s for _, s, _ in problem.fields])


delays = st.floats(0.0, MAX_DELAY_S)


@pytest.mark.night  # `make test` compares the engines in test_drive_terms.py
@settings(max_examples=8, deadline=None, derandomize=True)
@given(delays, delays, st.fixed_dictionaries({k: st.floats(*ends) for k, ends in LIMITS.items()}))
def test_both_engines_say_the_same(engines, sensor, actuator, own):
    values = {**VALUES, **own, "sensor_delay": sensor, "actuator_delay": actuator}
    one, other = (si(p, played(p, values)) for p in (engines.c, engines.compiled))
    np.testing.assert_allclose(one, other, rtol=0, atol=2e-4)


@pytest.mark.night
@pytest.mark.parametrize("name", ["sensor_delay", "actuator_delay"])
def test_that_would_fail_if_a_tick_were_wrong(engines, name):
    late, other = played(engines.c, {**TRUTH, name: TRUTH[name] + 0.01}), played(engines.compiled, TRUTH)
    assert np.abs(si(engines.c, late - other)).max() > 1e-2


@pytest.mark.night
def test_friction_wears_off_only_where_the_robot_says_so(engines):
    values = {**VALUES, "friction_left": 0.1, "sensor_delay": 0.0, "actuator_delay": 0.01}
    one, other = (played(engines.compiled, {**values, "stribeck": width}) for width in (0.1, 1.0))
    assert (np.abs(si(engines.c, one - other)).max() > 1e-2) == engines.worn


@pytest.fixture(scope="module", params=["free", "measured"])
def problems(request, episode):
    """The same segments on both engines, with measurements of a robot from other initial states, and noise."""
    made = on_both(PairRobot(converged=True), episode, (0.2, 0.3, 0.4, 0.5, 0.55), request.param)
    problem, rng = made["c"], np.random.default_rng(0)
    errors = played(problem, TRUTH, (0.02, -0.01, 0.1, -0.2))
    read = {f: np.array(rows, np.float64) for f, rows in problem.readings.items()}
    for i, (field, sigma, _) in enumerate(problem.fields):
        channel = problem.channels[i // 2]
        read[field][..., channel.index] += sigma * (errors[..., i] + rng.normal(size=errors.shape[:2]))
    return SimpleNamespace(**{engine: p.with_readings(read) for engine, p in made.items()})


@pytest.mark.night
def test_both_engines_evaluate_and_predict_alike(problems):
    """Residuals, derivatives and losses by way of C's evaluator and by programs."""
    c, compiled = problems.c, problems.compiled
    # C holds the slopes of an initial state, and programs do not.
    near, ahead = ({"rtol": 1e-3, "atol": free if c.config.initial_state == "free" else 0.01} for free in (0.25, 0.05))
    z = c.table.encode({**TRUTH, "gain": 1.05 * VALUES["gain"]})
    one, other = c.linearise(z), compiled.linearise(z)
    assert np.abs(other.raw).max() > 5.0
    np.testing.assert_allclose(one.raw, other.raw, **near)
    np.testing.assert_allclose(one.residuals, other.residuals, **near)
    assert np.linalg.norm(one.jacobian - other.jacobian) < 0.1 * np.linalg.norm(other.jacobian)
    assert one.loss == pytest.approx(other.loss, rel=0.01)
    candidates = z + 0.01 * c.table.span * np.random.default_rng(0).normal(size=(3, len(z)))
    np.testing.assert_allclose(c.losses(candidates, z), compiled.losses(candidates, z), rtol=0.05)
    # A descent keeps the derivatives by initial states of the first point, an estimate's are taken again.
    assert c.losses(z[None], z)[0] == pytest.approx(one.loss, rel=2e-3)
    rows = {p.name: np.full(2, TRUTH.get(p.name, p.nominal)) for p in c.table}
    one, other = (p.predict(rows, np.array([1, 2]), np.array([0.2, 0.3])) for p in (c, compiled))
    np.testing.assert_allclose(one, other, **ahead)


PERIOD_S, SAMPLE_S, SENSOR_DELAY_S = 0.02, 0.005, 0.004
"""Samples come so long after the slots, in the middle of a tick, and are stamped before the next tick is over."""


def test_the_model_explains_what_its_own_physics_did_on_c(pair):
    """No profile is under way where these segments begin, but one of the joints is in full swing."""
    count = 110
    t = PERIOD_S * np.arange(count)
    goals = np.stack([0.6 * np.sin(4 * t), np.where(t % 1.0 < 0.5, 0.2, -0.1)], axis=1)
    _, positions, speeds = play_on_c(pair, VALUES, [0.0, 0.0], [0.0, 0.0], np.repeat(goals, 2, axis=0))
    ticks = pair.model.tick_s * np.arange(2 * count + 1)
    shown, fast = (
        np.stack([np.interp(t + SAMPLE_S, ticks, np.append(0.0, rows[:, j])) for j in range(2)], axis=1)
        for rows in (positions, speeds)
    )
    # A measurement is stamped a delay after the instant that it shows; goals leave just before their tick.
    slots = np.arange(count) * round(PERIOD_S * 1e6)
    stamp, sent = slots + round((SAMPLE_S + SENSOR_DELAY_S) * 1e6), np.maximum(slots - 1250 - 5, 0)
    config = FitConfig(max_delay_s=MAX_DELAY_S, initial_state="measured", skip_s=0.2)
    log, spans = recorded(stamp, sent, shown, fast, goals), [Span(0, b) for b in (0.35, 1.35)]
    problem = Problem(pair.identifiable(MAX_DELAY_S), [log], spans, 0.6, config)
    assert set(problem.table.names) == {*VALUES, "actuator_delay"}  # the sensor's is a constant of the model
    counted, values = problem.ts >= 0, {**VALUES, "sensor_delay": SENSOR_DELAY_S, "actuator_delay": 0.0}
    assert counted.sum() > 30
    right, wrong = (
        si(problem, played(problem, {**values, "gain": gain}, np.zeros(4)))[..., [0, 2]][counted]
        for gain in (VALUES["gain"], 1.3 * VALUES["gain"])
    )
    assert np.abs(right).max() < 0.002
    assert np.sqrt(np.mean(wrong**2)) > 3 * np.sqrt(np.mean(right**2))
