"""What elements name: held as elements, across models, through renaming, copying, detaching and deleting."""

import copy

import pytest
from mujoco import mjx
from test_oracle import differing_arrays, names

from sim2real.composer import mjcf
from sim2real.errors import UsageError

ROBOT = """
<mujoco model="r"><default><geom material="skin"/></default>
  <asset><material name="skin" rgba="1 0 0 1"/></asset>
  <worldbody><body name="b"><joint name="j"/><geom name="g" size=".1"/><site name="s"/>
    <body name="c" pos="0 0 1"><joint name="k"/><geom name="h" size=".1"/><site name="u"/></body></body>
    <camera name="cam" mode="targetbody" target="c"/></worldbody>
  <contact><pair name="pair" geom1="g" geom2="h"/><exclude name="apart" body1="b" body2="c"/></contact>
  <tendon><fixed name="t"><joint joint="j" coef="1"/><joint joint="k" coef="2"/></fixed>
    <spatial name="line"><site site="s"/><geom geom="g" sidesite="u"/><site site="u"/><pulley divisor="2"/>
      <site site="s"/><site site="u"/></spatial></tendon>
  <equality><joint name="same" joint1="j" joint2="k"/><weld name="weld" body1="b" body2="c"/></equality>
  <actuator><motor name="m" joint="k"/><motor name="pull" tendon="t"/></actuator>
  <sensor><jointpos name="angle" joint="k"/><actuatorfrc name="force" actuator="pull"/>
    <framepos name="place" objtype="body" objname="b" reftype="site" refname="u"/></sensor>
  <custom><tuple name="both"><element objtype="joint" objname="j"/><element objtype="body" objname="c"/></tuple>
  </custom>
</mujoco>
"""


def world(lib):
    """Return a world of two equal robots and what names their elements in all directions."""
    top = lib.RootElement(model="w")
    left, right = lib.from_xml_string(ROBOT), lib.from_xml_string(ROBOT)
    top.attach(left).pos = [1, 0, 0]
    top.attach(right)
    tie = top.tendon.add("spatial", name="tie", stiffness=3.0)
    tie.add("site", site=left.find("site", "u"))
    tie.add("site", site=right.find("site", "s"))
    gear = left.tendon.add("fixed", name="gear")
    gear.add("joint", joint=right.find("joint", "k"), coef=2.0)
    gear.add("joint", joint=left.find("joint", "k"), coef=1.0)
    right.actuator.add("motor", name="drive", tendon=gear)
    right.sensor.add("tendonpos", name="length", tendon=tie)
    right.equality.add("tendon", name="lock", tendon1=tie, tendon2=left.find("tendon", "line"))
    return top, left, right


def compiled(lib, top):
    """Return the ``MjModel`` of a world."""
    return lib.Physics.from_mjcf_model(top).model.ptr


def assert_equal(mine, theirs):
    assert names(mine) == names(theirs)
    assert not differing_arrays(mine, theirs)


