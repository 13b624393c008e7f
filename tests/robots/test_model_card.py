"""The folder of a model card: plain MuJoCo, without sim2real and JAX, computes each of its figures within 1 %."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sim2real import cli, errors
from sim2real.artifacts.identification import ComparedError, Estimate, Identification, Internal, Judgement
from sim2real.artifacts.posterior import Posterior
from sim2real.graph.episode import Episode, Steps
from sim2real.identification import predictions as prediction
from sim2real.identification.config import FitConfig
from sim2real.identification.export.card import json_document
from sim2real.identification.export.terms import Delays
from sim2real.identification.predictions import replays
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.log import read_log
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.config import RecordConfig
from sim2real.stages.export import facts_of, write_model_card
from sim2real.stages.load import load_robot
from sim2real.stages.session.excitation import excitation
from sim2real.stages.session.simulated_log import simulate

ROOT = Path(__file__).resolve().parents[2]
ALONE = """
import runpy, sys
class Absent:
    def find_spec(self, name, *rest):
        if name.partition(".")[0] in ("sim2real", "jax", "flax", "scipy"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Absent())
sys.argv = ["reproduce.py"]
runpy.run_path("reproduce.py", run_name="__main__")
"""
SETTLE_S, AHEAD_S, MAX_DELAY_S = 0.3, 1.0, 0.06


def alone(folder):
    """Run a card's script where sim2real and JAX cannot be imported; return its exit code and its lines."""
    done = subprocess.run(
        [sys.executable, "-I", "-c", ALONE], cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    return done.returncode, (done.stdout + done.stderr).splitlines()


def known(robot, episode, values, begins_s):
    """Return an identification whose estimates are given; its predictions are those of the identified graph."""
    model = robot.identifiable(MAX_DELAY_S)
    values = {p.name: p.nominal for p in model.parameters} | values
    spans = [Span(0, 0.4), *(Span(0, b, False) for b in begins_s)]
    config = FitConfig(max_delay_s=MAX_DELAY_S)
    problem = Problem(model, [episode], spans, SETTLE_S + AHEAD_S, config)
    columns = prediction.samples(problem, {"identified": values}, SETTLE_S)
    long = problem.recut([Span(0, begins_s[0], False)], begins_s[-1] + SETTLE_S + AHEAD_S - begins_s[0])
    free = prediction.samples(long, {"identified": values}, SETTLE_S)
    rows = [Estimate(p.name, p.unit, p.kind, "", p.nominal, values[p.name], "fixed") for p in model.parameters]
    return replace(
        Identification("any", (), Judgement("accepted", ()), tuple(rows)),
        samples=columns,
        free=free,
        internal=Internal(settle_s=SETTLE_S),
        errors=tuple(ComparedError("", "th", "", s, 0.0) for s in (0.1, 1.0)),
        replays=replays(problem, values, SETTLE_S, "ahead") | replays(long, values, SETTLE_S, "free"),
        units=robot.units,
    )


def card_of(robot, found, folder):
    document = json_document(found, None, Delays(), [("pipeline", "any"), ("sim2real", "0")])
    write_model_card(folder, found, robot, robot.identifiable(MAX_DELAY_S), document, None)
    return folder


def check(folder):
    """Check that a card has errors of the simulation, and that each figure is reproduced."""
    code, lines = alone(folder)
    assert code == 0, "\n".join(lines[-20:])
    assert sum("s ahead: " in line for line in lines) >= 2
    assert any("in a free run" in line for line in lines)
    largest = re.fullmatch(r"\d+ figures, the largest difference is ([\d.]+) %", lines[-1])
    assert float(largest[1]) < 1.0


@pytest.mark.night
def test_the_pendulum_of_a_real_recording(tmp_path):
    values = {"gain": 21.08, "gravity": 112.7, "damping": 0.748, "friction": 8.458, "sensor_delay": 0.0223,
              "actuator_delay": 0.0223}  # fmt: skip
    robot = load_robot("pendulum")
    found = known(robot, read_log(ROOT / "datasets" / "pendulum" / "multisine.mcap"), values, (15.0, 16.0, 17.0, 18.0))
    check(card_of(robot, found, tmp_path / "card"))


@pytest.mark.night
def test_the_so101_whose_friction_wears_off_with_speed(tmp_path):
    """A log of the model at other parameters than those of the card, read in counts."""
    pipeline = load_robot("so101")
    robot = pipeline
    model = robot.identifiable(MAX_DELAY_S)
    truth = {p.name: p.nominal for p in model.parameters} | {"sensor_delay": 0.008, "actuator_delay": 0.012}
    signal = excitation(RecordConfig(duration_s=6.0, amplitude=0.4), robot.drive.rate_hz, 6) + robot.drive.centre
    episode = simulate(model, robot, signal, truth, FitConfig(max_delay_s=MAX_DELAY_S))
    count = 2 * np.pi / 4096
    episode.outputs["sensor"]["position"] = np.round(episode.outputs["sensor"]["position"] / count) * count
    found = known(robot, episode, {**truth, "gain": 0.95 * truth["gain"]}, (2.0, 3.0, 4.0))
    check(card_of(robot, found, tmp_path / "card"))


XML = """<mujoco><worldbody><body name="upper"><joint name="lift" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3"/>
  <body name="lower" pos="0 0 -0.25"><joint name="bend" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.2"/></body></body></worldbody></mujoco>"""
PLAIN = {"kp": 9.0, "damping": 0.35, "armature": 0.012, "frictionloss": 0.05}
TERMS = {"kd": 0.2, "load": 0.1, "static": 0.05, "stribeck_rad_s": 0.2, "drag": 0.02, "bias": 0.02, "back_emf": 0.05,
         "damping_bias": 0.1, "play": 0.01, "zero": 0.03, "eccentric_cos": 0.02, "eccentric_sin": -0.01,
         "cogging_cos": 0.02, "cogging_sin": 0.01, "cogging_per_turn": 8.0,
         "torque": 2.0, "released": 0.3, "gravcomp": 0.4}  # fmt: skip


def two_links(folder, own, commands):
    """Return a robot from a file, and a log of it: sums of sines, and a motion that is not the model's."""
    path = folder / "robot.xml"
    path.write_text(XML)
    terms = tuple(ParameterPattern(what, nominal=v, free=what != "cogging_per_turn") for what, v in own.items())
    robot = MjcfRobot(RobotConfig(path, ("lift", "bend"), commands, step_s=0.002, rate_hz=100.0, terms=terms))
    at = 10_000 * np.arange(700)
    t, rng = 1e-6 * at, np.random.default_rng(0)
    phases = rng.uniform(0, 6, (2, 3))
    waves = 0.2 * np.stack([np.sin(2 * np.pi * np.outer(t, (0.4, 0.9, 1.7)) + p).sum(axis=1) for p in phases], axis=1)
    rows = {
        "goal": waves,
        "kp": 0.8 + 0.2 * np.cos(t)[:, None] + 0 * waves,
        "enabled": 1.0 * (t % 3 < 2.5)[:, None] + 0 * waves,
        "torque": 0.2 * waves[::-1],
        "goal_velocity": 0.1 * waves,
    }
    steps = Steps(at, at, at, np.full(len(at), -1), at + 1500, 0 * at)
    outputs = {"sensor": {"position": 0.8 * np.roll(waves, 5, axis=0)}, "actuator": {n: rows[n] for n in commands}}
    return robot, Episode(steps={"sensor": steps, "actuator": steps}, messages={}, outputs=outputs)


@pytest.mark.night
def test_a_robot_that_only_its_file_describes(tmp_path):
    own = PLAIN | TERMS
    robot, episode = two_links(tmp_path, own, ("goal", "kp", "enabled", "torque", "goal_velocity"))
    found = known(robot, episode, {**own, "delay": 0.0131}, (2.0, 3.0, 4.0))
    check(card_of(robot, found, tmp_path / "card"))


@pytest.mark.night
def test_a_wrong_delay_or_a_wrong_model_is_seen(tmp_path):
    """The script is no copy of the card's figures: with another delay, or a joint without friction, it fails."""
    robot, episode = two_links(tmp_path, PLAIN, ("goal",))
    folder = card_of(robot, known(robot, episode, {**PLAIN, "delay": 0.0131}, (2.0, 3.0)), tmp_path / "card")
    text, xml = (folder / "card.json").read_text(), (folder / "model.xml").read_text()
    (folder / "card.json").write_text(re.sub(r'"command_delay_s": [\d.]+', '"command_delay_s": 0.03', text))
    assert alone(folder)[0] == 1
    (folder / "card.json").write_text(text)
    (folder / "model.xml").write_text(re.sub(r' frictionloss="[\d.]+"', "", xml))
    assert alone(folder)[0] == 1
    assert "sim2real" not in (folder / "reproduce.py").read_text().replace("sim2real.", "")


def test_the_card_of_a_run(finished_run_dir, tmp_path, monkeypatch, capsys):
    """The command writes page, document, model, signals and script; the page is self-contained and has no own path."""
    monkeypatch.chdir(tmp_path)
    source = str(finished_run_dir / "identify" / "parameters.json")
    assert cli.main(["export", source, "--to", "card"]) == 0
    folder = tmp_path / "pendulum_card"
    assert {p.name for p in folder.iterdir()} == {"card.html", "card.json", "model.xml", "reproduce.py", "signals.npz"}
    code, lines = alone(folder)
    assert code == 0, "\n".join(lines)
    page = (folder / "card.html").read_text()
    for words in ("SHA-256", "Not known", "temperature: not recorded", "command_delay_s", "95 % interval"):
        assert words in page, words
    assert str(tmp_path) not in page
    assert not re.search(r'(src|href)="http', page)
    assert mujoco.MjModel.from_xml_path(str(folder / "model.xml")).nu == 1
    # A second card replaces the first; another folder with files is refused.
    assert cli.main(["export", source, "--to", "card"]) == 0
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert cli.main(["export", source, "--to", "card", "--out", "mine"]) == errors.USAGE
    assert "exists and is no model card" in capsys.readouterr().err


def test_facts_about_the_hardware_come_from_the_log():
    """A servo's registers when the recording begins; a measurement during it takes their place."""
    registers = {
        "firmware": {"servo 1": "3.9", "servo 2": "3.10", "servo 3": "3.9"},
        "voltage": {"servo 1": "7.4 V", "servo 2": "7.4 V", "servo 3": "7.4 V"},
        "temperature": {"battery": "30 °C"},
    }
    servos = Episode(steps={}, messages={}, outputs={}, metadata={"hardware": registers})
    said = ("3.9: servo 1, servo 3; 3.10: servo 2", "7.4 V, all motors", "30 °C: battery")
    assert facts_of(servos, "sensor") == dict(zip(registers, said, strict=True))
    measured, units = {"battery_voltage": np.array([29.6, 28.1])}, {"sensor": {"battery_voltage": "V"}}
    legs = Episode(steps={}, messages={}, outputs={"sensor": measured}, metadata={}, units=units)
    said = {"firmware": "not recorded", "temperature": "not recorded", "battery_voltage": "28.1 to 29.6 V"}
    assert facts_of(legs, "sensor") == said


@pytest.mark.night
def test_a_card_without_a_simulation_has_the_reason(tmp_path):
    """A world that MuJoCo has not, and an identification without commands: no script computes their errors."""
    robot, episode = two_links(tmp_path, PLAIN, ("goal",))
    found = known(robot, episode, {**PLAIN, "delay": 0.0131}, (2.0, 3.0))
    folder = card_of(robot, replace(found, replays={}), tmp_path / "old")
    assert "no commands (replays.npz)" in (folder / "card.json").read_text()
    assert alone(folder)[0] == 0
    disk = load_robot("disk")
    rows = tuple(
        Estimate(p.name, p.unit, p.kind, "", p.nominal, p.nominal, "fixed") for p in disk.identifiable(0.06).parameters
    )
    x = np.zeros(1)
    posterior = Posterior((rows[0].name,), ("log",), x, np.eye(1), x - 2, x + 2)
    bare = replace(Identification("disk", (), Judgement("accepted", ()), rows), posterior=posterior)
    folder = card_of(disk, bare, tmp_path / "disk")
    assert "no counterpart in plain MuJoCo" in (folder / "card.json").read_text()
    assert not (folder / "model.xml").exists()
    assert alone(folder)[0] == 0
