"""Models: random ones against PyMJCF, and what PyMJCF has no answer to, or another one."""

import copy
import zipfile

import mujoco
import numpy as np
import pytest
import random_models
from random_models import names

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.mjcf.files import Asset, renamed_skin
from sim2real.errors import Sim2RealError, UsageError


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.night) for part in range(1, 50))])
def test_random_models_are_those_of_dm_control(oracle, part):
    found = {seed: random_models.compare(seed) for seed in range(20 * part, 20 * part + 20)}
    assert not any(found.values()), found


# -- what a model names

ROBOT = """
<mujoco model="r"><asset><material name="skin" rgba="1 0 0 1"/></asset>
  <worldbody><body name="b"><joint name="j"/><geom name="g" size=".1" material="skin"/><site name="s"/></body>
    <body name="c" pos="0 0 1"><joint name="k"/><geom name="h" size=".1"/><site name="z"/></body>{inside}</worldbody>
  {beside}</mujoco>"""


def robot(inside="", beside=""):
    return mjcf.from_xml_string(ROBOT.format(inside=inside, beside=beside))


NAMING = {
    "joint": ("joint k", '<equality><joint joint1="j" joint2="k"/></equality>'),
    "side site": (
        "site z",
        '<tendon><spatial><site site="s"/><geom geom="g" sidesite="z"/><site site="s"/></spatial></tendon>',
    ),
    "tuple": ("body c", '<custom><tuple name="t"><element objtype="body" objname="c"/></tuple></custom>'),
    "target": ("body c", '<camera mode="targetbody" target="c"/>'),
}


@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("reference", NAMING)
def test_what_names_a_removed_element_stays_and_is_refused(reference, attached):
    """Without its second element, an equality would hold the first one in place."""
    removed, text = NAMING[reference]
    kind, name = removed.split()
    model = robot(**{"inside" if text.startswith("<camera") else "beside": text})
    if attached:
        mjcf.RootElement(model="w").attach(model)
    model.find(kind, name).remove()
    with pytest.raises(UsageError, match=f"refers to the {kind} '{name}', which was removed"):
        model.root_model.compile()
    plain = robot()
    plain.find("material", "skin").remove()  # a material is forgotten
    assert plain.find("geom", "g").material is None
    assert plain.compile().geom_matid.tolist() == [-1, -1]


def test_a_model_that_others_name_may_be_detached_and_come_back():
    top, left, right = (robot() for _ in range(3))
    top.model = "top"
    for model in (left, right):
        top.attach(model)
    left.actuator.add("motor", name="m", joint=right.find("joint", "k"))
    right.detach()
    with pytest.raises(UsageError, match="refers to model 'r_1', which is not attached below it"):
        top.compile()
    right.model = "again"
    top.attach(right)
    model = top.compile()
    assert model.actuator("r/m").trnid[0] == model.joint("again/k").id
    twin = copy.copy(left)  # it names the same element of another model
    top.attach(twin)
    assert top.compile().actuator_trnid[:, 0].tolist() == [model.joint("again/k").id] * 2
    with pytest.raises(UsageError, match="not attached below"):
        left.compile()


def test_text_names_what_is_there_when_the_world_is_compiled():
    top = mjcf.from_xml_string('<mujoco><actuator><motor name="m" joint="r/k"/></actuator></mujoco>')
    with pytest.raises(ValueError, match="r/k"):
        top.compile()
    top.attach(robot())
    model = top.compile()
    assert model.actuator("m").trnid[0] == model.joint("r/k").id
    site = robot().find("site", "s")
    with pytest.raises(AttributeError, match="pos"):
        site.xpos = [0, 0, 1]  # derived
    with pytest.raises(AttributeError, match="rgba"):
        _ = site.rgbaa


def named(elements):
    return [e.name for e in elements]


