"""The arm's model against a loop of its own, and a real recording that it foretells better than its goals do."""

from dataclasses import replace

import numpy as np
import pytest
from recorded_robots import RecordedRobotConformance, episode, predictions, public, rmse

from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.stages.load import load_module, load_robot

PIPELINE = load_robot("so101_log")
MAX_DELAY_S = PIPELINE.defaults.identify.max_delay_s
JOINTS = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll", "jaw")
PERIOD_S = 0.02006


def nominal():
    return {p.name: p.nominal for p in PIPELINE.identifiable(MAX_DELAY_S).parameters}


TRUTH = {
    **nominal(), "delay": 0.0087, "weight_upper": 0.03, "weight_forearm": 0.04, "weight_hand": 0.02,
    **{f"{j}_bias": 0.004 * (i - 2) for i, j in enumerate(JOINTS)},
}  # fmt: skip


def simulated(v, goal, start, step_s=PERIOD_S / 100):
    """Return positions at each sample, ``(N, 6)``: small steps of Euler, goals when they come, to the step."""
    six = {k: np.array([v.get(f"{j}_{k}", np.inf) for j in JOINTS]) for k in
           ("stiffness", "damping", "static", "stribeck", "bias", "saturation", "low")}  # fmt: skip
    limit = np.where(np.isinf(six["saturation"]), 1.0, six["saturation"])  # joints that the table leaves at a radian
    low = np.where(np.isinf(six["low"]), -3.0, six["low"])
    q, w = np.array(start), np.zeros(6)
    per_sample, late = round(PERIOD_S / step_s), round((v["delay"] + v["sensor_delay"]) / step_s)
    rows = []
    for i in range(per_sample * (len(goal) - 1) + 1):
        if i % per_sample == 0:
            rows.append(q.copy())
        error = np.clip(goal[max(0, (i - late) // per_sample)] + six["bias"] - q, -limit, limit)
        contact = v["table_stiffness"] * max(0.0, q[2] + v["table_ratio"] * q[1] - v["table_height"])
        hand = v["weight_hand"] * np.cos(q[1] + q[2] + q[3])
        fore = v["weight_forearm"] * np.cos(q[1] + q[2])
        error[1] += v["weight_upper"] * np.sin(q[1]) + fore + hand - v["table_ratio"] * contact
        error[2] += fore + hand - contact
        error[3] += hand
        w = w + step_s * (six["stiffness"] * error - six["damping"] * w)
        dry = six["stiffness"] * six["static"] * np.exp(-np.abs(w) / six["stribeck"])
        w = np.sign(w) * np.maximum(0.0, np.abs(w) - step_s * dry)
        w = np.where(q + step_s * w < low, 0.0, w)
        q = np.maximum(q + step_s * w, low)
    return np.array(rows)


def free_run(log):
    """Return a problem whose one segment is the recording, from rest where it was measured."""
    model, config = PIPELINE.identifiable(MAX_DELAY_S), replace(PIPELINE.defaults.identify, initial_state="rest")
    return Problem(model, [log], [Span(0, 0.0)], log.duration_s, config)


@pytest.fixture(scope="module")
def synthetic():
    """8 s: every joint steps and swings; pitch and elbow press on the table, the wrist meets its stop."""
    t = PERIOD_S * np.arange(400)
    ramp = np.minimum(1.0, t / 0.3)[:, None]
    turns = np.outer(t, [1.3, 0.9, 1.1, 1.7, 1.5, 2.1])
    slow = np.sin(turns + np.array([0.0, 1.0, 0.5, 2.0, 3.0, 4.0]))
    steps = np.sign(np.sin(np.outer(t, [2.9, 2.3, 3.1, 2.7, 2.5, 3.3])))
    goal = ramp * (
        np.array([0.7, 0.5, 0.6, 0.5, 0.9, 0.4]) * slow
        + np.array([0.4, 0.15, 0.15, 0.15, 0.15, 0.15]) * steps
        + [0.0, 0.4, 0.5, 0.0, -0.3, 0.0]
    )
    angle = simulated(TRUTH, goal, np.zeros(6))
    log = episode(t, actuator={"goal": goal}, sensor={"position": angle})
    return log, free_run(log)


@pytest.fixture(scope="module")
def problem(synthetic):
    return synthetic[1]


class TestSO101Log(RecordedRobotConformance):
    pipeline, truth = PIPELINE, TRUTH
    start = (0.1, -0.2, 0.3, -0.4, 0.5, -0.6, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)


def test_the_model_is_the_loop(synthetic):
    log, problem = synthetic
    true = log.outputs["sensor"]["position"]
    assert true[:, 4].min() == pytest.approx(TRUTH["wrist_roll_low"], abs=1e-4)
    assert np.sum(true[:, 2] + TRUTH["table_ratio"] * true[:, 1] > TRUTH["table_height"]) > 50
    ((t, measured, model),) = predictions(problem, TRUTH)
    assert len(t) > 390
    assert rmse(model - measured).max() < 0.003


def test_a_joint_at_its_stop_stands_there_and_the_others_move_on():
    model = load_module(PIPELINE.name, "model")
    low = np.array(model.nominal().low)
    state = model.JointState(low + np.array([0.1, -0.1, 0.0, 0.1, -0.2, 0.1]), np.arange(-3.0, 3.0))
    stopped = model.ArmWorld("world", 200.0).confine(model.nominal(), state)
    np.testing.assert_allclose(stopped.position, low + np.array([0.1, 0.0, 0.0, 0.1, 0.0, 0.1]), rtol=1e-6)
    np.testing.assert_array_equal(stopped.velocity, [-3.0, 0.0, -1.0, 0.0, 0.0, 2.0])


def test_a_real_arm_is_where_the_model_says_rather_than_where_it_was_told_to_be():
    (log,) = public("so101_log", "so101/step_response.npz").values()
    ((t, measured, model),) = predictions(free_run(log), nominal())
    assert t[-1] > 100.0
    told = rmse(log.outputs["actuator"]["goal"] - log.outputs["sensor"]["position"])
    own = rmse(model - measured)
    assert np.all(own < 0.8 * told), dict(zip(JOINTS, own / told, strict=True))
    assert np.mean(own / told) < 0.6
