import copy
import pickle

import mujoco
import numpy as np
import pytest
from composer_parts import ARM

from sim2real.composer import mjcf
from sim2real.errors import UsageError


@pytest.fixture
def arm():
    model = mjcf.from_xml_string(ARM)
    return model, mjcf.Physics.from_mjcf_model(model)


def test_parts_of_several_elements_are_written_through(arm):
    model, physics = arm
    joints, geoms = physics.bind(model.find_all("joint")), physics.bind(model.find_all("geom"))
    qpos = joints.qpos
    qpos[1] = 0.3
    assert physics.data.qpos.tolist() == [0, 0.3]
    geoms["pos", ["x", "z"]] = 0.5
    np.testing.assert_array_equal(physics.model.geom_pos[:, [0, 2]], np.full((4, 2), 0.5))
    geoms.pos[:, 0] *= 3
    geoms.pos[1:, 2] += [0.1, 0.2, 0.3]
    np.testing.assert_array_equal(physics.model.geom_pos[:, 0], np.full(4, 1.5))
    np.testing.assert_allclose(geoms.pos[:, 2], [0.5, 0.6, 0.7, 0.8])
    np.testing.assert_allclose(np.sort(physics.model.geom_pos[:, 2]), [0.5, 0.6, 0.7, 0.8])
    sums = joints.qpos + 1
    sums[0] = 9
    assert physics.data.qpos[0] == 0
    assert not geoms.element_id.flags.writeable
    joint = model.find("joint", "shoulder")  # the functional view is the same physics
    assert physics.set(joint, "qpos", [0.2]).write(joint, "qvel", 2.0, 0) is physics
    assert (physics.get(joint, "qpos"), physics.get(joint, "qvel")) == (0.2, 2.0)


def test_what_cannot_be_bound_is_named(arm):
    model, physics = arm
    joint = model.find("joint", "shoulder")
    with pytest.raises(UsageError, match="multiple element types: geom, joint"):
        physics.bind([joint, model.worldbody.geom[0]])
    with pytest.raises(AttributeError, match="<joint> does not have attribute 'colour'"):
        _ = physics.bind(joint).colour
    with pytest.raises(UsageError, match="the element is None"):
        physics.bind(model.find("joint", "knee"))
    late = model.worldbody.add("site", name="late")
    with pytest.raises(UsageError, match=r"no site 'late'. Available: wrist"):
        physics.bind(late)


MIXED = """
<mujoco model="m"><worldbody><body name="f" pos="0 0 1"><freejoint name="free"/>
  <geom name="g" size=".1" rgba="1 .5 .2 .7"/>
  <body name="a" pos=".1 .2 .3" euler="10 20 30"><joint name="ball" type="ball"/><geom name="h" size=".2"/>
    <body name="b" pos="0 0 .3" euler="0 40 0"><joint name="j" axis="0 1 0"/><geom size=".1"/><site name="s"/></body>
  </body></body></worldbody><actuator><motor name="u" joint="j"/></actuator>
  <sensor><jointpos name="one" joint="j"/><accelerometer name="three" site="s"/><ballquat joint="ball"/></sensor>
</mujoco>
"""
KEYS = {
    "xpos": ["a", 2, -1, ("b", "z"), (["a", "f"], "x"), (["f", "b"], ["x", "z"]), (slice(None), "y"),
             ("b", slice(1, 3)), np.ix_(["a", "f"], ["z", "x"]), np.array([3, 1]), [3, 1],
             np.array([True, False, True, False])],
    "xmat": [("a", "yx"), ("b", ["xx", "zz"])],
    "xquat": [("a", "qw"), (["a", "b"], ["qx", "qz"])],
    "qpos": ["j", "ball", "free", ["j", "free"], ("ball",)],
    "qvel": ["j", "ball", ["free", "ball"], slice(2, 5)],
    "sensordata": ["one", "three", ["three", "one"]],
    "ctrl": ["u", ["u"], 0],
    "ximat": [("b", "zz")],
}  # fmt: skip


