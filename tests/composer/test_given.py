"""What was said of elements, and what PyMJCF's users look for: lists by tag, classes of defaults, files."""

import zipfile

import mujoco
import pytest

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.errors import UsageError

SERVO = """
<mujoco model="servo">
  <default>
    <geom rgba="1 0 0 1"/>
    <default class="thin"><geom size=".01" mass="2"/><joint damping=".5"/><position kv="3"/></default>
  </default>
  <worldbody>
    <body name="link" pos="0 0 0" childclass="thin">
      <!-- <geom name="commented"/> -->
      <joint name="hinge"
             limited="true" range="-1 1"/>
      <geom name="shell" size=".2" contype="0"/>
      <geom name="plain" euler="0 0 90"/>
      <body name="tip"><geom name="ball" class="thin"/><site name="tip"/></body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="5" class="thin"/>
    <motor name="motor" joint="hinge" gear=".5"/>
  </actuator>
  <sensor><gyro name="gyro" site="tip"/><framepos objtype="body" objname="tip"/></sensor>
</mujoco>
"""


@pytest.fixture
def servo():
    return mjcf.from_xml_string(SERVO)


def test_what_was_not_said_reads_as_none(servo):
    geom, joint = servo.find("geom", "shell"), servo.find("joint", "hinge")
    assert geom.size.tolist() == [0.2]
    assert geom.contype == 0
    assert (geom.rgba, geom.mass, geom.pos, geom.dclass, geom.type, geom.material) == (None,) * 6
    assert servo.find("body", "link").pos.tolist() == [0, 0, 0]
    assert (joint.limited, joint.range.tolist(), joint.damping, joint.ref) == ("true", [-1, 1], None, None)
    motor, position = servo.find("actuator", "motor"), servo.find("actuator", "servo")
    assert (motor.tag, motor.gear.tolist(), motor.ctrlrange, motor.tendon) == ("motor", [0.5], None, None)
    assert (position.tag, position.kp, position.joint) == ("position", 5.0, joint)
    assert servo.sensor.framepos[0].objtype == "body"
    with pytest.raises(AttributeError, match="nonsense"):
        _ = geom.nonsense
    assert set(geom.get_attributes()) == {"name", "size", "contype"}


def test_what_a_program_says_is_said(servo):
    geom = servo.find("body", "tip").add("geom", size=[0.1, 0.2], type="sphere", rgba=None)
    assert (geom.size.tolist(), geom.type, geom.rgba, geom.mass) == ([0.1, 0.2], "sphere", None, None)
    geom.mass = 3
    geom.size[0] = 0.3
    assert geom.mass == 3
    assert servo.compile().geom_size[-1].tolist()[:2] == [0.3, 0.2]
    del geom.mass
    geom.size = None
    assert geom.mass is None
    assert geom.size is None
    model = servo.compile()
    assert model.geom_size[-1, 0] == 0.01  # its class's, that of the body that it stands in
    assert model.body("tip").mass == 4.0


def test_attributes_for_the_parser_can_be_set_later(servo):
    position = servo.find("actuator", "servo")
    assert servo.compile().actuator_biasprm[0, :3].tolist() == [0, -5, -3]
    position.kp = 7
    model = servo.compile()
    assert (model.actuator_gainprm[0, 0], model.actuator_biasprm[0, :3].tolist()) == (7, [0, -7, -3])
    servo.find("geom", "shell").fluidshape = "ellipsoid"
    assert servo.find("geom", "shell").fluidshape == "ellipsoid"
    assert servo.compile().geom_fluid[0].any()


def test_lists_by_tag_and_elements_by_place(servo):
    assert [e.name for e in servo.sensor.gyro] == ["gyro"]
    assert servo.actuator.motor["motor"].parent is servo.actuator
    link, tip = servo.find("body", "link"), servo.find("body", "tip")
    assert (link.find("geom", "ball"), tip.find("geom", "shell")) == (tip.geom[0], None)
    assert (tip.parent, link.parent, link.parent.parent) == (link, servo.worldbody, servo)
    inertial = tip.add("inertial", mass=2, pos=[0, 0, 0.1], diaginertia=[1, 1, 1])
    assert (tip.inertial, inertial.mass, inertial.parent, link.inertial) == (inertial, 2.0, tip, None)
    servo.actuator.motor.clear()
    assert [e.tag for e in servo.find_all("actuator")] == ["position"]
    root = mjcf.RootElement(model="root")
    root.attach(servo)
    assert (root.enter_scope("servo"), root.enter_scope("other")) == (servo, None)
    assert servo.find("actuator", "servo").joint.full_identifier == "servo/hinge"


