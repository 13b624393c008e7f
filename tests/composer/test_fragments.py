"""Models from fragments, elements as text, and what stands in <custom>: as in dm_control."""

from xml.etree import ElementTree

import numpy as np
import pytest
from test_oracle import differing_arrays

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import Generic
from sim2real.errors import UsageError

ARM = """
<mujoco model="arm"><asset><mesh name="part" file="part.stl"/><material name="steel"/></asset>
  <worldbody><body name="b"><joint name="j"/><geom name="g" type="mesh" mesh="part" material="steel"/></body>
  </worldbody>
  <actuator><motor name="m" joint="j"/></actuator></mujoco>"""


def triangle():
    """Return a tetrahedron as a binary STL file."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], np.float32)
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    body = b"".join(np.zeros(3, np.float32).tobytes() + corners[list(f)].tobytes() + b"\0\0" for f in faces)
    return bytes(80) + np.uint32(len(faces)).tobytes() + body


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "part.stl").write_bytes(triangle())
    (tmp_path / "sub.xml").write_text('<mujoco><worldbody><geom name="extra" size=".2"/></worldbody></mujoco>')
    return tmp_path


@pytest.mark.parametrize("door", ["from_xml_string", "from_file", "from_path"])
def test_files_are_looked_for_in_a_folder(folder, door):
    text = ARM.replace("</mujoco>", '<include file="sub.xml"/></mujoco>')
    path = folder / "arm.xml"
    path.write_text(text)
    if door == "from_path":
        model = mjcf.from_path(path)
    elif door == "from_file":
        with path.open() as file:
            model = mjcf.from_file(file, model_dir=folder)
    else:
        model = mjcf.from_xml_string(text, model_dir=str(folder))
    assert model.compile().ngeom == 2
    assert len(model.get_assets()) == 1


def test_what_is_included_may_be_among_the_assets():
    text = '<mujoco><include file="nowhere/sub.xml"/></mujoco>'
    inner = b'<mujoco><worldbody><geom name="extra" size=".2"/></worldbody></mujoco>'
    assert mjcf.from_xml_string(text, assets={"nowhere/sub.xml": inner}).compile().ngeom == 1
    with pytest.raises(UsageError, match=r"includes 'nowhere/sub.xml', which is not there(.|\n)*model_dir"):
        mjcf.from_xml_string(text)


def test_references_read_as_text_until_they_are_resolved(folder):
    model = mjcf.from_xml_string(ARM, model_dir=folder, resolve_references=False)
    geom = model.find("geom", "g")
    assert (geom.material, geom.mesh, model.find("actuator", "m").joint) == ("steel", "part", "j")
    model.resolve_references()
    assert geom.material is model.find("material", "steel")
    assert model.find("actuator", "m").joint is model.find("joint", "j")


def test_contents_that_a_program_gave_keep_their_name():
    model = mjcf.RootElement()
    asset = mjcf.Asset(triangle(), ".stl")
    model.asset.add("mesh", name="part", file=asset)
    named = model.asset.add("mesh", name="other", file=mjcf.Asset(triangle() + b"", ".stl", "part"))
    assert model.get_assets().keys() == {asset.get_vfs_filename(), named.file.get_vfs_filename()}
    assert model.find("mesh", "part").file.get_vfs_filename() == asset.get_vfs_filename()


def custom(lib):
    top, part = lib.RootElement(model="w"), lib.RootElement(model="part")
    top.attach(part)
    for model in (top, part):
        body = model.worldbody.add("body", name="b")
        body.add("geom", name="g", size=[0.1])
        model.custom.add("numeric", name="n", data=[1, 2, 3])
        model.custom.add("numeric", name="sized", size=5, data=[1])
        model.custom.add("text", name="t", data='a <"&> b')
        both = model.custom.add("tuple", name="both")
        both.add("element", objtype="body", objname=body, prm=2.0)
        both.add("element", objtype="geom", objname="g")
    top.custom.tuple["both"].add("element", objtype="body", objname=body)
    return top, part


def test_custom(oracle):
    found = []
    for lib in (mjcf, oracle.mjcf):
        top, part = custom(lib)
        part.custom.numeric["n"].data = [4, 5]
        assert (part.custom.numeric["n"].data == [4, 5]).all()
        assert part.custom.text["t"].data == 'a <"&> b'
        found.append(lib.Physics.from_mjcf_model(top).model.ptr)
    assert not differing_arrays(*found)
    assert found[0].numeric("part/n").data.tolist() == [4.0, 5.0]


ROBOT = """
<mujoco model="r"><worldbody><body name="b" pos="0 0 .5"><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>
  <joint name="j" axis="0 1 0" range="-1 1"/><geom name="g" type="capsule" size=".1 .2"/><site name="s"/>
  <site name="u"/></body></worldbody>
  <tendon><spatial name="t"><site site="s"/><site site="u"/></spatial></tendon>
  <actuator><position name="m" joint="j" kp="3"/></actuator>
  <sensor><framepos name="p" objtype="site" objname="s"/></sensor></mujoco>"""


def without_classes(text):
    """Return what MJCF says, without the class of every element."""

    def read(node):
        return node.tag, {k: v for k, v in node.attrib.items() if k != "class"}, [read(child) for child in node]

    return read(ElementTree.fromstring(text))


def test_a_root_has_sections_and_a_world_directly(oracle):
    for lib in (mjcf, oracle.mjcf):
        robot = lib.from_xml_string(ROBOT)
        for kind in ("body", "geom", "joint", "actuator", "tendon"):
            assert robot.find_all(kind, immediate_children_only=True) == []
        assert [b.name for b in robot.worldbody.find_all("body", immediate_children_only=True)] == ["b"]


class Parts(composer.Observables):
    @composer.observable
    def first(this):  # noqa: N805 - any name will do
        return Generic(lambda physics: 1.0)

    @composer.observable
    def second(_):  # noqa: N805
        return Generic(lambda physics: 2.0)


class Rod(composer.ModelWrapperEntity):
    def _build_observables(self):
        return Parts(self)

    @composer.observable
    def angle(robot, physics):  # noqa: N805
        return physics.bind(robot.mjcf_model.find("joint", "j")).qpos

    @composer.observable
    def height(self, simulation, scale=2.0):
        return scale * simulation.bind(self.mjcf_model.find("body", "b")).xpos[2]


class Watch(composer.NullTask):
    @composer.observable
    def clock(task, physics):  # noqa: N805
        return np.array([physics.time()])


def test_the_first_argument_of_an_observable_may_have_any_name():
    rod = Rod(mjcf.from_xml_string(ROBOT))
    task = Watch(rod)
    for value in rod.observables.as_dict(fully_qualified=False).values():
        value.enabled = True
    step = composer.Environment(task).reset()
    assert {k: float(np.ravel(v)[0]) for k, v in step.observation.items()} == {
        "first": 1.0, "second": 2.0, "angle": 0.0, "height": 1.0, "clock": 0.0,
    }  # fmt: skip
    assert composer.observable(lambda physics: physics.time()).takes_physics
