"""Composition: attach, detach, rename, references between models, options, keyframes, assets."""

import copy
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from composer_parts import ARM, HAND, prop

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.errors import UsageError

KIT = SimpleNamespace(mjcf=mjcf, composer=composer)
MESH = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def geoms(model):
    compiled = model.compile()
    return [mujoco.mj_id2name(compiled, mujoco.mjtObj.mjOBJ_GEOM, i) for i in range(compiled.ngeom)]


def test_any_order_of_attaching_and_attaching_again():
    root, arm, hand = mjcf.RootElement(model="root"), mjcf.from_xml_string(ARM), mjcf.from_xml_string(HAND)
    root.attach(arm)
    arm.find("site", "wrist").attach(hand)
    assert root.find("body", "arm/hand/finger").full_identifier == "arm/hand/finger"
    assert hand.root_model is root
    hand.detach()
    assert "arm/hand/palm" not in geoms(root)
    root.attach(hand).add("freejoint")
    physics = mjcf.Physics.from_mjcf_model(root)
    assert physics.bind(hand.find("body", "finger")).element_id == physics.model.name2id("hand/finger", "body")
    assert physics.bind(mjcf.get_frame_freejoint(hand)).qpos.shape == (7,)
    assert hand.compile().nbody == 2  # the part on its own, without the frame that held it


def test_references_to_attached_models_resolve_and_keep_their_order():
    root, arm = mjcf.RootElement(model="root"), mjcf.from_xml_string(ARM)
    root.attach(arm)
    first = root.worldbody.add("site", name="here")
    root.sensor.add("framepos", name="a", objtype="site", objname=arm.find("site", "wrist"))
    root.sensor.add("framepos", name="b", objtype="site", objname="here")
    root.sensor.add("framepos", name="c", objtype="site", objname="arm/wrist")
    arm.model = "left"
    first.name = "there"
    root.find("sensor", "b").objname = first
    root.find("sensor", "c").objname = "left/wrist"
    model = root.compile()
    named = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SENSOR, i) for i in range(model.nsensor)]
    assert named == ["a", "b", "c", "left/angle", "left//unnamed_sensor_1"]
    sites = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_SITE, i) for i in model.sensor_objid[:3]]
    assert sites == ["left/wrist", "there", "left/wrist"]


def test_a_reference_to_a_model_that_is_not_below_is_an_error():
    arm, other = mjcf.from_xml_string(ARM), prop(KIT)
    arm.equality.add("weld", body1="upper", body2=other.worldbody.add("body", name="far"))
    with pytest.raises(UsageError, match="not attached below"):
        arm.compile()


def test_units_travel_with_the_model():
    radian = mjcf.from_xml_string('<mujoco model="r"><compiler angle="radian"/></mujoco>')
    degree = mjcf.from_xml_string('<mujoco model="d"><worldbody><geom size="1" euler="90 0 0"/></worldbody></mujoco>')
    radian.attach(degree)
    np.testing.assert_allclose(radian.compile().geom_quat[0], [2**-0.5, 2**-0.5, 0, 0])


def test_keyframes_and_defaults_stay_with_their_model():
    root = mjcf.RootElement(model="root")
    root.default.geom.rgba = [0, 1, 0, 1]
    for _ in range(2):
        frame = root.attach(mjcf.from_xml_string(ARM))
        frame.add("joint", type="slide", name="rail")
    root.worldbody.add("geom", name="mine", size=[1])
    model = root.compile()
    assert [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i) for i in range(2)] == ["arm/home", "arm_1/home"]
    np.testing.assert_array_equal(model.key_qpos, [[0, 0.5, -0.3, 0, 0, 0], [0, 0, 0, 0, 0.5, -0.3]])
    assert model.geom("mine").rgba.tolist() == [0, 1, 0, 1]
    assert model.joint("arm/shoulder").damping == [0.2]
    assert model.joint("arm/rail/").damping == [0.0]


