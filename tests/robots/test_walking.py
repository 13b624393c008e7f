"""A robot with a floating base: commands, its twin in C MuJoCo, and the policy that comes with pipelines/go2."""

import re
import shlex
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest

from pipelines.go2.robot import ROBOT
from sim2real import cli
from sim2real.commands.play import PlayConfig, run
from sim2real.emulation.body import HiddenTwin
from sim2real.errors import UsageError
from sim2real.policy.bundle import load_bundle
from sim2real.policy.contract import observation_size
from sim2real.robots.walking.drive import gravity_of
from sim2real.robots.walking.task import Commands
from sim2real.robots.walking.twin import Twin, walk
from sim2real.stages.load import load_robot

ROOT = Path(__file__).parents[2]
BUNDLE = ROOT / "pipelines/go2/walk"


def test_gravity_points_to_the_low_side():
    rolled = np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])  # the left side goes up, by 0.4 rad
    np.testing.assert_allclose(gravity_of(rolled), [0.0, -np.sin(0.4), -np.cos(0.4)], atol=1e-12)
    np.testing.assert_allclose(gravity_of(0.9 * rolled), gravity_of(rolled), atol=1e-12)


def test_commands_follow_one_another_and_some_are_zero():
    commands = Commands(most=(1.0, 0.5, 0.8), every_s=2.0, stand=0.5, count=50)
    drawn = np.asarray(commands.draw(jax.random.key(0)))
    rows = drawn.reshape(50, 3)
    assert (np.abs(rows) <= np.array([1.0, 0.5, 0.8])).all()
    assert 10 < (rows == 0).all(1).sum() < 40
    np.testing.assert_array_equal(commands.at(drawn, np.float64(3.9)), rows[1])
    np.testing.assert_array_equal(commands.at(drawn, np.float64(4.0)), rows[2])
    np.testing.assert_array_equal(commands.at(drawn, np.float64(100.0)), rows[0])


def test_the_observation_is_the_contract_of_the_bundle():
    contract = load_bundle(BUNDLE).contract
    assert contract.observation_size == observation_size(ROBOT.task.observation)
    assert [t.name for t in contract.observation] == [t.name for t in ROBOT.task.observation]
    assert [t.name for t in contract.action] == list(ROBOT.joints)


def test_the_shipped_policy_walks_on_hidden_twins_with_pushes():
    for seed in range(2):
        twin = Twin(ROBOT, HiddenTwin.draw(np.random.default_rng(seed), 12), seed)
        walked = walk(twin, load_bundle(BUNDLE), lambda _: np.array([0.6, 0.0, 0.3]), 6.0, push_m_s=0.5)
        assert walked.fell_s is None
        assert walked.error_m_s < 0.25
        assert walked.qpos[-1, :2] @ walked.qpos[-1, :2] > 1.0  # it went somewhere


def test_targets_act_as_late_as_the_twin_says():
    for delay_s in (0.004, 0.02):
        twin = Twin(ROBOT, HiddenTwin(acting_s=delay_s))
        before = twin.data.ctrl.copy()
        twin.send(before + 0.1)
        twin.advance(delay_s)
        np.testing.assert_array_equal(twin.data.ctrl, before)
        twin.advance(0.002)
        np.testing.assert_allclose(twin.data.ctrl, before + 0.1)


def test_play_writes_a_picture(tmp_path, capsys):
    run(PlayConfig("go2", duration_s=0.5, view=str(tmp_path / "a.gif"), runs=tmp_path))
    assert (tmp_path / "a.gif").read_bytes()[:3] == b"GIF"
    assert "walked for 0.5 s" in capsys.readouterr().err


def test_a_film_of_another_format_is_refused_before_the_walk(tmp_path):
    with pytest.raises(UsageError, match=r"a \.gif"):
        PlayConfig("go2", view=str(tmp_path / "a.avi"))


def test_play_refuses_a_robot_that_does_not_walk(tmp_path):
    bundle = tmp_path / "pendulum" / "walk"
    shutil.copytree(BUNDLE, bundle)
    with pytest.raises(UsageError, match="does not walk"):
        run(PlayConfig(str(bundle)))


def test_a_copy_of_the_pipeline_under_another_name_is_a_robot(tmp_path, monkeypatch):
    """As docs/guides/walk.md says."""
    left = shutil.ignore_patterns("walk", "__pycache__")
    shutil.copytree(ROOT / "pipelines/go2", tmp_path / "pipelines/walker", ignore=left)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["info", "walker"]) == 0
    robot = load_robot("walker")
    assert robot.name == "walker"
    assert Path(robot.mjcf).parent == tmp_path / "pipelines/walker"


@pytest.mark.night
def test_the_commands_of_the_guide_run(tmp_path, monkeypatch):
    text = (ROOT / "docs/guides/walk.md").read_text()
    commands = re.findall(r"^    sim2real (play go2.*)$", text, re.MULTILINE)
    assert len(commands) == 3
    (tmp_path / "pipelines").symlink_to(ROOT / "pipelines")
    monkeypatch.chdir(tmp_path)
    for command in commands:
        assert not cli.main(shlex.split(command))
    assert (tmp_path / "walk.gif").is_file()