CHANGES = {
    "nothing": lambda top, left, right: None,
    "renamed": lambda top, left, right: [
        setattr(e, "name", f"{e.name}_new") for m in (left, right)
        for kind in ("body", "joint", "geom", "site", "tendon", "actuator", "material")
        for e in m.find_all(kind, exclude_attachments=True) if e.name
    ],
    "renamed to the other's names": lambda top, left, right: [
        (setattr(m.find("site", "s"), "name", "x"), setattr(m.find("site", "u"), "name", "s"),
         setattr(m.find("site", "x"), "name", "u")) for m in (left, right)
    ],
    "models renamed": lambda top, left, right: (setattr(right, "model", "x"), setattr(left, "model", "r_1")),
    "tendon removed": lambda top, left, right: (
        right.find("equality", "lock").remove(), right.find("sensor", "length").remove(),
        top.find("tendon", "tie").remove(),
    ),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_changed_worlds_are_those_of_dm_control(oracle, change):
    found = []
    for lib in (mjcf, oracle.mjcf):
        models = world(lib)
        CHANGES[change](*models)
        found.append(compiled(lib, models[0]))
    assert_equal(*found)


def test_tendons_across_models_are_there_on_mjx():
    model = mjx.put_model(world(mjcf)[0].compile())
    assert (model.ntendon, model.nu, model.nsensor, model.neq) == (6, 5, 7, 5)


def test_a_copy_names_its_own_elements():
    top, *_ = world(mjcf)
    twin = copy.deepcopy(top)
    assert_equal(twin.compile(), top.compile())
    twin.find("attached_model", "r").find("joint", "k").name = "x"
    assert_equal(top.compile(), world(mjcf)[0].compile())
    assert "r/x" in names(twin.compile())["joint"]


def test_text_names_elements_of_models_that_are_attached_later(oracle):
    text = """<mujoco model="w"><actuator><motor name="m" joint="r/k"/></actuator>
      <tendon><spatial name="t"><site site="r/s"/><site site="r/u"/></spatial></tendon></mujoco>"""
    found = []
    for lib in (mjcf, oracle.mjcf):
        top, robot = lib.from_xml_string(text), lib.from_xml_string(ROBOT)
        top.attach(robot)
        found.append(compiled(lib, top))
    assert_equal(*found)


@pytest.mark.parametrize("order", [("reftype", "refname"), ("refname", "reftype")])
def test_references_are_set_one_after_the_other(oracle, order):
    found = []
    for lib in (mjcf, oracle.mjcf):
        top, left, right = world(lib)
        motor = top.actuator.add("motor", name="m", joint=left.find("joint", "j"))
        motor.joint = right.find("joint", "k")
        same = top.equality.add("joint", name="e", joint1=left.find("joint", "j"))
        same.joint2 = right.find("joint", "j")
        place = top.sensor.add("framepos", name="p", objtype="site", objname=left.find("site", "s"))
        for name in order if lib is mjcf else ("reftype", "refname"):
            setattr(place, name, {"reftype": "body", "refname": right.find("body", "c")}[name])
        found.append(compiled(lib, top))
    assert_equal(*found)


SERVOS = ROBOT.replace('<motor name="m" joint="k"/>', '<position name="m" joint="k" kp="3"/>')


@pytest.mark.parametrize("copied", [False, True])
def test_an_element_that_is_laid_down_anew_names_what_it_named(oracle, copied):
    found = []
    for lib in (mjcf, oracle.mjcf):
        robot = lib.from_xml_string(SERVOS)
        j, k = robot.find("joint", "j"), robot.find("joint", "k")
        j.name, k.name, j.name = "x", "j", "k"
        robot = copy.deepcopy(robot) if copied else robot
        robot.find("actuator", "m").kp = 5
        robot.find("sensor", "place").reftype = "xbody"
        robot.find("sensor", "place").refname = robot.find("body", "c")
        top = lib.RootElement(model="w")
        top.attach(robot)
        found.append(compiled(lib, top))
    assert_equal(*found)


REMOVED = [
    ("joint", "k", "joint 'k'"), ("geom", "h", "geom 'h'"), ("site", "u", "site 'u'"), ("tendon", "t", "tendon 't'"),
    ("body", "c", "geom 'h'"), ("actuator", "pull", "actuator 'pull'"),
]  # fmt: skip


@pytest.mark.parametrize("attached", [False, True])
@pytest.mark.parametrize(("kind", "name", "what"), REMOVED)
def test_deleting_an_element_deletes_nothing_that_names_it(kind, name, what, attached):
    robot = mjcf.from_xml_string(ROBOT)
    top = robot
    if attached:
        top = mjcf.RootElement(model="w")
        top.attach(robot)
    kinds = ("tendon", "actuator", "sensor", "equality", "pair", "exclude", "tuple")
    before = {k: len(robot.find_all(k)) for k in kinds}
    robot.find(kind, name).remove()
    after = {k: len(robot.find_all(k)) for k in kinds}
    assert after == before | ({kind: before[kind] - 1} if kind in before else {})
    with pytest.raises(UsageError, match=f"names the {what}, which was removed"):
        top.compile()


def test_what_an_element_can_do_without_is_no_error(oracle):
    found = []
    for lib in (mjcf, oracle.mjcf):
        robot = lib.from_xml_string(
            ROBOT.replace('<geom material="skin"/>', "").replace('name="g"', 'name="g" material="skin"')
        )
        robot.find("material", "skin").remove()
        assert robot.find("geom", "g").material is None
        found.append(compiled(lib, robot))
    assert_equal(*found)


def test_references_read_as_the_elements_that_they_name():
    robot = mjcf.from_xml_string(ROBOT)
    k, pull, c = robot.find("joint", "k"), robot.find("actuator", "pull"), robot.find("body", "c")
    for _ in range(2):
        assert robot.find("actuator", "m").joint is k
        assert robot.find("sensor", "force").actuator is pull
        assert robot.find("sensor", "place").refname is robot.find_all("site")[1]
        assert robot.find("equality", "same").joint2 is k
        assert robot.find("exclude", "apart").body2 is c
        assert robot.find("camera", "cam").target is c
        k.name, pull.name, c.name, robot.find_all("site")[1].name = "k2", "pull2", "c2", "u2"
    k.remove()
    assert robot.find("actuator", "m").joint is None


DOCUMENTS = {
    "skin": """<asset><skin name="skin" face="0 1 2" vertex="0 0 0 1 0 0 0 1 0"><bone body="b" bindpos="0 0 0"
        bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin></asset>""",
    "flex": """<deformable><flex name="flex" dim="1" body="b b" vertex="0 0 0 0 0 1" element="0 1"/></deformable>""",
    "flexcomp": """<worldbody><body name="host"><flexcomp name="f" type="grid" count="2 2 1" spacing=".1 .1 .1" dim="2"
        mass="1" rigid="true"/></body></worldbody>""",
    "replicate": """<worldbody><replicate count="3" offset="1 0 0"><body name="n"><freejoint/><geom size=".1"/></body>
        </replicate></worldbody>""",
}  # fmt: skip
