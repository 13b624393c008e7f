"""Models of robots that other people wrote: what is read of them, what is left out, and what is refused."""

import struct
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing.readers import open_tables
from sim2real.robots.model import file as model_file
from sim2real.robots.model.drives import driven
from sim2real.robots.model.file import read_model
from sim2real.robots.model.parameters import ParameterPattern, usual_patterns
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.import_logs import stage as import_logs_stage
from sim2real.stages.shared import from_model

FOUR_BAR = """<mujoco><compiler angle="radian"/><worldbody>
<body name="crank"><joint name="crank" axis="0 1 0" damping=".01"/>
 <geom type="capsule" size=".01" fromto="0 0 0 0 0 .1" mass=".1"/>
 <body name="coupler" pos="0 0 .1"><joint name="p1" axis="0 1 0"/>
  <geom type="capsule" size=".01" fromto="0 0 0 .2 0 0" mass=".2"/></body></body>
<body name="rocker" pos=".2 0 0"><joint name="p2" axis="0 1 0"/>
 <geom type="capsule" size=".01" fromto="0 0 0 0 0 .1" mass=".1"/></body></worldbody>
<equality><connect body1="coupler" body2="rocker" anchor=".2 0 0"/></equality>
<actuator><motor joint="crank"/></actuator></mujoco>"""
LINK = """<inertial><origin xyz="0.03 0 0"/><mass value="0.1"/>
  <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An import writes its questions into the current folder."""
    monkeypatch.chdir(tmp_path)


def urdf(mimic: str) -> str:
    return f"""<robot name="jaw"><link name="palm"/><link name="l">{LINK}</link><link name="r">{LINK}</link>
  <joint name="drive" type="revolute"><parent link="palm"/><child link="l"/><origin xyz="0 0.02 0"/><axis xyz="0 1 0"/>
   <limit lower="-1" upper="1" effort="2" velocity="5"/></joint>
  <joint name="follow" type="revolute"><parent link="palm"/><child link="r"/><origin xyz="0 -0.02 0"/>
   <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="2" velocity="5"/>{mimic}</joint></robot>"""


def meshed(mesh: str, inertia: str = LINK, more: str = "") -> str:
    return f"""<robot name="arm"><link name="base">{more}</link><link name="l">{inertia}
  <visual><geometry><mesh filename="{mesh}"/></geometry></visual>
  <collision><geometry><mesh filename="{mesh}"/></geometry></collision></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="l"/><axis xyz="0 1 0"/>
   <limit lower="-1" upper="1" effort="10" velocity="10"/></joint></robot>"""


def inertia_of(model, name: str, start: float) -> float:
    """Return 1 mN m over a joint's acceleration in 0.1 s, without gravity, from where a follower stands [kg m^2]."""
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[1:] = start
    data.ctrl[0] = 1e-3
    mujoco.mj_step(model, data, 50)
    return 1e-3 * 0.1 / data.qvel[model.joint(name).dofadr[0]]


@pytest.mark.parametrize(("contacts", "radians"), [(True, 2.900), (False, 6.191)])
def test_the_crank_of_a_four_bar_moves_as_in_its_own_file(tmp_path, contacts, radians):
    """After 0.5 s at 0.2 N m; the rods touch from 2.9 rad on."""
    (tmp_path / "bar.xml").write_text(FOUR_BAR)
    model = driven(tmp_path / "bar.xml", ("crank",), 0.002, False, contacts)
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.2
    mujoco.mj_step(model, data, 250)
    assert data.qpos[0] == pytest.approx(radians, abs=0.002)


@pytest.mark.parametrize(
    ("mimic", "inertia", "start"),
    [
        ('<mimic joint="drive" multiplier="-1"/>', 3.8e-4, [0.0]),
        ('<mimic joint="drive" multiplier="0.5" offset="0.1"/>', 1.9e-4 * 1.25, [0.1]),
        ("", 1.9e-4, []),
    ],
)
def test_a_mimic_follower_adds_its_inertia(tmp_path, mimic, inertia, start):
    (tmp_path / "jaw.urdf").write_text(urdf(mimic))
    model = driven(tmp_path / "jaw.urdf", ("drive",), 0.002, False, False)
    assert model.nv == 1 + len(start)
    assert inertia_of(model, "drive", *(start or [0.0])) == pytest.approx(inertia, rel=0.02)


def test_what_was_not_recorded_is_printed(tmp_path, capsys):
    (tmp_path / "jaw.urdf").write_text(urdf('<mimic joint="drive" multiplier="-1"/>'))
    from_model.note_held(RobotConfig(tmp_path / "jaw.urdf", ("drive",), ("goal",)))
    assert "not recorded, free: follow, which an equality without a name moves" in capsys.readouterr().err
    (tmp_path / "jaw.urdf").write_text(urdf(""))
    from_model.note_held(RobotConfig(tmp_path / "jaw.urdf", ("drive",), ("goal",), hold=("follow=0.5",)))
    assert "not recorded, held: follow at 0.5 rad, named" in capsys.readouterr().err


