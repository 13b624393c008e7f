"""``sim2real new``: a model and a log describe a robot, and become a pipeline."""

import copy
from pathlib import Path

import numpy as np
import pytest

from sim2real import cli
from sim2real.errors import UsageError
from sim2real.log import read_log
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import RobotConfig
from sim2real.stages.load import load_robot, mapping_of
from sim2real.stages.shared.arguments import open_recording
from sim2real.stages.shared.from_model import describe_robot, files_of
from sim2real.stages.shared.robot_flags import RobotFlags

XML = """<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper"><joint name="pan_joint" axis="0 1 0" range="-60 60"/><geom size="0.05" mass="0.3"/>
      <body name="lower" pos="0 0 -0.2"><joint name="lift_joint" axis="0 1 0"/><geom size="0.05" mass="0.2"/></body>
    </body>
  </worldbody>
</mujoco>"""
RATE_HZ = 100.0
NEW = ["new", "rig", "--mjcf", "robot.xml", "--log", "run.npz"]


@pytest.fixture(scope="module")
def recorded():
    t = np.arange(1000) / RATE_HZ
    wave = lambda t: np.stack([0.4 * np.sin(3.1 * t), 0.5 + 0.3 * np.sin(5.7 * t + 1.0)], axis=1)  # noqa: E731
    goal, q = wave(t), 0.98 * wave(t - 0.04)
    return t, goal, q


@pytest.fixture
def workplace(tmp_path, monkeypatch, recorded):
    """A working directory with a model and a log."""
    monkeypatch.chdir(tmp_path)
    t, goal, q = recorded
    Path("robot.xml").write_text(XML)
    np.savez("run.npz", t_s=t, q_rad=q, goal_rad=goal)
    return tmp_path


def test_a_model_and_a_log_describe_a_robot(workplace):
    found = describe_robot(RobotFlags(mjcf=Path("robot.xml")), ["run.npz"])
    assert found.name == "robot"
    own = found.robot
    assert (own.joints, own.commands, own.step_s) == (("pan_joint", "lift_joint"), ("goal",), 0.002)
    assert own.rate_hz == pytest.approx(RATE_HZ, rel=1e-3)
    names = [p.name for p in found.made().dynamics()]
    assert names == ["kp", "damping", "armature", "frictionloss_pan_joint", "frictionloss_lift_joint"]


def test_a_robot_with_motors_reads_a_log_of_another_recorder_by_its_mapping(workplace, recorded):
    robot, (t, goal, q) = copy.copy(load_robot("arm")), recorded
    robot.folder = workplace
    signals = "\n".join(
        f'[nodes.{node}]\nstamps = "t_s"\nfields.{field} = {{ source = "{source}", unit = "rad" }}'
        for node, field, source in (("actuator", "goal", "goal_rad"), ("sensor", "position", "q_rad"))
    )
    Path("import.toml").write_text(f'pipeline = "arm"\n{signals}\n')
    three = lambda x: np.concatenate([x, np.sin(2.0 * x[:, :1])], axis=1)  # noqa: E731
    np.savez("three.npz", t_s=t, q_rad=three(q), goal_rad=three(goal))
    assert open_recording(Path("three.npz"), robot).episode.outputs["sensor"]["position"].shape == (1000, 3)
    with pytest.raises(UsageError, match="2 columns"):
        open_recording(Path("run.npz"), robot)


def test_a_later_log_is_read_and_judged_by_the_mapping_of_the_pipeline(workplace, recorded, capsys):
    assert cli.main(NEW) == 0
    t, goal, q = recorded
    np.savez("swapped.npz", t_s=t, q_rad=q, goal_rad=goal[:, ::-1])
    pipeline = load_robot("rig")
    open_recording(Path("run.npz"), pipeline)
    assert "contradict" not in capsys.readouterr().err
    open_recording(Path("swapped.npz"), pipeline)
    assert "contradict each other: pan_joint follows the goal of lift_joint" in capsys.readouterr().err
    for columns in (1, 3):
        np.savez("other.npz", t_s=t, q_rad=np.tile(q, 2)[:, :columns], goal_rad=np.tile(goal, 2)[:, :columns])
        with pytest.raises(UsageError, match="expected 2: pan_joint, lift_joint"):
            open_recording(Path("other.npz"), pipeline)
    np.savez("still.npz", t_s=t, q_rad=0 * q, goal_rad=0 * goal)  # at rest, from which no mapping can be proposed
    assert open_recording(Path("still.npz"), pipeline).episode.outputs["sensor"]["position"].shape == q.shape


