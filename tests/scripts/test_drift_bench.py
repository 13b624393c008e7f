"""The bench of drift: robots on simulated clocks that change as they are told, and outcomes that are kept."""

import importlib
import sys
import time
from argparse import Namespace
from pathlib import Path

import jax
import numpy as np
import pytest

from sim2real.log.reader import read_log
from sim2real.stages.pipeline.pipeline import load_pipeline

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches.drift.arms import ReachingArm, ReachingSO101
from benches.drift.pendulum import Pendulum
from benches.jobs import robots

KINDS = pytest.mark.parametrize("kind", [ReachingArm, ReachingSO101])


def probed(robot, path):
    """Return when each measurement of the small steps was made [s], where the joints were, and their goals [rad]."""
    robot.probe(path, 1)
    log = read_log(path)
    return log.steps["sensor"].begun_s, log.outputs["sensor"]["position"], log.outputs["actuator"]["goal"]


@KINDS
def test_15_ms_more_delay_are_seen_in_the_small_steps(kind, tmp_path):
    answered = []
    for change in ("none", "delay"):
        t_s, position, goal = probed(kind.draw(0).changed(change), tmp_path / f"{change}.mcap")
        up = np.flatnonzero(np.diff(goal[:, 0]) > 0.1) + 1
        assert up.size == 4
        after = [position[i : i + 12, 0] - position[i, 0] for i in up]
        answered.append([np.interp(0.03, a, t_s[i : i + 12] - t_s[i]) for a, i in zip(after, up, strict=True)])
    assert np.mean(answered[1]) - np.mean(answered[0]) == pytest.approx(0.015, abs=0.004)


@pytest.mark.night
@KINDS
def test_a_payload_weighs_and_friction_brakes(kind, tmp_path):
    def off(change):
        kind.draw(0).changed(change).deploy(tmp_path / f"{change}.mcap", 8.0, 1)
        log = read_log(tmp_path / f"{change}.mcap")
        return np.abs(log.outputs["actuator"]["goal"] - log.outputs["sensor"]["position"])

    none, friction, payload = (off(change) for change in ("none", "friction", "payload"))
    assert np.abs(payload - none)[:, 1:3].max() > 0.02, "it pulls at the joints that lift"
    assert np.abs(friction - none).max() > 0.01


def test_the_same_number_is_the_same_robot():
    for kind in (Pendulum, ReachingArm, ReachingSO101):
        assert kind.draw(3) == kind.draw(3)
        assert kind.draw(3).truth != kind.draw(4).truth


def odd(number, options):
    """Fail for one of the robots."""
    if number == options.bad:
        raise RuntimeError("a loose cable")
    return {"number": number}


def test_one_robot_that_fails_loses_no_other(capsys):
    found, failed = robots(odd, range(3), Namespace(jobs=1, bad=1))
    assert [robot["number"] for robot in found] == [0, 2]
    assert failed == [{"number": 1, "failed": "RuntimeError: a loose cable"}]
    assert "a loose cable" in capsys.readouterr().err


def slow(number, options):
    """Take longer than there is, but for the first."""
    time.sleep(60.0 if number else 0.0)
    return {"number": number}


def test_what_is_not_done_in_time_fails_and_the_rest_is_reported():
    begin = time.monotonic()
    found, failed = robots(slow, range(3), Namespace(jobs=1, within_s=1.0))
    assert time.monotonic() - begin < 30.0
    assert found == [{"number": 0}]
    assert [f["number"] for f in failed] == [1, 2]
    assert all("time was up" in f["failed"] for f in failed)


KILLED = """
import os, signal

def one(number, options):
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"number": number}
"""


def test_a_robot_whose_process_is_killed_loses_no_other(tmp_path, monkeypatch):
    (tmp_path / "killed_task.py").write_text(KILLED)
    monkeypatch.syspath_prepend(tmp_path)
    found, failed = robots(importlib.import_module("killed_task").one, range(3), Namespace(jobs=2))
    assert [robot["number"] for robot in found] == [0, 2]
    assert failed == [{"number": 1, "failed": "its process was killed"}]


class Solved:
    """Stands for a trained policy: it moves the goals to where the model's tip is at the target, or not at all."""

    def __init__(self, robot, aim, still=False):
        self.robot, self.aim, self.goal, self.still = robot, aim, robot.drive.servos.at_rest, still
        self.tip = sys.modules[type(robot).__module__].tip_of

    def runner(self):
        return self

    def act(self, observation):
        assert observation.dtype == np.float32
        assert observation.shape == (sum(t.size * t.history for t in self.robot.agent.observation),)
        servos, small = self.robot.drive.servos, 1e-5
        off = self.aim[:3] - self.tip(np, self.goal)
        moved = self.goal + small * np.eye(len(self.goal))
        J = ((self.tip(np, moved) - self.tip(np, self.goal)) / small).T
        speed = 4.0 * J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(3), off)
        if len(self.aim) > 3:
            speed[-1] = 4.0 * (self.aim[3] - self.goal[-1])
        speed = np.clip(speed, -servos.speed, servos.speed) * (not self.still)
        self.goal = np.clip(self.goal + speed / self.robot.rate_hz, servos.low, servos.high)
        return speed.astype(np.float32)


@KINDS
@pytest.mark.parametrize("still", [False, True])
def test_a_trained_policy_succeeds_where_it_brings_the_robots_own_tip_to_the_target(kind, still):
    robot = load_pipeline(kind.pipeline).load()
    aim = np.asarray(robot.task.aim.draw(jax.random.key(100)))
    found = kind.draw(0).success(Solved(robot, aim, still), Namespace(trials=1))
    assert found == [0.0 if still else 1.0]
