"""Composing loses no element, and every element names its own, for all that MuJoCo's schema lets name another one."""

import re

import pytest
from random_models import differing_arrays, names

from sim2real.composer import mjcf
from sim2real.composer.mjcf import schema

NAMING = re.compile(
    r"(body|geom|joint|site|tendon|actuator|camera|flex|mesh|material|hfield|texture|target|subtree|node)[12]?"
    r"|jointinparent|refsite|cranksite|slidersite|sidesite|objname|refname|instance"
)
"""Attributes that name an element, in all of MuJoCo's schema."""
DOCUMENTS_ONLY = {
    ("asset", "skin"), ("asset", "skin", "bone"), ("deformable", "skin"), ("deformable", "skin", "bone"),
    ("deformable", "flex"), ("body", "flexcomp"), ("body", "composite", "skin"), ("body", "composite", "geom"),
    ("body", "composite", "site"), ("equality", "flex"), ("equality", "flexvert"), ("equality", "flexstrain"),
    ("asset", "material", "layer"), ("body", "attach"), ("custom", "tuple", "element"),
}  # fmt: skip
"""What programs cannot add (a row of "Differences from dm_control")."""
TARGETS = {
    "target": "body", "subtree": "body", "jointinparent": "joint", "refsite": "site", "cranksite": "site",
    "slidersite": "site", "sidesite": "site", "objname": "body", "refname": "body",
}  # fmt: skip
"""Attribute -> the kind of element that these tests let it name; others are called like it."""
PART = """
<mujoco model="r"><asset><texture name="own" type="2d" builtin="flat" width="2" height="2"/>
  <texture name="texture" type="2d" builtin="flat" width="2" height="2"/>
  <material name="own"/><material name="material" rgba="1 0 0 1"/>
  <mesh name="own" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/><mesh name="mesh" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
  <hfield name="hfield" nrow="2" ncol="2" size="1 1 1 1"/></asset>
  <worldbody><site name="first"/><camera name="own"/>
    <body name="own"><joint name="own"/><geom name="own" size=".1"/><site name="own" pos="0 0 1"/>
      <body name="ball"><joint name="ball" type="ball"/><geom size=".1"/></body></body>
    <body name="body"><joint name="joint" range="-1 1" limited="true"/><geom name="geom" size=".1"/>
      <site name="site" pos="0 0 2"/><camera name="camera"/>
      <body name="under" pos="0 0 1"><joint name="zero"/><geom size=".1"/></body></body></worldbody>
  <tendon><fixed name="own"><joint joint="own" coef="1"/></fixed>
    <fixed name="tendon" range="-1 1" limited="true"><joint joint="joint" coef="2"/></fixed></tendon>
  <actuator><motor name="own" joint="own"/><motor name="actuator" joint="joint"/></actuator>
</mujoco>"""
"""Models have elements of the same names: ``own`` is named by elements of its model, the others by those of any."""


def tables():
    """Return path of tags, such as ``("actuator", "motor")`` -> names of attributes."""
    found = {}

    def visit(spec, path):
        found[path] = spec.attributes
        for tag, child in spec.children.items():
            if tag not in ("body", "frame", "replicate") or not path:
                visit(child, (*path, tag))

    top = schema.root()
    for tag, section in top.children.items():
        if tag not in ("default", "worldbody"):
            visit(section, (tag,))
    visit(top.children["worldbody"].children["body"], ("body",))
    return found


def rows():
    """Yield section or ``body``, tag, and the attribute that names an element."""
    for path, attributes in tables().items():
        if not path or path[0] in ("default", "visual") or path in DOCUMENTS_ONLY or "plugin" in path:
            continue
        for name in sorted(n for n in attributes if NAMING.fullmatch(n)):
            yield *path, name


ROWS = list(rows())


def beside(path, attribute, own):
    """Return what else an element needs, given a function from kind and name to its own model's elements."""
    section, tag = path[:2]
    kind, number = target_kind(attribute), attribute[-1]
    other = {"1": attribute[:-1] + "2", "2": attribute[:-1] + "1"}.get(number, "")
    found = dict(OF_TAGS.get(tag, {})) | OF_ATTRIBUTES.get((tag, attribute), {})
    if section == "actuator":
        sites = {"refsite": "site", "cranksite": "slidersite", "slidersite": "cranksite"}
        if attribute in sites:
            found[sites[attribute]] = own("site")
            found |= {} if attribute == "refsite" else {"cranklength": 1.0}
        elif (tag, attribute) == ("orientation", "site"):
            found["refsite"] = own("site")
    elif section == "contact" or tag in OF_PAIRS or (section == "equality" and (number == "2" or kind == "site")):
        found[other] = own(kind)
    elif (tag, number) == ("contact", "2"):
        found["geom1"] = own("geom")
    for key, also in NEEDED.get((tag, attribute), {}).items():
        found[key] = own(also)
    return found