@pytest.mark.parametrize("mesh", ["package://my_robot/meshes/arm.stl", "package://my_robot/arm.dae", "meshes/none.stl"])
@pytest.mark.parametrize(
    "more", ["", '<collision><geometry><mesh filename="package://my_robot/base.stl"/></geometry></collision>']
)
def test_meshes_that_only_contacts_need_are_left_out(tmp_path, mesh, more, capsys):
    """The link's inertia is in the file, and the base cannot move."""
    path = tmp_path / "arm.urdf"
    path.write_text(meshed(mesh, more=more))
    assert read_model(path).body("l").mass[0] == 0.1
    from_model.note_held(RobotConfig(path, ("j",), ("goal",)))
    assert mesh in capsys.readouterr().err


def tetrahedron(path: Path) -> None:
    corners = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    path.parent.mkdir(parents=True)
    path.write_bytes(bytes(80) + struct.pack("<I", 4) + rows)


@pytest.mark.parametrize("variable", ["", "ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_packages_are_found(tmp_path, monkeypatch, variable):
    """Above the file, or where ROS has them; a link without an inertia then gets its mesh's: 1000 kg/m^3."""
    folder = {"": "ws/src", "ROS_PACKAGE_PATH": "else", "AMENT_PREFIX_PATH": "else/share"}[variable]
    tetrahedron(tmp_path / folder / "my_robot" / "meshes" / "arm.stl")
    if variable:
        monkeypatch.setenv(variable, str(tmp_path / "else"))
    path = tmp_path / "ws" / "src" / "my_robot" / "urdf" / "arm.urdf"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(meshed("package://my_robot/meshes/arm.stl", inertia=""))
    assert read_model(path).body("l").mass[0] == pytest.approx(1000 * 1e-3 / 6, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "contacts", "causes"),
    [
        (meshed("package://other/arm.stl", inertia=""), False, [
            "Error opening file", "inertia of l", "package://other was looked for in", "ROS_PACKAGE_PATH"]),
        (meshed("package://other/arm.stl"), True, ["Error opening file", "package://other was looked for in"]),
        ('<mujoco><worldbody><body><joint/><geom name="g" size="-1"/></body></worldbody></mujoco>', False, [
            "Element name 'g'"]),
        ('<mujoco>\n<worldbody>\n<geom size="0.1" colour="1"/></worldbody></mujoco>', False, [
            "unrecognized attribute: 'colour'", "line 3"]),
    ],
)  # fmt: skip
def test_all_that_mujoco_reports_is_printed(tmp_path, text, contacts, causes):
    (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(UsageError) as raised:
        model_file.read_file(tmp_path / "robot.xml", contacts)
    for cause in causes:
        assert cause in str(raised.value)


def model(extra: str = "", body: str = "", option: str = "", joint: str = "j1") -> str:
    return f"""<mujoco><option timestep="0.002" {option}/>{extra}<worldbody><body name="b">
<joint name="{joint}" axis="0 1 0"/><geom size="0.1"/>{body}</body></worldbody></mujoco>"""


def test_a_name_with_a_line_break_matches_a_pattern(tmp_path):
    (tmp_path / "robot.xml").write_text(model(joint="a&#10;[[terms]]"))
    config = RobotConfig(tmp_path / "robot.xml", ("a\n[[terms]]",), ("goal",), terms=usual_patterns(("goal",)))
    assert len(MjcfRobot(config).dynamics()) == 4


SLIDE = '<joint name="x" type="slide" axis="1 0 0" frictionloss="10"/>'
AXIS = f"""<mujoco><option gravity="0 0 0"/><worldbody><body>{SLIDE}<geom size=".1" mass="95"/>
{{}}</body></worldbody></mujoco>"""
RAIL = AXIS.format('<body><joint name="arm" axis="0 1 0"/><geom size=".1" pos=".2 0 0" mass="1"/></body>')
UNITS = {
    "gain": ("N m", "N"), "damping": ("N m s/rad", "N s/m"), "armature": ("kg m^2", "kg"), "frictionloss": ("N m", "N"),
    "kp": ("N m/rad", "N/m"), "kd": ("N m s/rad", "N s/m"), "torque": ("N m", "N"),
    "zero": ("rad", "m"), "play": ("rad", "m"), "drag": ("N m s^2/rad^2", "N s^2/m^2"), "static": ("N m", "N"),
    "stribeck_rad_s": ("rad/s", "m/s"), "load": ("1", "1"), "tilt_x": ("rad", "rad"),
}  # fmt: skip


@pytest.mark.parametrize("what", UNITS)
def test_parameters_of_slides_are_in_metres_and_newtons(tmp_path, what):
    """Also beside a hinge, with which a slide shares no value that has another unit."""
    (tmp_path / "rail.xml").write_text(RAIL)
    for joints, index in ((("arm",), 0), (("x",), 1)):
        config = RobotConfig(tmp_path / "rail.xml", joints, ("torque",), terms=(ParameterPattern(what),))
        assert [p.unit for p in MjcfRobot(config).dynamics()] == [UNITS[what][index]]
    both = MjcfRobot(replace(config, joints=("x", "arm"))).dynamics()
    if len(set(UNITS[what])) == 1:
        assert [(p.name, p.unit) for p in both] == [(what, UNITS[what][0])]
    else:
        assert [(p.name, p.unit) for p in both] == [(what, UNITS[what][0]), (f"{what}_slide", UNITS[what][1])]


@pytest.mark.parametrize(
    ("text", "joints", "units"),
    [
        (AXIS.format(""), ("x",), {"position": "m", "velocity": "m/s", "torque": "N"}),
        (RAIL, ("arm",), {"position": "rad", "velocity": "rad/s", "torque": "N m"}),
        (RAIL, ("x", "arm"), {"position[0]": "m", "position[1]": "rad", "velocity[0]": "m/s", "velocity[1]": "rad/s",
                              "torque[0]": "N", "torque[1]": "N m"}),
    ],
)  # fmt: skip
def test_fields_of_slides_are_in_metres_and_newtons(tmp_path, text, joints, units):
    (tmp_path / "rail.xml").write_text(text)
    robot = MjcfRobot(RobotConfig(tmp_path / "rail.xml", joints, ("torque",), velocity=True))
    assert robot.units == units


@pytest.mark.parametrize(
    ("file", "text", "joints", "scale", "units"),
    [
        ("q_m", AXIS.format(""), ("x",), 0.1, ("m", "N")),
        ("q", AXIS.format(""), ("x",), 0.1, ("m", "N")),
        ("q_rad", RAIL, ("arm",), 0.5, ("rad", "N m")),
    ],
)
def test_logs_of_slides_are_in_metres_and_newtons(tmp_path, file, text, joints, scale, units):
    t = np.arange(0.0, 20.0, 0.005)
    q = scale * np.sin(2 * np.pi * 0.7 * t + np.sin(1.3 * t))[:, None]
    np.savez(
        tmp_path / "run.npz", **{"t_s": t, file: q, "force_cmd_n": 1000 * np.gradient(np.gradient(q, axis=0), axis=0)}
    )
    (tmp_path / "robot.xml").write_text(text)
    asked = import_logs_stage.hints_of_model(tmp_path / "robot.xml", "axis", joints, unit="m" if file == "q" else "")
    mapping, _ = import_logs_stage.proposed(open_tables(tmp_path / "run.npz")[0], asked)
    assert (mapping.units["sensor"]["position"], mapping.units["actuator"]["torque"]) == units


def test_millimetres_of_a_slide_are_not_taken_for_degrees(tmp_path):
    t = np.arange(0.0, 20.0, 0.005)
    q = 120.0 * np.sin(2 * np.pi * 0.7 * t + np.sin(1.3 * t))[:, None]
    np.savez(tmp_path / "run.npz", t_s=t, q=q, force_cmd=np.gradient(np.gradient(q, axis=0), axis=0))
    (tmp_path / "robot.xml").write_text(AXIS.format(""))
    asked = import_logs_stage.hints_of_model(tmp_path / "robot.xml", "axis")
    with pytest.raises(UsageError, match="mm"):
        import_logs_stage.proposed(open_tables(tmp_path / "run.npz")[0], asked)


@pytest.mark.night
@pytest.mark.parametrize(("to", "share"), [(0.3, None), (1.0, "47%")])
def test_recorded_positions_at_which_a_loop_cannot_close_are_reported(tmp_path, to, share):
    """A rocker of 0.04 m stops the crank of 0.1 m at 0.44 rad; the gap is 5 mm at 0.48 rad."""
    (tmp_path / "bar.xml").write_text(FOUR_BAR.replace('"rocker" pos=".2 0 0"', '"rocker" pos=".2 0 .06"'))
    robot = MjcfRobot(RobotConfig(tmp_path / "bar.xml", ("crank",), ("torque",)))
    episode = Episode(steps={}, messages={}, outputs={"sensor": {"position": np.linspace(-0.1, to, 100)[:, None]}})
    doubts = robot.doubts(episode.outputs)
    assert bool(doubts) == (share is not None)
    assert share is None or f"loops of bar.xml cannot close at {share} of the recorded positions" in doubts[0]
