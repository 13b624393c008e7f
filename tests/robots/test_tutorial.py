"""The two files of the tutorial are a robot: it is found, recorded on its twin, and simulated."""

import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from sim2real.log.reader import read_log
from sim2real.stages.pipeline.pipeline import load_pipeline
from sim2real.stages.record import stage as record_stage

TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"


def blocks():
    """Return the Python on the page: the two files, and a test of them."""
    found = re.findall(r"^```python\n(.*?)^```", TUTORIAL.read_text(), re.DOTALL | re.MULTILINE)
    assert len(found) == 3
    return found


@pytest.fixture
def head(tmp_path, monkeypatch):
    """The pipeline of the tutorial, written down as a reader would."""
    folder = tmp_path / "pipelines" / "head"
    folder.mkdir(parents=True)
    for name, block in zip(("__init__", "robot"), blocks()[:2], strict=True):
        (folder / f"{name}.py").write_text(block)
    monkeypatch.chdir(tmp_path)
    return load_pipeline("head")


@pytest.mark.process
def test_the_twin_is_recorded_and_differs_from_the_model(head, tmp_path):
    gate = replace(head.record.gate, servo_watchdog_s=0.5)  # a busy machine is not what is tested
    config = replace(head.record, duration_s=3.0, gate=gate)
    made = record_stage.run(head, config, tmp_path / "runs", None)
    log = read_log(made.output("log"))
    goal, position = log.outputs["actuator"]["goal"], log.outputs["sensor"]["position"]
    assert goal.shape[1] == position.shape[1] == 2
    assert np.ptp(goal, axis=0).min() > 0.3
    assert np.ptp(position, axis=0).min() > 0.2
    truth, nominal = made.output("truth").read_bytes().split(b"\n", 1)[0], head.load().nominal()
    found = {n: float(re.search(rf'"{n}": ([0-9.e-]+)'.encode(), truth)[1]) for n in nominal}
    factors = {"gain": 0.9, "damping": 1.15, "armature": 1.2, "friction_pan": 1.6, "friction_tilt": 1.6}
    assert {n: found[n] / nominal[n] for n in found} == pytest.approx(factors, rel=1e-6)


@pytest.mark.process
@pytest.mark.night  # `make test` records and runs its twin, and other devices pass the suite in tests/hardware
def test_it_passes_the_test_that_the_page_has(head, tmp_path):
    names: dict = {}
    exec(blocks()[2], names)
    names["test_the_head_is_a_robot"](tmp_path)


def test_its_policy_sees_and_does_what_the_contract_says(head):
    robot = head.load()
    nodes, task = robot.training(robot.nominal(), {}, {}, delays=False)
    assert set(nodes) == {"sensor", "agent", "actuator", "world"}
    params = task.params(jax.random.key(1))
    np.testing.assert_allclose(params["world"].values["aim"][:2], params["agent"].aim)
    assert task.observation_size == robot.agent.observation_size == 26
    t_s, there = np.linspace(0, 3, 300), np.full(300, 0.4)
    states = {"position[0]": there, "position[1]": there, "aim[0]": there[:9], "aim[1]": there[:9]}
    assert robot.task.score(t_s, states)["success"] == 1.0
    assert robot.task.score(t_s, {**states, "position[0]": there + 0.1})["success"] == 0.0
