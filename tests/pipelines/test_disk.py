"""The disk's model against a loop of its own, its identification, and a real recording that it foretells."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from recorded_robots import RecordedRobotConformance, episode, predictions, public, rmse

from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.stages.load import load_robot

PIPELINE = load_robot("disk")
PERIOD_S, STEP_S = 0.025, 0.0001
MAX_DELAY_S = PIPELINE.defaults.identify.max_delay_s
GOOD = {
    "gain": 28.2765, "gravity": 136.105, "damping": 1.1728, "load": 0.04663, "swing": 0.10936, "cogging": 0.0,
    "voltage_offset": -0.06482, "offset": 0.04902, "eccentricity": 0.01787, "delay": 0.02495,
}  # fmt: skip
"""Of the real disk."""
TRUTH = {
    "gain": 31.0, "gravity": 121.0, "damping": 1.9, "load": 0.06, "swing": 0.15, "cogging": 0.8,
    "voltage_offset": 0.0, "offset": 0.04, "eccentricity": -0.02, "delay": 0.0237,
}  # fmt: skip
"""Of the synthetic one."""


def encoder(v, angle):
    return angle + v["offset"] + v["eccentricity"] * np.sin(angle)


def simulated(v, voltage, start, step_s=STEP_S):
    """Return the angle at each sample, in plain floats: small steps of Euler, commands when they come, to the step.

    ``voltage[k]`` is sent at sample ``k``; before the first it held already.
    """
    th, w = start
    per_sample, late = round(PERIOD_S / step_s), round(v["delay"] / step_s)
    rows = []
    for i in range(per_sample * len(voltage)):
        if i % per_sample == 0:
            rows.append(th)
        u = voltage[max(0, (i - late) // per_sample)] + v["voltage_offset"]
        push = v["gain"] * u - v["gravity"] * math.sin(th) + v["cogging"] * math.cos(2 * th) - v["damping"] * w
        rubs = v["load"] * abs(v["gravity"] * math.cos(th) + v["swing"] * w * w)
        w += step_s * push
        w = math.copysign(max(0.0, abs(w) - step_s * rubs), w)
        th += step_s * w
    return np.array(rows)


def excitation(count):
    """Sines of up to 3 V that swing the disk over the top now and then."""
    t = PERIOD_S * np.arange(count)
    return 1.3 * np.sin(4.1 * t) + 1.0 * np.sin(9.3 * t + 1.0) + 0.7 * np.sin(17.0 * t + 2.0)


@pytest.fixture(scope="module")
def synthetic():
    """20 s of a disk whose truth is known, sampled with the recording's noise and resolution."""
    voltage = excitation(800)
    angle = simulated(TRUTH, voltage, (0.3, 0.0))
    noisy = encoder(TRUTH, angle) + np.random.default_rng(0).normal(0.0, 0.001, 800)
    step = 2 * np.pi / 2000
    read = np.round(noisy / step) * step
    log = episode(PERIOD_S * np.arange(800), actuator={"action": voltage[:, None]}, sensor={"th": read})
    return SimpleNamespace(episode=log, read=read, exact=encoder(TRUTH, angle))


@pytest.fixture(scope="module")
def problem(synthetic):
    spans = [Span(0, float(b)) for b in np.arange(0.3, 17.5, 2.0)]
    config = PIPELINE.defaults.identify
    return Problem(PIPELINE.identifiable(MAX_DELAY_S), [synthetic.episode], spans, 2.0, config)


class TestDisk(RecordedRobotConformance):
    pipeline, truth = PIPELINE, TRUTH

    def check_state(self, state, params):
        assert float(state.position) != pytest.approx(0.7, abs=1e-4)  # the encoder is off
        assert float(params["sensor"].rate(state.position, state.velocity)) == pytest.approx(-4.0, rel=1e-5)


def test_the_model_is_the_loop(synthetic):
    """At the true values and from the true start, over 10 s, with steps of 1 ms: those of 5 ms cost 5 mrad."""
    model, config = PIPELINE.identifiable(MAX_DELAY_S), replace(PIPELINE.defaults.identify, initial_state="measured")
    nodes = model.nodes(MAX_DELAY_S)
    nodes["world"].substeps = 5
    model.nodes = lambda _: nodes
    log = replace(synthetic.episode, outputs={**synthetic.episode.outputs, "sensor": {"th": synthetic.exact}})
    problem = Problem(model, [log], [Span(0, 0.0)], 10.0, config)
    values, segment = {n: np.full(1, v) for n, v in TRUTH.items()}, np.array([0])
    estimated = problem.rollouts.starts(values, segment, np.zeros((1, 2)), problem.data)
    shift = (np.array([[encoder(TRUTH, 0.3), 0.0]]) - estimated) / problem.rollouts.prior
    off = problem.errors(values, segment, shift)[0][problem.ts[0] >= 0, 0] * model.channels[0].position_sigma
    assert len(off) > 380
    assert np.ptp(synthetic.exact[:400]) > 2.0
    assert rmse(off) < 0.002


FIRST, LAST, PAST, SETTLE = 25_000, 30_000, 20, 12


@pytest.fixture(scope="module")
def recording():
    (log,) = public("disk", "unbalanced_disk/disk_fit.npz", slice(FIRST - PAST, LAST)).values()
    return log


@pytest.fixture(scope="module")
def free_run(recording):
    """125 s from one initial state, estimated from the twelve samples before."""
    model = PIPELINE.identifiable(MAX_DELAY_S)
    settle_s = SETTLE * PERIOD_S
    begin_s = PAST * PERIOD_S - settle_s
    spans, length_s = [Span(0, begin_s, False)], recording.duration_s - begin_s
    problem = Problem(model, [recording], spans, length_s, PIPELINE.defaults.identify)
    return predictions(problem, GOOD, settle_s)[0]


def test_a_real_disk_is_foretold_over_two_minutes(free_run):
    t, measured, model = free_run
    assert t[-1] > 124.5
    assert rmse(measured) > 0.4
    assert rmse(model - measured) < 0.025
