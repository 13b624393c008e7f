"""A synthetic log of the pendulum whose truth is known to the last digit, and its identification."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.graph.episode import Episode, Steps
from sim2real.identification.config import FitConfig
from sim2real.identification.fit import refine, run_search
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.identification.uncertainty import from_linearised
from sim2real.stages.config import RecordConfig
from sim2real.stages.load import load_module, load_robot
from sim2real.stages.session.excitation import excitation

SENSOR_DELAY_S, ACTUATOR_DELAY_S, MAX_DELAY_S = 0.0207, 0.0253, 0.06
LEAD_S = 0.00005
"""Half a time step of the plant: MuJoCo moves a joint as if forces had acted that earlier, see ``DrivenWorld``."""
DURATION_S, RATE_HZ, SEGMENT_S = 20.0, 50.0, 1.3


def columns(start, stamp, end):
    none = np.zeros_like(start)
    return Steps(scheduled=start, start=start, woken=start, ts_overwrite=stamp, end=end, drift=none)


def synthetic_log(rng, late_s=0.0):
    """Simulate the embedded robot's plant: commands held from an actuator's end plus its delay, samples read late.

    The actuator's delay deviates by ``late_s``. Sensor and actuator run at times of their own, off any grid.
    """
    plant = load_module("pendulum", "plant").PendulumPlant()
    count, step_s = round(DURATION_S * RATE_HZ), plant.model.opt.timestep
    slots = np.arange(count) * 20_000
    sensor = slots + rng.integers(0, 900, count)
    stamp = sensor + 200 + rng.integers(0, 300, count)
    actuator = slots + 2300 + rng.integers(0, 1500, count)
    done = actuator + 700 + rng.integers(0, 300, count)
    voltage = excitation(RecordConfig(duration_s=DURATION_S, amplitude=2.0, low_hz=0.7, high_hz=2.0, seed=3), RATE_HZ)
    delays = ACTUATOR_DELAY_S + (rng.normal(0.0, late_s, count) if late_s else 0.0)
    effect = np.maximum.accumulate(np.round((done * 1e-6 + delays) / step_s).astype(int))
    steps = round((DURATION_S + 0.1) / step_s)
    states = np.empty((steps, 2))
    plant.command(1, 16, 0.0)
    k = 0
    for i in range(steps):
        while k < count and effect[k] <= i:
            plant.command(1, 16, voltage[k] / 5.0)
            k += 1
        states[i] = plant.data.qpos[0], plant.data.qvel[0]
        plant.advance((i + 1) * step_s)
    sampled = np.maximum(stamp * 1e-6 - SENSOR_DELAY_S, 0.0)
    th, thdot = (np.interp(sampled, np.arange(steps) * step_s, states[:, i]) for i in range(2))
    count_rad = 2 * np.pi / 4096
    outputs = {
        "sensor": {"th": np.round(th / count_rad) * count_rad, "thdot": np.round(thdot / 0.024) * 0.024},
        "actuator": {"action": voltage[:, None]},
    }
    log = {"sensor": columns(sensor, stamp, stamp + 1000), "actuator": columns(actuator, np.full(count, -1), done)}
    return Episode(steps=log, messages={}, outputs=outputs), plant.truth()


def make_problem(episode):
    model = load_robot("pendulum").identifiable(MAX_DELAY_S)
    begins = np.arange(0.3, DURATION_S - SEGMENT_S - 0.2, SEGMENT_S)
    spans = [Span(0, float(b), i < len(begins) - 3) for i, b in enumerate(begins)]
    return Problem(model, [episode], spans, SEGMENT_S, FitConfig(max_delay_s=MAX_DELAY_S, generations=80))


@pytest.fixture(scope="session")
def fitted():
    """One synthetic log, identified: the only problem of its size, as it takes long to compile."""
    episode, truth = synthetic_log(np.random.default_rng(0))
    problem = make_problem(episode)
    searched = run_search(problem, problem.table.start())
    found = replace(searched, x=refine(problem, searched.x[None]).x)  # a search ends beside the minimum
    values = {n: float(v) for n, v in problem.table.decode(found.x).items()}
    return SimpleNamespace(
        episode=episode,
        truth={**truth, "sensor_delay": SENSOR_DELAY_S, "actuator_delay": ACTUATOR_DELAY_S - LEAD_S},
        problem=problem,
        found=found,
        values=values,
        spread=from_linearised(problem, problem.linearise(found.x)),
        loss=problem.loss,
        make_problem=make_problem,
    )
