"""Segments on C MuJoCo and in the compiled graph: the same numbers, whatever the delays."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_robot import SERVOS, SHEET, VALUES, PairRobot

from sim2real.graph.episode import Episode, Steps
from sim2real.identification.config import FitConfig
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span

pytestmark = pytest.mark.night  # `make test` compares the engines in test_drive_terms.py
MAX_DELAY_S, SEGMENT_S = 0.03, 0.4
LIMITS = {"gain": (2.0, 8.0), "damping": (0.05, 0.4), "armature": (0.003, 0.03), "friction_left": (0.01, 0.1)}
LIMITS |= {"stribeck": (0.05, 2.0)}


def converged_robot():
    return PairRobot(converged=True)


def worn_robot():
    """Its friction wears off with speed."""
    return PairRobot(replace(SERVOS, sheet=replace(SHEET, stribeck_rad_s=0.5)), converged=True)


def steps(start, stamp, end):
    none = np.zeros_like(start)
    return Steps(scheduled=start, start=start, woken=start, ts_overwrite=stamp, end=end, drift=none)


def pair_log():
    """Goals and samples off every grid, some goals in a burst; what was measured does not matter here."""
    rng, count = np.random.default_rng(1), 60
    slots = np.arange(count) * 20_000
    stamp = slots + rng.integers(0, 8000, count)
    sent = slots + rng.integers(0, 15_000, count)
    sent[20] = sent[21] - 300
    goals = np.cumsum(rng.uniform(-0.1, 0.1, (count, 2)), axis=0)
    still = np.zeros((count, 2))
    return Episode(
        steps={"sensor": steps(stamp, stamp, stamp + 10), "actuator": steps(sent, np.full(count, -1), sent)},
        messages={},
        outputs={"sensor": {"position": still, "velocity": still}, "actuator": {"goal": goals}},
    )


@pytest.fixture(scope="module")
def episode():
    return pair_log()


@pytest.fixture(scope="module", params=[converged_robot, worn_robot], ids=["constant", "worn"])
def engines(request, episode):
    """Two segments on both engines. What is worn has a term more than what is constant: otherwise the same robot."""
    made = {}
    for engine in ("c", "compiled"):
        config = FitConfig(max_delay_s=MAX_DELAY_S, initial_state="measured", engine=engine)
        model = request.param().identifiable(MAX_DELAY_S)
        made[engine] = Problem(model, [episode], [Span(0, 0.2), Span(0, 0.55)], SEGMENT_S, config)
        assert made[engine].engine.name == engine
    return SimpleNamespace(**made, worn=request.param is worn_robot)


def played(problem, values, shift=(0.2, -0.1, 1.0, -2.0)):
    """Return the residuals of both segments [rad]."""
    rows = {p.name: np.full(2, values.get(p.name, p.nominal)) for p in problem.table}
    shifts = np.repeat(np.array(shift)[None] / problem.rollouts.prior, 2, axis=0)
    return problem.errors(rows, np.arange(2), shifts) * np.array([s for _, s, _ in problem.fields])


delays = st.floats(0.0, MAX_DELAY_S)


@settings(max_examples=8, deadline=None, derandomize=True)
@given(delays, delays, st.fixed_dictionaries({k: st.floats(*ends) for k, ends in LIMITS.items()}))
def test_both_engines_say_the_same(engines, sensor, actuator, own):
    values = {**VALUES, **own, "sensor_delay": sensor, "actuator_delay": actuator}
    np.testing.assert_allclose(played(engines.c, values), played(engines.compiled, values), rtol=0, atol=2e-4)


@pytest.mark.parametrize("name", ["sensor_delay", "actuator_delay"])
def test_that_would_fail_if_a_tick_were_wrong(engines, name):
    values = {**VALUES, "stribeck": 0.5, "sensor_delay": 0.006, "actuator_delay": 0.011}
    there = played(engines.c, {**values, name: values[name] + 0.01})
    assert np.abs(there - played(engines.compiled, values)).max() > 1e-2


def test_friction_wears_off_only_where_the_robot_says_so(engines):
    values = {**VALUES, "friction_left": 0.1, "sensor_delay": 0.0, "actuator_delay": 0.01}
    one, other = (played(engines.compiled, {**values, "stribeck": width}) for width in (0.1, 1.0))
    assert (np.abs(one - other).max() > 1e-2) == engines.worn