def test_meshes_come_from_files_and_from_memory(tmp_path):
    (tmp_path / "tip.obj").write_bytes(MESH)
    xml = """<mujoco model="m"><asset><mesh {}file="tip.obj"/></asset>
      <worldbody><geom type="mesh" mesh="tip"/></worldbody></mujoco>"""
    (tmp_path / "part.xml").write_text(xml.format(""), encoding="utf-8")
    root = mjcf.RootElement()
    root.attach(mjcf.from_path(tmp_path / "part.xml"))
    root.attach(mjcf.from_xml_string(xml.format('name="tip" '), assets={"tip.obj": MESH}))
    model = root.compile()
    assert [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_MESH, i) for i in range(2)] == ["m/tip", "m_1/tip"]
    with pytest.raises(UsageError, match="there is no MJCF file"):
        mjcf.from_path(tmp_path / "none.xml")


def test_a_model_with_a_free_joint_of_its_own_keeps_it():
    drone = mjcf.from_xml_string(
        """<mujoco model="drone"><worldbody><body name="hull" pos="0 0 1">
          <freejoint name="root"/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    arena, entity = composer.Arena(), composer.ModelWrapperEntity(drone)
    arena.attach(entity)
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    entity.set_pose(physics, position=[1.0, 0, 2])
    np.testing.assert_array_equal(physics.bind(drone.find("body", "hull")).xpos, [1, 0, 2])
    holder = prop(KIT, "holder")
    arena.mjcf_model.attach(holder)
    entity.detach()
    holder.worldbody.add("site", name="s").attach(drone)
    with pytest.raises(UsageError, match="only be attached to the world"):
        arena.mjcf_model.compile()


def child(option, kit=KIT):
    body = '<worldbody><body name="b"><joint name="j"/><geom size=".1" mass="1"/></body></worldbody>'
    model = kit.mjcf.from_xml_string(f'<mujoco model="arm">{option}{body}</mujoco>')
    return kit.composer.ModelWrapperEntity(model)


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
        arena.attach(child('<option timestep="0.0005"/>', kit))
        if when == "after":
            task.set_timesteps(0.02, 0.002)
        task.control_timestep = 0.02
        env = kit.composer.Environment(task)
        env.reset()
        env.step([])
        assert task.physics_timestep == env.physics.timestep() == physics
        assert task.physics_steps_per_control_step == steps
        assert env.physics.time() == pytest.approx(0.02)


def test_programs_write_angles_in_the_unit_of_the_world(oracle, ours):
    """Radians below an arena, degrees at the top; a unit of its own stays."""
    for kit in (oracle, ours):
        inner, outer = (kit.mjcf.RootElement(model=name) for name in ("inner", "outer"))
        for root in (inner, outer):
            body = root.worldbody.add("body", euler=[0, 0, 1.5])
            body.add("joint", range=[-1, 1], limited=True)
            body.add("geom", size=[0.1])
        outer.attach(inner)
        alone = kit.mjcf.Physics.from_mjcf_model(outer).model
        np.testing.assert_allclose(alone.jnt_range, np.radians([[-1, 1]] * 2))
        arena = kit.composer.Arena()
        arena.attach(kit.composer.ModelWrapperEntity(outer))
        model = kit.mjcf.Physics.from_mjcf_model(arena.mjcf_model).model
        np.testing.assert_allclose(model.jnt_range, [[-1, 1]] * 2)
        np.testing.assert_allclose(model.body_quat[-1], [np.cos(0.75), 0, 0, np.sin(0.75)])
    own = mjcf.RootElement(model="own")
    own.compiler.angle = "degree"
    own.worldbody.add("geom", size=[0.1], euler=[0, 0, 90])
    arena.mjcf_model.attach(own)
    np.testing.assert_allclose(arena.mjcf_model.compile().geom_quat[-1], [2**-0.5, 0, 0, 2**-0.5])


def test_lists_of_elements_are_alive(oracle, ours):
    for kit in (oracle, ours):
        root = kit.mjcf.RootElement()
        body = root.worldbody.add("body")
        for name in "abc":
            body.add("geom", name=name, type="sphere", size=[0.1])
        shown = body.geom
        del body.geom[0]
        del body.geom["c"]
        assert [g.name for g in shown] == ["b"]
        body.geom.clear()
        assert (len(shown), root.find_all("geom")) == (0, [])
        root.worldbody.add("site", name="s")
        root.sensor.add("gyro", site="s")
        root.sensor.all_children()[0].remove()
        assert root.sensor.all_children() == []
    model = mjcf.from_xml_string(ARM)
    model.actuator.actuator.clear()
    assert model.compile().nu == 0
    with pytest.raises(KeyError, match=r"no <body> 'hip'. Available: upper"):
        _ = model.worldbody.body["hip"]


def test_copies_are_independent():
    """With what is attached, references across models, names of unnamed elements and their order."""
    root, hand = mjcf.from_xml_string(ARM), mjcf.from_xml_string(HAND)
    root.attach(hand)
    root.option.gravity = [0, 0, -9.81]
    root.worldbody.add("geom", type="box", size=[1, 1, 1])
    root.equality.add("weld", body1="upper", body2=hand.find("body", "finger"), active="false")
    before = root.to_xml_string()
    for other in (copy.copy(root), copy.deepcopy(root)):
        assert other.to_xml_string() == before
        other.model = "other"
        other.find("body", "upper").pos = [1, 2, 3]
        other.find("attached_model", "hand").worldbody.add("geom", name="more", size=[0.1])
        other.find("attached_model", "hand").find("geom", "palm").name = "back"
        assert other.compile().geom("hand/back").id == root.compile().geom("hand/palm").id
        assert other.worldbody.geom[-1].full_identifier == "//unnamed_geom_4"
        assert other.compile().opt.gravity[2] == -9.81
    assert (root.model, root.to_xml_string()) == ("arm", before)


def test_references_across_models_may_have_names():
    root, hand = mjcf.from_xml_string(ARM), mjcf.from_xml_string(HAND)
    root.attach(hand)
    root.equality.add("weld", name="w", body1="upper", body2=hand.find("body", "finger"))
    model = root.compile()
    assert model.equality("w").obj2id == model.body("hand/finger").id


def test_a_comment_does_not_decide_the_unit(caplog):
    part = """<mujoco model="p"><!-- <compiler angle="radian"/> --><worldbody><body>
      <joint range="-90 90" limited="true"/>      <geom size=".1"/></body></worldbody></mujoco>"""
    world = composer.Arena().mjcf_model
    world.attach(mjcf.from_xml_string(part))
    assert world.compile().jnt_range[0, 1] == pytest.approx(np.pi / 2)
    assert "unit" in caplog.text


def test_classes_for_hinges_and_slides_keep_their_units_below_another_unit():
    part = """<mujoco model="p"><default><joint range="-9 9" limited="true"/></default><worldbody>
      <body euler="0 90 0"><joint name="h"/><joint name="s" type="slide"/><geom size=".1"/></body>
      </worldbody></mujoco>"""
    world = composer.Arena().mjcf_model
    world.attach(mjcf.from_xml_string(part))
    model = world.compile()
    assert model.jnt_range[:, 1].tolist() == pytest.approx([np.radians(9), 9.0])
    assert model.body("p/").id + 1 == model.jnt_bodyid[0]
    np.testing.assert_allclose(model.body_quat[model.jnt_bodyid[0]], [0.5**0.5, 0, 0.5**0.5, 0], atol=1e-12)


def test_a_copy_is_deep_and_keeps_attached_models_and_references():
    top, arm, hand = (mjcf.RootElement(model=name) for name in ("top", "arm", "hand"))
    for one in (arm, hand):
        one.worldbody.add("body", name="b").add("geom", name="g", size=[0.1])
    arm.attach(hand)
    arm.equality.add("weld", body1=arm.find("body", "b"), body2=hand.find("body", "b"))
    twin = copy.deepcopy(arm)
    twin.find("geom", "hand/g").size = [0.3]
    assert hand.find("geom", "g").size.tolist() == [0.1]
    for one in (arm, twin):
        top.attach(one)
    model = top.compile()
    assert model.neq == 2
    assert model.geom("arm_1/hand/g").size[0] == 0.3