SAME = {
    "by name and number": lambda m: [m.worldbody.body["c"].name, m.worldbody.body[-1].name, len(m.worldbody.body)],
    "slices": lambda m: named(m.worldbody.body[1:]),
    "deleting by number": lambda m: [m.worldbody.body.__delitem__(0), named(m.worldbody.body)],
    "deleting by name": lambda m: [m.worldbody.body.__delitem__("c"), named(m.worldbody.body)],
    "clearing": lambda m: [m.worldbody.body.clear(), named(m.find_all("body"))],
    "deleting an attribute": lambda m: [delattr(m.find("geom", "g"), "size"), m.find("geom", "g").size],
    "numbers as text": lambda m: [setattr(m.find("geom", "g"), "pos", "1 2 3"), m.find("geom", "g").pos.tolist()],
    "one number for many": lambda m: [setattr(m.find("geom", "g"), "size", 0.5), m.find("geom", "g").size.tolist()],
    "moving a child": lambda m: [m.worldbody.insert("body", 0, name="first"), named(m.worldbody.body)][1:],
    "whole frames": lambda m: m.attach(m.__class__(model="x")).full_identifier,
}
REFUSED = {
    "a slash in a name": lambda m, kit: m.worldbody.add("body", name="a/b"),
    "the world's name": lambda m, kit: m.worldbody.add("body", name="world"),
    "a name that is taken": lambda m, kit: m.worldbody.add("body", name="b"),
    "an unknown child": lambda m, kit: m.worldbody.add("bodies"),
    "an unknown list": lambda m, kit: m.worldbody.get_children("bodies"),
    "a child of a frame": lambda m, kit: m.attach(m.__class__(model="x")).add("geom", size=[0.1]),
    "a second of what is there once": lambda m, kit: (
        m.find("body", "b").add("inertial") and m.find("body", "b").add("inertial")
    ),
    "no kind": lambda m, kit: m.find("thing", "b"),
    "no name": lambda m, kit: m.find("body", 3),
    "a number that is not there": lambda m, kit: m.worldbody.body[7],
    "a list's deletion": lambda m, kit: delattr(m.worldbody, "body"),
    "an unknown attribute's deletion": lambda m, kit: delattr(m.find("geom", "g"), "colour"),
    "detaching the top": lambda m, kit: m.detach(),
    "attaching to a body": lambda m, kit: m.find("body", "b").attach(m.__class__(model="x")),
    "two dimensions": lambda m, kit: setattr(m.find("geom", "g"), "pos", [[1, 2, 3]]),
    "too many numbers": lambda m, kit: setattr(m.find("geom", "g"), "pos", [1, 2, 3, 4]),
    "no number": lambda m, kit: setattr(m.find("geom", "g"), "mass", "heavy"),
    "an element for a number": lambda m, kit: setattr(m.find("geom", "g"), "mass", m.find("body", "b")),
    "an element of another kind": lambda m, kit: m.actuator.add("motor", joint=m.find("body", "b")),
    "a number for an element": lambda m, kit: m.actuator.add("motor", joint=3),
    "no XML": lambda m, kit: kit.mjcf.from_xml_string("<mujoco"),
    "another document": lambda m, kit: kit.mjcf.from_xml_string("<robot/>"),
    "a document's unknown child": lambda m, kit: kit.mjcf.from_xml_string("<mujoco><bodies/></mujoco>"),
    "no file": lambda m, kit: kit.mjcf.from_path("nowhere.xml"),
}


def test_elements_are_read_and_changed_as_in_dm_control(oracle, ours):
    for name, program in SAME.items():
        assert program(robot()) == program(oracle.mjcf.from_xml_string(ROBOT.format(inside="", beside=""))), name
    with pytest.raises(UsageError, match="contains '/'"):
        robot().model = "a/b"  # which dm_control finds out later


@pytest.mark.parametrize("program", REFUSED.values(), ids=REFUSED)
def test_what_dm_control_refuses_is_refused_in_words(oracle, ours, program):
    with pytest.raises(Exception):  # noqa: B017, PT011 - of any type
        program(oracle.mjcf.from_xml_string(ROBOT.format(inside="", beside="")), oracle)
    with pytest.raises((Sim2RealError, AttributeError, KeyError, IndexError)):
        program(robot(), ours)


# -- settings of several models