def test_check_says_of_a_joint_that_stands_still_what_to_record(workplace, capsys, recorded):
    t, goal, q = recorded
    noise = 1e-3 * np.random.default_rng(0).standard_normal(q.shape)
    np.savez("run.npz", t_s=t, q_rad=np.stack([q[:, 0], 0 * t], 1) + noise, goal_rad=np.stack([goal[:, 0], 0 * t], 1))
    assert cli.main(NEW) == 0
    assert cli.main(["check", "rig", "--log", "run.npz"]) == 1
    out = capsys.readouterr().out
    assert "lift_joint does not move at all" in out
    assert "nothing in this data determines frictionloss_lift_joint" in out
    assert "record instead: slow motion of each joint, with reversals" in out
    assert "goal of lift_joint" in out


def test_gains_and_torque_that_is_switched_make_inputs(workplace, recorded):
    t, goal, q = recorded
    np.savez("run.npz", t_s=t, q_rad=q, goal_rad=goal, kp=np.float64(32.0), torque_enable=np.ones(len(t)))
    own = describe_robot(RobotFlags(mjcf=Path("robot.xml")), ["run.npz"]).robot
    assert (set(own.commands), set(own.shared)) == ({"goal", "kp", "enabled"}, {"kp", "enabled"})
    assert own.kp_unit == 32.0
    assert ParameterPattern("kd") in own.terms


def test_an_imported_log_is_taken_as_it_is_and_a_mapping_that_the_data_contradict_is_refused(workplace, capsys):
    assert cli.main(["import", "run.npz", "--mjcf", "robot.xml", "--out", "run.mcap"]) == 0
    out, err = capsys.readouterr()
    assert "positions follow their goals" in err
    assert "wrote run.import.toml" in out
    assert read_log("run.mcap").metadata["pipeline"] == "robot"
    found = describe_robot(RobotFlags(mjcf=Path("robot.xml")), ["run.mcap"])
    assert found.mapping is None
    assert found.robot.commands == ("goal",)
    assert cli.main(["import", "run.npz", "--mapping", "run.import.toml", "--out", "again.mcap"]) == 0
    # A mapping that the data contradict is refused.
    text = Path("run.import.toml").read_text()
    swapped = text.replace('source = "goal_rad"', 'source = ["goal_rad[:,1]", "goal_rad[:,0]"]')
    assert swapped != text
    Path("wrong.toml").write_text(swapped)
    capsys.readouterr()
    assert cli.main(["import", "run.npz", "--mapping", "wrong.toml", "--out", "wrong.mcap"]) == 2
    assert "joint 0 follows the goal of joint 1" in capsys.readouterr().err
    assert not Path("wrong.mcap").exists()
    assert cli.main(["import", "run.npz", "--mapping", "wrong.toml", "--out", "wrong.mcap", "--as-told"]) == 0
    with pytest.raises(UsageError, match="contradict"):
        describe_robot(RobotFlags(mjcf=Path("robot.xml"), mapping=Path("wrong.toml")), ["run.npz"])


def test_new_writes_a_pipeline_that_loads(workplace):
    flags = ("--joints", "lift_joint", "pan_joint")
    assert cli.main([*NEW, *flags]) == 0
    assert {p.name for p in Path("pipelines/rig").iterdir()} == {
        "__init__.py", "robot.py", "robot.toml", "robot.xml", "import.toml"
    }  # fmt: skip
    robot = load_robot("rig")
    assert [c.label for c in robot.channels] == list(flags[1:])
    assert robot.defaults.identify.initial_state == "measured"
    assert mapping_of(robot, Path("run.npz")) is not None


