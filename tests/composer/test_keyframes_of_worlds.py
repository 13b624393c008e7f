"""Keyframes of a model with attached models, and references to removed elements."""

import pytest

from sim2real.composer import mjcf
from sim2real.errors import UsageError

ROBOT = """<mujoco model="r"><worldbody>
 <body name="b"><joint name="j"/><geom name="g" size=".1"/><site name="s"/>%s</body>
 <body name="c" pos="1 0 0"><joint name="k"/><geom name="h" size=".1"/><site name="z"/></body>
 <body pos="2 0 0"><joint/><geom size=".1"/></body></worldbody>%s</mujoco>"""
WORLD = """<mujoco model="w"><worldbody><body name="o" mocap="true"><geom size=".1"/></body>
 <body pos="0 0 3"><joint name="oj"/><geom size=".1"/></body></worldbody></mujoco>"""


def world(attach_first, **values):
    model, robot = mjcf.from_xml_string(WORLD), mjcf.from_xml_string(ROBOT % ("", ""))
    robot.actuator.add("motor", joint="k")
    if attach_first:
        model.attach(robot)
    model.keyframe.add("key", name="home", **values)
    if not attach_first:
        model.attach(robot)
    return mjcf.Physics.from_mjcf_model(model).model


@pytest.mark.parametrize("attach_first", [True, False])
def test_a_keyframe_of_the_whole_world_sets_all_models(attach_first):
    model = world(attach_first, qpos=[0.5, 0.1, 0.2, 0.3], ctrl=[0.7], mpos=[1, 2, 3])
    assert model.key_qpos.tolist() == [[0.5, 0.1, 0.2, 0.3]]
    assert model.key_ctrl.tolist() == [[0.7]]
    assert model.key_mpos.ravel().tolist() == [1, 2, 3]
    assert world(attach_first, qpos=[0.5]).key_qpos.tolist() == [[0.5, 0, 0, 0]]
    with pytest.raises(UsageError, match="has 2 values for qpos, its model has 1, and 4 with the attached ones"):
        world(attach_first, qpos=[0.5, 0.1])


OPTIONAL = {
    "second joint": ("", '<equality><joint joint1="j" joint2="k"/></equality>', ("joint", "k")),
    "second body": ("", '<equality><weld body1="b" body2="c"/></equality>', ("body", "c")),
    "second site": ("", '<equality><connect site1="s" site2="z"/></equality>', ("site", "z")),
    "reference site": ("", '<actuator><general site="s" refsite="z" gear="1 0 0 0 0 0"/></actuator>', ("site", "z")),
    "side site": (
        "",
        '<tendon><spatial><site site="s"/><geom geom="g" sidesite="z"/><site site="s"/></spatial></tendon>',
        ("site", "z"),
    ),
    "joint of a tendon": ("", '<tendon><fixed><joint joint="j" coef="1"/><joint joint="k" coef="1"/></fixed></tendon>',
                          ("joint", "k")),
    "frame of a sensor": (
        "",
        '<sensor><framepos objtype="site" objname="s" reftype="site" refname="z"/></sensor>',
        ("site", "z"),
    ),
    "target": ('<camera mode="targetbody" target="c"/>', "", ("body", "c")),
}  # fmt: skip


@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("reference", OPTIONAL)
def test_an_optional_reference_to_a_removed_element_is_refused(reference, attached):
    """Without its second element, an equality would hold the first one in place."""
    inside, beside, (kind, name) = OPTIONAL[reference]
    robot = mjcf.from_xml_string(ROBOT % (inside, beside))
    model = robot
    if attached:
        model = mjcf.RootElement(model="w")
        model.attach(robot)
    robot.find(kind, name).remove()
    with pytest.raises(UsageError, match=f"names the {kind} '{name}', which was removed"):
        mjcf.Physics.from_mjcf_model(model)


@pytest.mark.parametrize("attached", [False, True])
def test_numbers_of_a_keyframe_stay_with_elements_that_move(attached):
    motors = '<actuator><motor name="u" joint="j"/><motor name="v" joint="k"/></actuator>'
    robot = mjcf.from_xml_string(ROBOT % ("", f'{motors}<keyframe><key name="home" ctrl="1 2"/></keyframe>'))
    robot.find("actuator", "u").remove()
    robot.actuator.add("motor", name="u", joint="j")
    top = robot
    if attached:
        top = mjcf.from_xml_string(WORLD)
        top.attach(robot)
    model = top.compile()
    names = [model.actuator(i).name.removeprefix("r/") for i in range(2)]
    assert dict(zip(names, model.key_ctrl[0].tolist(), strict=True)) == {"u": 1.0, "v": 2.0}


def test_a_derived_attribute_is_refused_and_a_misspelt_one_names_those_that_exist():
    site = mjcf.from_xml_string(ROBOT % ("", "")).find("site", "s")
    with pytest.raises(AttributeError, match="pos"):
        site.xpos = [0, 0, 1]
    with pytest.raises(AttributeError, match="rgba"):
        _ = site.rgbaa