def test_settings_are_those_of_the_whole_world(oracle):
    """The top's, those that it takes over, those set later by any model; a model that is detached keeps them."""
    found = []
    for lib in (mjcf, oracle.mjcf):
        top, part, other = (lib.RootElement(model=name) for name in ("top", "part", "other"))
        top.option.density, part.option.viscosity, part.option.timestep = 3.0, 2.0, 0.01
        part.option.iterations, top.option.flag.gravity = 7, "enable"
        top.attach(part)
        seen = [top.option.viscosity, part.option.density, top.option.timestep]
        part.option.gravity = [0, 0, -3]
        top.option.flag.contact = "disable"
        seen += [top.option.gravity[2], part.option.flag.contact, top.to_xml_string().count("gravity=")]
        other.option.flag.gravity = "disable"
        with pytest.raises(ValueError, match="Conflicting values for attribute `gravity`"):
            top.attach(other)
        part.detach()
        seen += [top.option.gravity[2], part.option.gravity[2], part.option.density]
        part.option.density = 5.0
        seen += [top.option.density, len(top.find_all("attachment_frame"))]
        found.append(seen)
    assert found[0][:-1] == found[1][:-1]


def test_units_travel_with_the_model(caplog):
    part = """<mujoco model="p"><!-- <compiler angle="radian"/> -->
      <default><joint range="-9 9" limited="true"/></default>
      <worldbody><body euler="0 90 0"><joint name="h"/><joint name="s" type="slide"/><geom size=".1"/>
        <site axisangle="0 1 0 90"/></body></worldbody></mujoco>"""
    world = composer.Arena().mjcf_model
    world.attach(mjcf.from_xml_string(part))
    model = world.compile()
    assert model.jnt_range[:, 1].tolist() == pytest.approx([np.radians(9), 9.0])
    np.testing.assert_allclose(model.body_quat[model.jnt_bodyid[0]], [0.5**0.5, 0, 0.5**0.5, 0], atol=1e-12)
    np.testing.assert_allclose(model.site_quat[0], [0.5**0.5, 0, 0.5**0.5, 0], atol=1e-12)
    assert "unit" in caplog.text
    caplog.clear()
    told = mjcf.from_xml_string(part)
    told.compiler.angle = "radian"
    world = composer.Arena().mjcf_model
    world.attach(told)
    assert world.compile().jnt_range[0, 1] == 9.0
    assert not caplog.text


@pytest.mark.parametrize(
    ("when", "physics", "steps"), [("before", 0.0005, 40), ("only control", 0.0005, 40), ("after", 0.002, 10)]
)
def test_a_task_knows_the_timestep_of_the_world(oracle, ours, when, physics, steps):
    """The smallest timestep holds, unless one is set once all models are attached; as in dm_control."""
    for kit in (oracle, ours):
        arena = kit.composer.Arena()
        task = kit.composer.NullTask(arena)
        if when == "before":
            task.set_timesteps(0.02, 0.002)
        part = kit.mjcf.from_xml_string('<mujoco><option timestep="0.0005"/></mujoco>')
        arena.attach(kit.composer.ModelWrapperEntity(part))
        if when == "after":
            task.set_timesteps(0.02, 0.002)
        task.control_timestep = 0.02
        env = kit.composer.Environment(task)
        env.reset()
        env.step([])
        assert task.physics_timestep == env.physics.timestep() == physics
        assert task.physics_steps_per_control_step == steps
        assert env.physics.time() == pytest.approx(0.02)


# -- keyframes


def keyed(attach_first, **values):
    world = mjcf.from_xml_string("""<mujoco model="w"><worldbody><body name="o" mocap="true"><geom size=".1"/></body>
      <body pos="0 0 3"><joint name="oj"/><geom size=".1"/></body></worldbody></mujoco>""")
    part = robot(beside='<actuator><motor joint="k"/></actuator>')
    if attach_first:
        world.attach(part)
    world.keyframe.add("key", name="home", **values)
    if not attach_first:
        world.attach(part)
    return mjcf.Physics.from_mjcf_model(world).model


@pytest.mark.parametrize("attach_first", [True, False])
def test_a_keyframe_of_the_whole_world_sets_all_models(attach_first):
    model = keyed(attach_first, qpos=[0.5, 0.1, 0.2], ctrl=[0.7], mpos=[1, 2, 3])
    assert (model.key_qpos.tolist(), model.key_ctrl.tolist()) == ([[0.5, 0.1, 0.2]], [[0.7]])
    assert model.key_mpos.ravel().tolist() == [1, 2, 3]
    assert keyed(attach_first, qpos=[0.5]).key_qpos.tolist() == [[0.5, 0, 0]]
    with pytest.raises(UsageError, match="has 2 values for qpos, its model has 1, and 3 with the attached ones"):
        keyed(attach_first, qpos=[0.5, 0.1])