def test_references_beside_their_model_resolve(servo):
    root, other = mjcf.RootElement(model="root"), mjcf.from_xml_string(SERVO.replace('"servo"', '"other"', 1))
    root.attach(servo)
    root.attach(other)
    servo.sensor.add("framepos", name="where", objtype="body", objname=other.find("body", "tip"))
    model = root.compile()
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SENSOR, i) for i in range(model.nsensor)]
    assert names[2] == "servo/where"
    assert model.sensor("servo/where").objid == model.body("other/tip").id


def test_textures_of_attached_models_are_found():
    root, house = mjcf.RootElement(model="root"), mjcf.RootElement(model="house")
    brick = house.asset.add("texture", name="brick", type="2d", builtin="flat", width=8, height=8)
    root.attach(house)
    wall = root.asset.add("material", name="wall", texture=brick)
    root.worldbody.add("geom", size=[1], material=wall)
    house.model = "villa"
    model = root.compile()
    assert wall.texture is brick
    assert (model.tex("villa/brick").id, 0 in model.mat_texid[0]) == (0, True)


def test_files_are_collected_and_written(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tip.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    (tmp_path / "part.xml").write_text('<mujoco><asset><mesh name="tip" file="tip.obj"/></asset></mujoco>')
    (tmp_path / "arm.xml").write_text(
        '<mujoco model="arm"><compiler meshdir="meshes"/><include file="part.xml"/>'
        '<worldbody><geom name="tip" type="mesh" mesh="tip"/></worldbody></mujoco>'
    )
    root, arm = mjcf.RootElement(model="root"), mjcf.from_path(tmp_path / "arm.xml")
    root.attach(arm)
    mesh = arm.find("mesh", "tip")
    twin = arm.asset.add("mesh", name="twin", file=mjcf.Asset(mesh.file.contents, ".obj"))
    assert twin.file.contents == mesh.file.contents
    assets = root.get_assets()
    assert [len(a) for a in assets.values()] == [len(mesh.file.contents)] * 2
    assert mujoco.MjModel.from_xml_string(root.to_xml_string(), assets).nmesh == 2
    mjcf.export_with_assets(root, tmp_path / "out")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "root.xml")).nmesh == 2
    assert root.compile().nmesh == 2  # the model's own files are called as before
    with pytest.raises(UsageError, match=r"must end with '\.xml'"):
        mjcf.export_with_assets(root, tmp_path, "root.mjcf")
    with zipfile.ZipFile(mjcf.export_with_assets_as_zip(root, tmp_path / "new")) as archive:
        archive.extractall(tmp_path)
    found = {file.name: file.read_bytes() for file in (tmp_path / "root").iterdir()}
    assert found == {file.name: file.read_bytes() for file in (tmp_path / "out").iterdir()}
    (tmp_path / "part.xml").unlink()
    with pytest.raises(UsageError, match=r"includes 'part\.xml', which is not there"):
        mjcf.from_path(tmp_path / "arm.xml")


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        (
            '<extension><plugin plugin="mujoco.pid"><instance name="pid"><config key="kp" value="4"/></instance>'
            '</plugin></extension><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>'
            '<actuator><plugin plugin="mujoco.pid" instance="pid" joint="j"/></actuator>',
            {"nplugin": 2, "nu": 2},
        ),
        pytest.param(
            '<worldbody><body><composite type="cable" curve="s" count="4 1 1" size="1" initial="none">'
            '<geom type="capsule" size=".01"/><joint kind="main"/></composite></body></worldbody>',
            {"nbody": 11, "nv": 12},
            marks=pytest.mark.skipif(mujoco.__version__ >= "4", reason="MuJoCo 4 has no composites"),
        ),
        (
            '<asset><skin name="s" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2"><bone body="b" bindpos="0 0 0" '
            'bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin></asset>'
            '<worldbody><body name="b"><geom size=".1"/></body></worldbody>',
            {"nskin": 2},
        ),
    ],
    ids=["plugin", "composite", "skin"],
)
def test_what_only_documents_can_hold_is_attached_with_them(text, counts):
    arena = composer.Arena()
    for _ in range(2):
        arena.attach(composer.ModelWrapperEntity(mjcf.from_xml_string(f'<mujoco model="part">{text}</mujoco>')))
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    assert {name: getattr(physics.model, name) for name in counts} == counts
    physics.step()
