"""What the functions for Python take: objects, names, files, logs in which units; and the error for anything else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sim2real
from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode, Steps
from sim2real.stages.config import DeployConfig, IdentifyConfig, TrainConfig
from sim2real.stages.shared import arguments
from sim2real.stages.shared.arguments import open_recording, require_units

FOUND = Identification(
    "pendulum",
    (),
    Judgement("accepted", ("off by <0.01 rad",)),
    (Estimate("gain", "1/s^2", "dynamics", "", 1.0, 21.0494, "accepted", 0.1, 20.9, 21.3),),
)
EPISODE = Episode({"sensor": Steps(*(np.arange(3) for _ in range(6)))}, {}, {"sensor": {"th": np.zeros(3)}})
RECORDING = Recording(Path("session.mcap"), EPISODE)


@pytest.fixture(scope="module")
def pendulum():
    return sim2real.load_robot("pendulum")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda p: sim2real.record(3, "folder"), "3 is no robot"),
        (lambda p: sim2real.record("pendulm", "folder"), "unknown pipeline 'pendulm'"),
        (lambda p: sim2real.record(p, None), "folder must be the path of a folder; got NoneType"),
        (lambda p: sim2real.record(p, "folder", DeployConfig()), "of type RecordConfig; got DeployConfig"),
        (lambda p: sim2real.record(p, "folder", {"seconds": 3}), "config has no seconds. Available: "),
        (lambda p: sim2real.identify(p, RECORDING, {"generations": "many"}), "generations must be a number"),
        (lambda p: sim2real.identify(p, "nope.mcap"), "there is no log nope.mcap"),
        (lambda p: sim2real.identify(p, [Path("nope.mcap")]), "there is no log nope.mcap"),
        (lambda p: sim2real.identify(p, []), "recording is empty"),
        (lambda p: sim2real.identify(p, {"th": [0.0]}), "must be a Recording, or the path of its log; got dict"),
        (lambda p: sim2real.identify(p, None), "recording must be a Recording"),
        (lambda p: sim2real.identify(p, EPISODE), "got Episode"),
        (lambda p: sim2real.identify(p, RECORDING, hold_out="no.mcap"), "there is no log no.mcap"),
        (lambda p: sim2real.identify(p, RECORDING, TrainConfig()), "config must be of type IdentifyConfig"),
        (lambda p: sim2real.train(p, {"gain": 21.0}), "identification must be an Identification, .*; got dict"),
        (lambda p: sim2real.train(p, "nope"), "cannot read nope"),
        (lambda p: sim2real.train(p, FOUND, IdentifyConfig()), "of type TrainConfig; got IdentifyConfig"),
        (lambda p: sim2real.train(p, FOUND, {"ppo": {"steps": 1}}), "config.ppo has no steps"),
        (lambda p: sim2real.train(p, FOUND, timing=3), "timing must be a Timing"),
        (lambda p: sim2real.deploy(p, "nope", "folder"), "nope"),
        (lambda p: sim2real.deploy(p, FOUND, "folder"), "bundle must be a Bundle, or its folder; got Identification"),
        (lambda p: sim2real.check(p, 7), "recording must be a Recording"),
        (lambda p: sim2real.validate(p, {"gain": 1.0}, RECORDING), "identification must be an Identification"),
        (lambda p: sim2real.validate("arm", FOUND, RECORDING), "of pipeline 'pendulum', not of 'arm'"),
        (lambda p: sim2real.export("arm", FOUND, "out.json", "json"), "of pipeline 'pendulum', not of 'arm'"),
        (lambda p: sim2real.export(p, FOUND, "out.json", "sdf"), "cannot export to 'sdf'. Available: mjcf"),
        (lambda p: sim2real.report("no_such_run"), "no file, pipeline or run 'no_such_run'"),
        (lambda p: sim2real.report(__file__), "is a file, where a run, a folder of a stage, or a pipeline is expected"),
        (lambda p: sim2real.run(p, record=TrainConfig()), "record must be of type RecordConfig"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_before_anything_happens(pendulum, call, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Sim2RealError, match=said):
        call(pendulum)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        *((IdentifyConfig, wrong) for wrong in (
            {"held_out": 0.9}, {"held_out": 0.0}, {"settle_s": 11.0}, {"horizon_s": 0.1}, {"spacing_s": -1.0},
            {"free_run_s": -1.0}, {"folds": 1}, {"folds": -1}, {"folds": 0, "terms": "auto"})),
        *((TrainConfig, wrong) for wrong in ({"timelines": 0}, {"episode_s": 0.1}, {"randomise": 11.0}, {"seed": -1})),
        *((DeployConfig, wrong) for wrong in ({"episodes": 0}, {"settle_s": 0.0}, {"settle_s": float("nan")})),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(kind, wrong):
    with pytest.raises(UsageError):
        kind(**wrong)
    assert kind(), "the usual ones are not"


def test_a_dict_of_what_is_different_is_a_configuration(pendulum):
    given = {"episode_s": 2.0, "ppo": {"num_envs": 64}}
    own = replace(pendulum.defaults.train, episode_s=2.0, ppo=replace(pendulum.defaults.train.ppo, num_envs=64))
    assert arguments.config_of(given, pendulum.defaults.train) == own
    assert arguments.config_of(None, pendulum.defaults.train) is pendulum.defaults.train
    with pytest.raises(UsageError):
        arguments.config_of({"held_out": 2.0, "log": ()}, pendulum.defaults.identify)


DATASET = Path(__file__).parents[2] / "datasets" / "pendulum" / "steps.mcap"


def recording(units, metadata=None):
    return Recording(Path("a.mcap"), Episode({}, {}, {}, metadata or {}, units=units))


def test_units_come_from_the_channels_and_of_older_logs_from_the_session(pendulum):
    assert recording({"sensor": {"th": "rad"}, "actuator": {"action": "V"}}).units == {"th": "rad", "action": "V"}
    assert recording({"a": {"x": "m", "y": "s"}, "b": {"x": "mm"}}).units == {"y": "s"}
    assert recording({}, {"units": {"th": "rad"}}).units == {"th": "rad"}
    old = open_recording(DATASET, pendulum)  # of a session before anything had units
    assert not old.units
    assert np.isfinite(old.episode.outputs["sensor"]["th"]).all()


@pytest.mark.parametrize(
    ("units", "metadata", "said"),
    [
        ({"sensor": {"th": "deg"}}, {}, "'th' of 'sensor' is in deg in the log a.mcap, the robot computes in rad"),
        ({"actuator": {"action": "mV"}}, {}, "'action' of 'actuator' is in mV"),
        ({}, {"units": {"th": "deg"}}, "'th' of 'sensor' is in deg"),
    ],
)
def test_a_log_in_other_units_is_refused(pendulum, units, metadata, said):
    with pytest.raises(Sim2RealError, match=f"{said}(.|\n)*scale"):
        require_units(recording(units, metadata), pendulum)
    require_units(recording({"sensor": {"th": "rad", "temperature": "K"}, "camera": {"th": "px"}}), pendulum)