WITH_STATES = """<mujoco model="r"><worldbody>
  <body name="a"><joint name="slide" type="slide"/><joint name="ball" type="ball"/><geom size=".1"/>
    <body name="b"><joint name="hinge"/><geom size=".1"/></body></body>{body}</worldbody>
  <actuator><intvelocity name="i" joint="hinge" actrange="-1 1"/><motor name="u" joint="slide"/>
    <general name="f" joint="hinge" dyntype="filter" dynprm="1"/><cylinder name="c" joint="slide"/></actuator>
  <keyframe><key name="home" qpos=".1 .5 .5 .5 -.5 .2" qvel="1 2 3 4 5" act=".3 .4 .6" ctrl="6 7 8 9" {pose}/>
  </keyframe></mujoco>"""
MOCAP = {"body": '<body name="m" mocap="true"/>', "pose": 'mpos="1 2 3" mquat="0 1 0 0"'}
ROWS = {
    "qpos": ("joint", ("slide", "ball", "hinge")), "qvel": ("joint", ("slide", "ball", "hinge")),
    "act": ("actuator", "ifc"), "ctrl": ("actuator", "iufc"), "mpos": ("body", "m"), "mquat": ("body", "m"),
}  # fmt: skip


def numbers_of_a_keyframe(model, prefix=""):
    """Return what the first keyframe says of each element of the model above."""
    found = {}
    for field, (kind, called) in ROWS.items():
        for name in called if kind != "body" or model.nmocap else ():
            number = getattr(model, kind)(prefix + name).id
            begin, width = {
                "qpos": lambda n: (model.jnt_qposadr[n], (7, 4, 1, 1)[model.jnt_type[n]]),
                "qvel": lambda n: (model.jnt_dofadr[n], (6, 3, 1, 1)[model.jnt_type[n]]),
                "act": lambda n: (model.actuator_actadr[n], 1),
                "ctrl": lambda n: (model.actuator_ctrladr[n], 1),
                "mpos": lambda n: (3 * model.body_mocapid[n], 3),
                "mquat": lambda n: (4 * model.body_mocapid[n], 4),
            }[field](number)
            found[field, name] = getattr(model, f"key_{field}")[0].ravel()[begin : begin + width].tolist()
    return found


@pytest.mark.parametrize("moved", ["", "actuators", "attached", "behind another"])
def test_numbers_of_a_keyframe_stay_with_elements_that_move(moved):
    mocap = {} if moved.startswith(("attached", "behind")) else MOCAP  # such a body stands in the world only
    text = WITH_STATES.format(**(dict.fromkeys(MOCAP, "") | mocap))
    part, alone = mjcf.from_xml_string(text), mujoco.MjModel.from_xml_string(text)
    if moved == "actuators":
        part.find("actuator", "i").remove()
        part.actuator.add("intvelocity", name="i", joint="hinge", actrange=[-1, 1])
        part.find("actuator", "u").remove()
        part.actuator.insert("motor", 0, name="u", joint="slide")
    elif moved == "attached":
        composer.Arena().mjcf_model.attach(part).add("freejoint")
    elif moved == "behind another":
        other = mjcf.from_xml_string(text.replace('model="r"', 'model="first"'))
        other.find("key", "home").remove()
        for model in (other, part):
            (other if model is part else mjcf.RootElement(model="w")).attach(model)
    prefix = {"attached": "r/", "behind another": "first/r/"}.get(moved, "")
    model = part.root_model.compile()
    assert model.nkey == 1
    assert numbers_of_a_keyframe(model, prefix) == numbers_of_a_keyframe(alone)
    if moved == "behind another":
        assert model.key_qpos[0, :6].tolist() == model.qpos0[:6].tolist()