def test_named_arrays_are_read_and_written_as_in_dm_control(oracle, ours):
    physics = [kit.mjcf.Physics.from_mjcf_model(kit.mjcf.from_xml_string(MIXED)) for kit in (oracle, ours)]
    for one in physics:
        one.data.qpos[:] = np.linspace(0.1, 1.2, one.model.nq)
        one.data.qvel[:] = np.linspace(1.0, 2.0, one.model.nv)
        one.forward()
    rgba = [np.array(one.named.model.geom_rgba[["h", "g"], ["a", "r"]]) for one in physics]
    np.testing.assert_array_equal(*rgba)
    for name, keys in KEYS.items():
        for key in keys:
            theirs, mine = (getattr(one.named.data, name) for one in physics)
            np.testing.assert_array_equal(np.array(mine[key]), np.array(theirs[key]), err_msg=f"{name}[{key}]")
            for array in (theirs, mine):
                array[key] = 0.25 + np.asarray(array[key])
            np.testing.assert_array_equal(np.array(mine), np.array(theirs), err_msg=f"{name}[{key}] = ")
    for name, key in (("xpos", "hip"), ("xpos", ("a", "w")), ("ctrl", "j"), ("nothing", 0)):
        for one in physics:
            with pytest.raises((KeyError, IndexError, AttributeError, TypeError)):
                _ = getattr(one.named.data, name)[key]


def test_named_arrays(arm):
    model, physics = arm
    data = physics.named.data
    assert data.xpos["lower", "z"] == pytest.approx(0.35)
    assert data.qpos[model.find_all("joint")].shape == (2,)
    data.qpos["shoulder"] = 0.2
    assert np.sum(data.qpos**2) == pytest.approx(0.04)
    with pytest.raises(KeyError, match=r"body 'hip' is not there. Available: world, upper, lower"):
        _ = data.xpos["hip"]


def test_names_and_numbers(arm):
    _, physics = arm
    for kind in ("body", mujoco.mjtObj.mjOBJ_BODY, 1):
        assert physics.model.name2id("upper", kind) == 1
        assert physics.model.id2name(1, kind) == "upper"
    with pytest.raises(UsageError, match=r"mjtObj 99\. Available: body"):
        physics.model.name2id("upper", 99)


def test_copies_and_states_are_independent(arm):
    _, physics = arm
    other = physics.copy()
    other.set_state([0.1, 0.2, 0.3, 0.4])
    assert other.get_state().tolist() == [0.1, 0.2, 0.3, 0.4]
    for same in (copy.deepcopy(other), pickle.loads(pickle.dumps(other))):
        assert same.get_state().tolist() == [0.1, 0.2, 0.3, 0.4]
        for one in (same, other):
            one.set_state([0.1, 0.2, 0.3, 0.4])
            one.forward()
            one.step()
        np.testing.assert_array_equal(same.get_state(), other.get_state())
        other.set_state([0.1, 0.2, 0.3, 0.4])
    assert physics.data.qpos.tolist() == [0, 0]
    with pytest.raises(UsageError, match=r"Expected \(4,\)"):
        physics.set_state([0.0])
    physics.reset(0)
    assert physics.data.qpos.tolist() == [0.5, -0.3]
    with pytest.raises(UsageError, match="must be between 0 and 0"):
        physics.reset(1)


def test_gravity_is_compensated_and_constants_are_computed_anew_without_moving_the_state():
    """Whether masses that were set by hand are seen must not depend on what is set after them."""
    text = '<mujoco><worldbody><body name="ball"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    model = mjcf.from_xml_string(text)
    physics = mjcf.Physics.from_mjcf_model(model)
    ball, before = physics.bind(model.find("body", "ball")), copy.copy(physics.model.ptr)
    ball.gravcomp = 1.0  # no body was compensated when the model was compiled
    physics.forward()
    assert abs(physics.data.qacc[2]) < 1e-12
    ball.mass = 100.0
    ball.gravcomp = 0.5
    assert physics.model.body_subtreemass[1] == before.body_subtreemass[1]
    assert physics.model.stat.meanmass == before.stat.meanmass
    assert (ball.mass, ball.gravcomp) == (100.0, 0.5)
    physics.data.qpos[2] = 0.5
    physics.forward()
    physics.recompute_constants()
    assert physics.model.body_subtreemass[1] == 100.0
    assert physics.data.xpos[1, 2] == 0.5  # what the next step starts from
