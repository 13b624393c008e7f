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
    "xmat": [("a", "yx"), ("b", ["xx", "zz"]), ("b", [True, False] * 4 + [True]), (["a", "b"], [["xx"], ["zz"]])],
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


def change(array, index, value):
    array[index] = value


BOUND = {
    "one": lambda b: [b("geom", "g").pos, b("geom", "g")["pos", "x"], b("joint", "j").qpos, b("body", "a").mass],
    "several": lambda b: [b("geom", "gh").pos, b("geom", "gh")["pos", ["x", "z"]], b("geom", "hg")["rgba", ["a", "r"]]],
    "frames": lambda b: [
        b("body", "ab").xquat,
        b("body", "a")["xmat", "yx"],
        b("site", "s").xpos,
        b("body", "fa").xpos,
    ],
    "widths": lambda b: [b("joint", ["ball", "j"]).qpos, b("joint", ["j", "free"]).qvel, b("joint", ["ball"]).damping],
    "sensors": lambda b: [b("sensor", ["three", "one"]).sensordata, b("actuator", "u").ctrl],
    "numbers": lambda b: [b("geom", "hg").element_id, b("geom", "g").element_id],
    "nothing": lambda b: [b("geom", []).pos, b("geom", []).element_id],
    "set one": lambda b: [setattr(b("geom", "g"), "pos", [1, 2, 3]), setattr(b("joint", "j"), "qpos", 0.3)],
    "set several": lambda b: [setattr(b("geom", "gh"), "pos", 0.5), setattr(b("joint", ["ball", "j"]), "qvel", 0.1)],
    "set rows": lambda b: [setattr(b("geom", "hg"), "pos", [[1, 2, 3], [4, 5, 6]])],
    "set columns": lambda b: [
        change(b("geom", "gh"), ("pos", ["x", "z"]), 0.5),
        change(b("geom", "g"), ("pos", "y"), 7),
    ],
    "set parts": lambda b: [
        change(b("geom", "gh").pos, (slice(None), 0), 9),
        change(b("joint", ["free", "j"]).qpos, 2, 5),
    ],
    "add": lambda b: [b("geom", "gh").pos.__iadd__([0.1, 0.2, 0.3]), b("joint", ["ball", "j"]).qvel.__imul__(2.0)],
    "copies": lambda b: [b("joint", ["ball", "j"]).qpos + 1, change(b("joint", ["j"]).qpos.copy(), 0, 9)],
    "mass": lambda b: [setattr(b("body", "a"), "mass", 3.0), b("body", "abf").mass],
    "another kind": lambda b: b("geom", "g").qpos,
    "no columns": lambda b: b("geom", "g")["pos", "w"],
    "another shape": lambda b: setattr(b("geom", "gh"), "pos", [1.0, 2.0]),
    "numbers are constant": lambda b: change(b("geom", "gh").element_id, 0, 3),
    "an empty one": lambda b: setattr(b("geom", []), "pos", 1.0),
}


@pytest.mark.parametrize("program", BOUND.values(), ids=BOUND)
def test_bound_elements_are_read_and_written_as_in_dm_control(oracle, ours, program):
    found = []
    for kit in (oracle, ours):
        model = kit.mjcf.from_xml_string(MIXED)
        physics = kit.mjcf.Physics.from_mjcf_model(model)
        physics.data.qpos[:], physics.data.qvel[:] = np.linspace(0.1, 1.2, 12), np.linspace(1.0, 2.0, 10)
        physics.forward()

        def bind(kind, names, model=model, physics=physics):
            listed = [model.find(kind, name) for name in names]
            return physics.bind(listed[0] if isinstance(names, str) and len(names) == 1 else listed)

        try:
            read = [None if value is None else np.array(value).tolist() for value in program(bind)]
        except Exception:  # of any type
            read = "refused"
        physics.forward()
        state = physics.model.geom_pos, physics.model.body_mass, physics.data.qpos, physics.data.qvel, physics.data.xpos
        found.append((read, [np.array(array).tolist() for array in state]))
    assert found[1] == found[0]


def test_the_functional_view_is_the_same_physics(arm):
    model, physics = arm
    joint = model.find("joint", "shoulder")
    assert physics.set(joint, "qpos", [0.2]).write(joint, "qvel", 2.0, 0) is physics
    assert (physics.get(joint, "qpos"), physics.get(joint, "qvel")) == (0.2, 2.0)


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