# -- what only documents can hold, and files


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ('<worldbody><replicate count="3" offset="1 0 0"><body name="n"><joint/><geom size=".1"/></body></replicate>'
         "</worldbody>", 3),
        ('<worldbody><frame pos="0 0 1"><body name="m"><geom size=".1"/></body></frame></worldbody>', 1),
        ('<deformable><flex name="f" dim="1" body="b b" vertex="0 0 0 0 0 1" element="0 1"/></deformable>', 0),
        ('<worldbody><body><composite type="cable" curve="s" count="4 1 1" size="1" initial="none"><geom '
         'type="capsule" size=".01"/><joint kind="main"/></composite></body></worldbody>', 4),
    ],
)  # fmt: skip
def test_what_only_documents_can_hold_is_attached_with_them(text, count):
    top = mjcf.RootElement(model="w")
    for _ in range(2):
        top.attach(robot(beside=text))
    assert robot(beside=text).compile().nbody == 3 + count
    model = top.compile()
    assert model.nbody == 1 + 2 * (3 + count)
    assert all(name.startswith(("r/", "r_1/")) for name in names(model)["body"][1:])
    assert model.nflex in (0, 2)


def test_a_model_with_a_free_joint_of_its_own_keeps_it():
    text = '<mujoco model="drone"><worldbody><body name="hull" pos="0 0 1"><freejoint/><geom size=".1"/></body>'
    drone, arena = mjcf.from_xml_string(f"{text}</worldbody></mujoco>"), composer.Arena()
    entity = composer.ModelWrapperEntity(drone)
    arena.attach(entity)
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    entity.set_pose(physics, position=[1.0, 0, 2])
    np.testing.assert_array_equal(physics.bind(drone.find("body", "hull")).xpos, [1, 0, 2])
    entity.detach()
    arena.mjcf_model.worldbody.add("body").add("site", name="s").attach(drone)
    with pytest.raises(UsageError, match="only be attached to the world"):
        arena.mjcf_model.compile()


def test_files_are_collected_and_written(tmp_path):
    mesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tip.obj").write_text(mesh)
    (tmp_path / "part.xml").write_text('<mujoco><asset><mesh file="tip.obj"/></asset></mujoco>')
    (tmp_path / "arm.xml").write_text(
        '<mujoco model="arm"><compiler meshdir="meshes"/><include file="part.xml"/>'
        '<worldbody><geom name="tip" type="mesh" mesh="tip"/></worldbody></mujoco>'
    )
    root, arm = mjcf.RootElement(model="root"), mjcf.from_path(tmp_path / "arm.xml")
    root.attach(arm)
    arm.asset.add("mesh", name="twin", file=mjcf.Asset(arm.find("mesh", "tip").file.contents, ".obj"))
    assets = root.get_assets()
    assert [a.decode() for a in assets.values()] == [mesh] * 2
    assert mujoco.MjModel.from_xml_string(root.to_xml_string(), assets).nmesh == 2
    mjcf.export_with_assets(root, tmp_path / "out")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "root.xml")).nmesh == 2
    with zipfile.ZipFile(mjcf.export_with_assets_as_zip(root, tmp_path / "new")) as archive:
        archive.extractall(tmp_path)
    found = {file.name: file.read_bytes() for file in (tmp_path / "root").iterdir()}
    assert found == {file.name: file.read_bytes() for file in (tmp_path / "out").iterdir()}
    (tmp_path / "part.xml").unlink()
    with pytest.raises(UsageError, match=r"includes 'part\.xml', which does not exist"):
        mjcf.from_path(tmp_path / "arm.xml")


def test_the_bones_of_a_skin_file_get_other_names_that_mujoco_reads():
    def bone(name, vertices):
        weights = np.array(vertices, np.int32).tobytes() + np.ones(len(vertices), np.float32).tobytes()
        pose = np.array([0, 0, 0, 1, 0, 0, 0], np.float32).tobytes()
        return name.encode().ljust(40, b"\0") + pose + np.int32(len(vertices)).tobytes() + weights

    corners = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1], np.float32).tobytes()
    head = np.array([3, 3, 1, 2], np.int32).tobytes() + corners + np.arange(3, dtype=np.int32).tobytes()
    skin = renamed_skin(Asset(head + bone("one", [0, 1]) + bone("two", [2]), ".skn"), lambda name: f"robot/{name}")
    assert skin.contents == head + bone("robot/one", [0, 1]) + bone("robot/two", [2])
    bodies = "".join(f'<body name="robot/{name}"><geom size=".1"/></body>' for name in ("one", "two"))
    text = f'<mujoco><asset><skin name="s" file="s.skn"/></asset><worldbody>{bodies}</worldbody></mujoco>'
    assert mujoco.MjModel.from_xml_string(text, {"s.skn": skin.contents}).nskinbone == 2
