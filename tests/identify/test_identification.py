"""Identification of a synthetic log whose truth is known to the last digit."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode, Steps
from sim2real.identify.problem import Problem
from sim2real.identify.search import cma_es
from sim2real.identify.uncertainty import centred, uncertainty
from sim2real.stages.config import RecordConfig
from sim2real.stages.excitation import excitation
from sim2real.stages.pipeline import load_pipeline

SENSOR_DELAY_S, ACTUATOR_DELAY_S, MAX_DELAY_S = 0.0207, 0.0253, 0.06
DURATION_S, RATE_HZ, SEGMENT_S = 20.0, 50.0, 1.3


def columns(start, stamp, end):
    none = np.zeros_like(start)
    return Steps(scheduled=start, start=start, woken=start, ts_overwrite=stamp, end=end, drift=none)


def synthetic_log(rng):
    """Simulate the embedded robot's plant: commands held from an actuator's end plus its delay, samples read late.

    Sensor and actuator run at times of their own, off any grid.
    """
    plant = load_pipeline("pendulum").load("plant").PendulumPlant()
    count, step_s = round(DURATION_S * RATE_HZ), plant.model.opt.timestep
    slots = np.arange(count) * 20_000
    sensor = slots + rng.integers(0, 900, count)
    stamp = sensor + 200 + rng.integers(0, 300, count)
    actuator = slots + 2300 + rng.integers(0, 1500, count)
    done = actuator + 700 + rng.integers(0, 300, count)
    voltage = excitation(RecordConfig(duration_s=DURATION_S, amplitude=2.0, low_hz=0.7, high_hz=2.0, seed=3), RATE_HZ)
    effect = np.round((done * 1e-6 + ACTUATOR_DELAY_S) / step_s).astype(int)
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
    model = load_pipeline("pendulum").load().identifiable(MAX_DELAY_S)
    begins = np.arange(0.3, DURATION_S - SEGMENT_S - 0.2, SEGMENT_S)
    return Problem(model, episode, begins, SEGMENT_S, MAX_DELAY_S, np.arange(len(begins)) < len(begins) - 3)


@pytest.fixture(scope="module")
def fitted():
    """One synthetic log, identified."""
    episode, truth = synthetic_log(np.random.default_rng(0))
    problem = make_problem(episode)
    found = cma_es(problem.losses, problem.table.start(), 32, 80, seed=0)
    values = {n: float(v) for n, v in problem.table.decode(jnp.asarray(found.z)).items()}
    return SimpleNamespace(
        episode=episode, truth=truth, problem=problem, found=found, values=values, spread=uncertainty(problem, found.z)
    )


def held_out_rmse(problem, values):
    """Return the RMSE of the angle 0.3 to 1.3 s into segments that were not fitted [rad]."""
    values = {n: jnp.float32(v) for n, v in values.items()}
    predict = jax.jit(lambda e: problem.predict(values, e, jnp.float32(0.3)))
    errors = []
    for e in range(len(problem.train), problem.segments):
        residuals, ts = (np.asarray(x) for x in predict(e))
        errors.append(residuals[ts > 0.3, 0] * problem.channels[0].position_sigma)
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


@pytest.mark.parametrize("group", ["gain", "gravity", "damping", "friction"])
def test_groups_are_recovered(fitted, group):
    assert fitted.values[group] == pytest.approx(fitted.truth[group], rel=0.03)


def test_round_trip_is_recovered(fitted):
    total = fitted.values["sensor_delay"] + fitted.values["actuator_delay"]
    assert total == pytest.approx(SENSOR_DELAY_S + ACTUATOR_DELAY_S, abs=0.001)


def test_the_nominal_model_without_delays_is_much_worse(fitted):
    problem = fitted.problem
    identified = held_out_rmse(problem, fitted.values)
    assert identified < 0.03
    nominal = {p.name: p.nominal for p in problem.table}
    assert held_out_rmse(problem, nominal) > 5 * identified
    no_delays = {**fitted.values, "sensor_delay": 0.0, "actuator_delay": 0.0}
    assert held_out_rmse(problem, no_delays) > 2 * identified


def test_the_interval_of_the_round_trip_covers_the_truth(fitted):
    spread, names = fitted.spread, list(fitted.problem.table.names)
    delays = [names.index("sensor_delay"), names.index("actuator_delay")]
    error = np.sqrt(spread.covariance[np.ix_(delays, delays)].sum())
    total = fitted.values["sensor_delay"] + fitted.values["actuator_delay"]
    assert abs(total - SENSOR_DELAY_S - ACTUATOR_DELAY_S) < 1.96 * error
    assert error < 0.002


def test_the_delays_alone_are_not_identifiable_and_the_groups_are(fitted):
    verdicts = dict(zip(fitted.problem.table.names, fitted.spread.verdict, strict=True))
    assert {n for n, v in verdicts.items() if v == "not identifiable"} == {"sensor_delay", "actuator_delay"}
    spread, names = fitted.spread, list(fitted.problem.table.names)
    sensor, actuator = names.index("sensor_delay"), names.index("actuator_delay")
    assert spread.correlation[sensor, actuator] < -0.9
    assert spread.low[sensor] < SENSOR_DELAY_S < spread.high[sensor]
    assert spread.low[actuator] < ACTUATOR_DELAY_S < spread.high[actuator]
    np.testing.assert_allclose(spread.covariance, spread.covariance.T, rtol=1e-6, atol=1e-18)
    assert np.all(np.linalg.eigvalsh(spread.covariance) > 0)
    assert np.all(spread.low < spread.high)


def test_time_is_shifted_to_the_middle_of_what_the_bounds_admit(fitted):
    table = fitted.problem.table
    middle = {n: float(v) for n, v in table.decode(jnp.asarray(centred(table, fitted.found.z))).items()}
    total = fitted.values["sensor_delay"] + fitted.values["actuator_delay"]
    assert middle["sensor_delay"] + middle["actuator_delay"] == pytest.approx(total, abs=1e-4)
    least = max(table["sensor_delay"].low, total - table["actuator_delay"].high)
    most = min(table["sensor_delay"].high, total - table["actuator_delay"].low)
    assert middle["sensor_delay"] == pytest.approx((least + most) / 2, abs=1e-4)
    for group in ("gain", "gravity", "damping", "friction"):
        assert middle[group] == pytest.approx(fitted.values[group], rel=1e-4)


def test_shifting_time_between_the_delays_changes_little(fitted):
    problem = fitted.problem
    shifted = {**fitted.values}
    move = 0.004 if shifted["actuator_delay"] > 0.03 else -0.004
    shifted["sensor_delay"] += move
    shifted["actuator_delay"] -= move
    longer = {**fitted.values, "actuator_delay": fitted.values["actuator_delay"] + 0.004}
    z = jnp.asarray(np.stack([problem.table.encode(v) for v in (fitted.values, shifted, longer)]), jnp.float32)
    best, same, worse = (float(x) for x in problem.losses(z, z[0]))
    assert abs(same - best) < 0.2 * (worse - best)


@pytest.mark.parametrize(("node", "field"), [("sensor", "th"), ("sensor", "thdot"), ("actuator", "action")])
def test_nan_in_the_log_is_an_error(fitted, node, field):
    data = fitted.episode.outputs[node][field].copy()
    data[123] = np.nan
    outputs = {**fitted.episode.outputs, node: {**fitted.episode.outputs[node], field: data}}
    with pytest.raises(Sim2RealError, match=f"'{field}' of node '{node}'.*no numbers, the first in step 123"):
        make_problem(replace(fitted.episode, outputs=outputs))


def test_logs_that_lack_something_are_errors(fitted):
    episode = fitted.episode
    with pytest.raises(Sim2RealError, match=r"no steps of node 'actuator'\. Available: sensor"):
        make_problem(replace(episode, steps={"sensor": episode.steps["sensor"]}))
    outputs = {**episode.outputs, "sensor": {"th": episode.outputs["sensor"]["th"]}}
    with pytest.raises(Sim2RealError, match=r"no field 'thdot' in this log\. Available: th"):
        make_problem(replace(episode, outputs=outputs))
    model = fitted.problem.model
    with pytest.raises(UsageError, match="too few to start a segment"):
        Problem(model, episode, np.array([1.0, DURATION_S + 3.0]), SEGMENT_S, MAX_DELAY_S)
