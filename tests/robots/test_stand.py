"""Legs in a stand: the model to identify is the emulator's, and a log of a robot that moves is refused."""

import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
from benches.hidden import legs

from pipelines.go2.robot import ROBOT
from sim2real.artifacts.recording import Recording
from sim2real.emulation.truth import read_truth
from sim2real.errors import OtherMotion
from sim2real.identification.config import FitConfig
from sim2real.identification.predictions import labels
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.robots.walking.twin import twin_of
from sim2real.stages.load import defaults_of
from sim2real.stages.shared.identification import spans

SEED, SECONDS, SEGMENT_S = 5, 2.0, 0.8


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log of a hidden robot, and its true parameters and delays."""
    path = tmp_path_factory.mktemp("stand") / "session.mcap"
    legs.record(path, SEED, SECONDS)
    header = read_truth(path.with_suffix(".truth.bin")).header
    config = header["config"]
    delays = {"sensor_delay": config["sensing_latency_s"], "actuator_delay": config["actuation_latency_s"]}
    return Recording.load(path).episode, header["truth"] | delays


@pytest.mark.night
def test_with_the_true_parameters_the_model_predicts_the_log_to_its_noise(log):
    episode, truth = log
    model = ROBOT.identifiable(0.06)
    cut = [Span(0, begin) for begin in (1.6, 2.0)]
    problem = Problem(model, [episode], cut, SEGMENT_S, FitConfig(generations=0))
    assert problem.engine.name == "c"
    values = {p.name: np.full(2, truth.get(p.name, p.nominal)) for p in problem.table}
    errors, _ = problem.simulated(values, np.arange(2), np.full(2, SEGMENT_S))
    sigma = {"position": 5e-4, "velocity": 0.03}
    positions = np.array([name.startswith("position") for name in labels(problem)])
    rms = np.sqrt((errors**2).mean(axis=(0, 1)))
    assert (rms[positions] * sigma["position"]).max() < 1e-3  # 0.3 mrad of noise, and jitter of up to 1 ms
    assert (rms[~positions] * sigma["velocity"]).max() < 0.06
    # A strength that is 10 % off is far outside of that.
    values["FR_thigh_strength"] = 1.1 * values["FR_thigh_strength"]
    worse, _ = problem.simulated(values, np.arange(2), np.full(2, SEGMENT_S))
    worst = np.sqrt((worse**2).mean(axis=(0, 1)))
    assert worst[labels(problem).index("position[1]")] > 2.0 * rms[labels(problem).index("position[1]")]
    np.testing.assert_allclose(
        worst[labels(problem).index("position[4]")], rms[labels(problem).index("position[4]")], rtol=1e-2
    )


def test_a_log_of_a_robot_that_moves_is_refused(log):
    episode, _ = log
    model = ROBOT.identifiable(0.06)
    model.check(episode)
    count = len(episode.outputs["sensor"]["gyro"])
    turning = 0.5 * np.sin(np.arange(count))[:, None] * np.ones(3)
    sensor = {**episode.outputs["sensor"], "gyro": turning}
    walking = type(episode)(**{**vars(episode), "outputs": {**episode.outputs, "sensor": sensor}})
    with pytest.raises(OtherMotion, match="base of the robot moved") as refused:
        model.check(walking)
    assert "stand" in refused.value.hint


def test_the_way_of_the_legs_to_the_excitation_is_not_fitted(log):
    episode, _ = log
    config = replace(defaults_of("go2").identify, settle_s=0.1, horizon_s=0.2)
    assert config.after_s == 2.0
    for after_s, begin_s in ((0.7, 0.7), (0.0, 0.3)):
        cut = spans([episode], 1, replace(config, after_s=after_s), 0.3)
        assert min(span.begin_s for span in cut) == begin_s


def test_the_emulator_names_its_parameters_as_an_identification_does(log):
    _, truth = log
    names = {p.name for p in ROBOT.identifiable(0.06).parameters}
    assert names - {"motor_strength"} <= set(truth)
    assert set(truth) - names == set(ROBOT.nominal()) - names - {"roughness"}


def test_each_group_and_each_motor_has_its_value_in_training_and_on_the_twin():
    values = ROBOT.nominal() | {"thigh_damping": 0.3, "calf_friction": 0.05, "hip_armature": 0.02}
    values |= {"RL_calf_strength": 0.9, "motor_strength": 1.1}
    start = ROBOT.task.at_rest(0)
    placed = ROBOT.model.params(values, start).values
    np.testing.assert_allclose(placed["damping"], np.tile([0.1, 0.3, 0.1], 4), rtol=1e-6)
    np.testing.assert_allclose(placed["friction"], np.tile([0.2, 0.2, 0.05], 4), rtol=1e-6)
    np.testing.assert_allclose(placed["armature"], np.tile([0.02, 0.01, 0.01], 4), rtol=1e-6)
    np.testing.assert_allclose(placed["gain"][:, 0], [38.5] * 11 + [34.65], rtol=1e-6)
    twin = twin_of(ROBOT, values).model
    np.testing.assert_allclose(twin.dof_damping[-12:], placed["damping"], rtol=1e-6)
    np.testing.assert_allclose(twin.dof_frictionloss[-12:], placed["friction"], rtol=1e-6)
    np.testing.assert_allclose(twin.dof_armature[-12:], placed["armature"], rtol=1e-6)
    np.testing.assert_allclose(twin.actuator_gainprm[:, 0], placed["gain"][:, 0], rtol=1e-6)
    assert jnp.shape(placed["payload"]) == ()
