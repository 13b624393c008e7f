"""Identifying a servo robot: residuals of segments that C MuJoCo has played."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_robot import VALUES, play_on_c

from sim2real.graph.episode import Episode, Steps
from sim2real.identification.config import FitConfig
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span

MAX_DELAY_S, PERIOD_S, SEGMENT_S = 0.03, 0.02, 0.6
SENSOR_DELAY_S = 0.004
"""Less than a tick: when a sample is stamped, the tick behind it is not over."""
SAMPLE_S = 0.005
"""Samples are taken so long after the slots, in the middle of a tick."""
BEGINS_S = (0.35, 1.35)
TRUTH = {**VALUES, "sensor_delay": SENSOR_DELAY_S, "actuator_delay": 0.0}


def steps(start, stamp, end):
    none = np.zeros_like(start)
    return Steps(scheduled=start, start=start, woken=start, ts_overwrite=stamp, end=end, drift=none)


@pytest.fixture(scope="module")
def episode(pair):
    """Two seconds of the robot's own model on C: goals act from the tick after they were sent, half a step early."""
    count = 110
    t = PERIOD_S * np.arange(count)
    goals = np.stack([0.6 * np.sin(4 * t), np.where(t % 1.0 < 0.5, 0.2, -0.1)], axis=1)
    _, positions, speeds = play_on_c(pair, VALUES, [0.0, 0.0], [0.0, 0.0], np.repeat(goals, 2, axis=0))
    ticks = pair.model.tick_s * np.arange(2 * count + 1)
    shown, fast = (
        np.stack([np.interp(t + SAMPLE_S, ticks, np.append(0.0, rows[:, j])) for j in range(2)], axis=1)
        for rows in (positions, speeds)
    )
    slots = np.arange(count) * round(PERIOD_S * 1e6)
    # A measurement is stamped a delay after the instant that it shows; goals leave just before their tick.
    stamp = slots + round((SAMPLE_S + SENSOR_DELAY_S) * 1e6)
    sent = np.maximum(slots - 1250 - 5, 0)
    return Episode(
        steps={"sensor": steps(stamp, stamp, stamp + 10), "actuator": steps(sent, np.full(count, -1), sent)},
        messages={},
        outputs={"sensor": {"position": shown, "velocity": fast}, "actuator": {"goal": goals}},
    )


@pytest.fixture(scope="module")
def residuals(pair, episode):
    """Residuals of both segments at the truth and with a wrong gain, from the middle of the recording."""
    config = FitConfig(max_delay_s=MAX_DELAY_S, initial_state="measured", skip_s=0.2)
    spans = [Span(0, b) for b in BEGINS_S]
    problem = Problem(pair.identifiable(MAX_DELAY_S), [episode], spans, SEGMENT_S, config)
    every, errors = np.arange(len(spans)), {}
    for name, gain in (("true", TRUTH["gain"]), ("wrong", 1.3 * TRUTH["gain"])):
        values = {n: np.full(len(every), v) for n, v in (TRUTH | {"gain": gain}).items()}
        errors[name] = problem.errors(values, every, np.zeros((len(every), 4)))
    return SimpleNamespace(problem=problem, config=config, ts=problem.ts, **errors)


def test_the_model_explains_what_its_own_physics_did_on_c(residuals):
    """No profile is under way where these segments begin, but one of the joints is in full swing."""
    error, counted = residuals.true, residuals.ts >= 0
    assert counted.sum() > 30
    position = error[..., [0, 2]][counted] * 0.002
    assert np.abs(position).max() < 0.002
    wrong = residuals.wrong[..., [0, 2]][counted] * 0.002
    assert np.sqrt(np.mean(wrong**2)) > 3 * np.sqrt(np.mean(position**2))
