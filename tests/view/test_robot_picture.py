"""The picture of the robot on the page of a deployment, and the sentence where there is none."""

import base64
import math
from dataclasses import replace
from io import BytesIO

import pytest
import synthetic_run
from matplotlib.image import imread

from sim2real.artifacts.deployment import Deployment, Replay
from sim2real.artifacts.run.run_folder import open_folder
from sim2real.view.blocks import PictureBlock
from sim2real.view.page import robot_picture
from sim2real.view.signals import signals_of

MODEL = """<mujoco><worldbody><body><joint name="th" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -1" size=".1"/>
</body></worldbody></mujoco>"""


def blocks(run):
    deployed = Deployment.load(run / "deploy")
    deployed = replace(deployed, replay=(Replay("th", "rad", 0.1, {}, column="th"),))
    return robot_picture.robot_blocks(run, deployed, signals_of(deployed.recordings[0]))


def test_a_robot_without_a_model_has_a_sentence(run):
    (block,) = blocks(run)
    assert block.text == "There is no picture of the robot: its identification has no MuJoCo model."


def test_the_picture_has_the_measured_pose(run, monkeypatch):
    (run / "identify" / "identified.xml").write_text(MODEL)
    outputs = {"mjcf": {"path": "identified.xml", "sha256": ""}}
    manifest = run / "identify" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"outputs": {}', f'"outputs": {outputs}'.replace("'", '"')))
    assert "mjcf" in open_folder(run / "identify", "identify").outputs
    poses = []
    monkeypatch.setattr(
        robot_picture,
        "drawn",
        lambda model, pose: (poses.append((model.name, pose)), robot_picture.Drawing(b"PNG", ("th",)))[1],
    )
    (block,) = blocks(run)
    assert isinstance(block, PictureBlock)
    assert base64.b64decode(block.data) == b"PNG"
    assert block.caption == "The identified MuJoCo model: th as measured in the middle of episode 0."
    middle_s = synthetic_run.STEPS // 2 * synthetic_run.PERIOD_US / 1e6
    assert poses == [("identified.xml", {"th": pytest.approx(math.sin(middle_s), abs=1e-5)})]


def test_a_driver_that_fails_leaves_a_reason(tmp_path, monkeypatch):
    (tmp_path / "robot.xml").write_text(MODEL)
    monkeypatch.setenv("MUJOCO_GL", "no such driver")
    drawing = robot_picture.drawn(tmp_path / "robot.xml", {})
    assert drawing.png is None
    assert drawing.reason.startswith("MuJoCo did not draw it (")
    assert "no such driver" in drawing.reason


@pytest.mark.night
@pytest.mark.parametrize("joint", [pytest.param("th", marks=pytest.mark.night), "arm/lower/th/joint"])
def test_a_picture_is_drawn_or_its_driver_is_named(joint, tmp_path, monkeypatch):
    """CI may have no driver."""
    (tmp_path / "robot.xml").write_text(MODEL.replace('"th"', f'"{joint}"'))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    drawing = robot_picture.drawn(tmp_path / "robot.xml", {"th": 0.5, "no joint": 1.0})
    if drawing.png is None:
        assert drawing.reason.startswith("MuJoCo did not draw it (")
        return
    pixels = imread(BytesIO(drawing.png))
    assert pixels.shape[:2] == (360, 480)
    assert pixels[..., :3].std() > 0.05
    assert drawing.placed == ("th",)