OF_PAIRS = ("distance", "normal", "fromto")
OF_TAGS = {
    "mesh": {"vertex": [0, 0, 0, 0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1]}, "cylinder": {"diameter": 1.0},
    "adhesion": {"ctrlrange": [0, 1], "gain": 1.0}, "intvelocity": {"actrange": [-1, 1]},
    "damper": {"ctrlrange": [0, 1]},
    "muscle": {"lengthrange": [0.1, 1.0]}, "dcmotor": {"motorconst": [0.1, 0.1], "resistance": 1.0},
    "distance": {"cutoff": 1.0}, "user": {"dim": 1, "needstage": "pos"},
}  # fmt: skip
"""What elements of a tag need, whatever they name."""
OF_ATTRIBUTES = {
    **{(tag, "target"): {"mode": "targetbody"} for tag in ("camera", "light")},
    **{("geom", name): {"type": name} for name in ("mesh", "hfield")},
    **{(tag, "objname"): {"objtype": "body"} for *_, tag, name in ROWS if name == "objname"},
    **{(tag, "refname"): {"objtype": "body", "reftype": "body"} for *_, tag, name in ROWS if name == "refname"},
    ("geom", "material"): {"size": [0.1]}, ("site", "mesh"): {"type": "mesh"}, ("light", "texture"): {"type": "image"},
    ("insidesite", "site"): {"objtype": "body"},
    ("connect", "body1"): {"anchor": [0, 0, 0]}, ("connect", "body2"): {"anchor": [0, 0, 0]},
}  # fmt: skip
"""What elements of a tag need to name another one."""
NEEDED = {
    **{(tag, "refname"): {"objname": "body"} for *_, tag, name in ROWS if name == "refname"},
    ("camprojection", "camera"): {"site": "site"}, ("camprojection", "site"): {"camera": "camera"},
    ("insidesite", "objname"): {"site": "site"}, ("insidesite", "site"): {"objname": "body"},
    ("tactile", "mesh"): {"geom": "geom"}, ("tactile", "geom"): {"mesh": "mesh"},
}  # fmt: skip
"""Which of its own model's elements it needs to name besides."""


def target_kind(attribute):
    return TARGETS.get(attribute, TARGETS.get(attribute.rstrip("12"), attribute.rstrip("12")))


def target_name(row):
    """Return the name of what the element of a row names."""
    return "ball" if target_kind(row[-1]) == "joint" and row[1] in OF_BALLS else target_kind(row[-1])


OF_BALLS = ("ballquat", "ballangvel", "orientation")


def add(row, owner, target, name):
    """Add an element to a model that names one of another model."""
    *path, attribute = row
    named = target.find(target_kind(attribute), target_name(row))

    def own(kind):
        return owner.find(kind, "own")

    if path[0] != "tendon":
        holder = owner.find("body", "body") if path[0] == "body" else getattr(owner, path[0])
        holder.add(path[1], **{"name": name, **beside(path, attribute, own), attribute: named})
        return
    tendon = owner.tendon.add(path[1], name=name, **({attribute: named} if len(path) == 2 else {}))
    if path[1] == "fixed":
        tendon.add("joint", joint=named, coef=2.0)
        tendon.add("joint", joint=owner.find("joint", "zero"), coef=1.0)
        return
    tendon.add("site", site=named if path[-1] == "site" else owner.find("site", "first"))
    if path[-1] == "geom":
        tendon.add("geom", **{"geom": own("geom"), attribute: named})
    tendon.add("site", site=own("site"))


def world(lib, row):
    """Return four models of a world that have elements of the same names, and whose elements name one another's."""
    top = lib.from_xml_string(PART.replace('model="r"', 'model="w"'))
    left, right, inner = (lib.from_xml_string(PART) for _ in range(3))
    top.attach(left)
    top.attach(right)
    left.find("body", "under").add("site", name="here")
    left.find("site", "here").attach(inner)
    models = {"outer": top, "left": left, "right": right, "inner": inner}
    for i, (owner, target) in enumerate(RELATIONS):
        add(row, models[owner], models[target], f"new_{i}")
    return models


RELATIONS = [("outer", "inner"), ("inner", "outer"), ("left", "right"), ("right", "inner"), ("right", "right")]


def theirs_of(oracle, row):
    """Return dm_control's models of a row; None where its table of MJCF is older than MuJoCo's."""
    try:
        return world(oracle.mjcf, row)
    except AttributeError as error:
        if "is not a valid" in str(error):
            return None
        raise


FEW = {row[1] + row[-1]: row for row in ROWS if "material" not in row[-1]}
FEW = {row[0] + target_kind(row[-1]): row for row in FEW.values()}.values()
of_rows = pytest.mark.parametrize(
    "row", [r if r in FEW else pytest.param(r, marks=pytest.mark.night) for r in ROWS], ids="-".join
)


@of_rows
def test_every_reference_across_models_is_that_of_dm_control(oracle, row):
    mine = world(mjcf, row)["outer"]
    model = mine.compile()
    other = theirs_of(oracle, row)
    if other is None:
        return
    theirs = oracle.mjcf.Physics.from_mjcf_model(other["outer"]).model.ptr
    assert names(model) == names(theirs)
    assert not differing_arrays(model, theirs)