def test_the_number_of_a_lone_joint_is_a_vector(workplace, recorded):
    t, goal, q = recorded
    np.savez("lone.npz", t=t, goal=goal[:, 0], q=q[:, 0], volts=12.0)
    Path("map.toml").write_text(
        'pipeline = "robot"\n[nodes.actuator]\nstamps = "t"\nfields.goal = { source = "goal", unit = "rad" }\n'
        'fields.volts = { source = "volts", unit = "V" }\n'
        '[nodes.sensor]\nstamps = "t"\nfields.position = { source = "q", unit = "rad" }\n'
    )
    flags = ["--joints", "pan_joint", "--hold", "lift_joint=0.1", "--mapping", "map.toml"]
    assert cli.main(["new", "rig", "--mjcf", "robot.xml", "--log", "lone.npz", *flags]) == 0
    pipeline = load_robot("rig")
    outputs = open_recording(Path("lone.npz"), pipeline).episode.outputs
    shapes = {name: values.shape for fields in outputs.values() for name, values in fields.items()}
    assert shapes == {"goal": (1000, 1), "volts": (1000, 1), "position": (1000, 1)}
    # A log of ours keeps its shapes, and the error tells the remedy.
    assert cli.main(["import", "lone.npz", "--mapping", "map.toml", "--out", "lone.mcap"]) == 0
    with pytest.raises(UsageError, match="goal \\(\\)") as caught:
        describe_robot(RobotFlags(mjcf=Path("robot.xml"), joints=("pan_joint",)), ["lone.mcap"])
    assert "list of one source" in str(caught.value.hint)


def test_new_without_a_log_goes_by_its_flags(workplace, capsys):
    arguments = [
        "new",
        "rig",
        "--mjcf",
        "robot.xml",
        "--drive",
        "mit",
        "--parameter",
        "damping:each",
        "--joints",
        "pan_joint",
    ]
    assert cli.main(arguments) == 0
    own = RobotConfig.load(Path("pipelines/rig/robot.toml"))
    assert own.commands == ("goal", "goal_velocity", "torque", "kp", "kd")
    assert own.terms == (ParameterPattern("damping", each=True),)
    assert cli.main(arguments) == 2
    assert "exists" in capsys.readouterr().err


def test_a_model_with_files_of_its_own_stays_where_it_is(workplace):
    Path("meshes").mkdir()
    asset = '<asset><mesh name="m" file="meshes/m.obj"/></asset><worldbody>'
    Path("robot.xml").write_text(XML.replace("<worldbody>", asset))
    Path("meshes/m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    texts = files_of(RobotConfig(Path("robot.xml"), ("pan_joint",), ("goal",)))
    assert list(texts) == ["robot.toml"]
    assert str(workplace / "robot.xml") in texts["robot.toml"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([*NEW, "--joints", "toe"], "toe"),
        ([*NEW, "--joints", "pan_joint"], "not the robot's 1 joints"),
        ([*NEW, "--parameter", "kq"], "unknown parameter 'kq'"),
        ([*NEW, "--velocity"], "no velocity"),
        (["new", "rig", "--mjcf", "none.xml", "--log", "run.npz"], "none.xml"),
        (["new", "Rig", "--mjcf", "robot.xml"], "small letters"),
        (["new", "rig"], "--mjcf"),
        (["validate"], "validate needs RUN|PIPELINE|PARAMETERS"),
    ],
)
def test_wrong_commands_are_refused_before_anything_is_compiled(workplace, capsys, arguments, named):
    assert cli.main(arguments) == 2
    assert named in capsys.readouterr().err
    assert not Path("pipelines").exists()


@pytest.mark.parametrize(("name", "told"), [("disk", True), ("rig", False)])
def test_a_pipeline_that_hides_an_installed_one_is_told(workplace, capsys, name, told):
    assert cli.main(["new", name, "--mjcf", "robot.xml"]) == 0
    assert ("no longer the one that is installed" in capsys.readouterr().err) == told
    assert Path(f"pipelines/{name}/__init__.py").read_text().startswith('"""Recorded robot of 2 joints')
