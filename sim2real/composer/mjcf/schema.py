"""The tags of MJCF with their attributes, as printed by MuJoCo's parser, and the types of attributes."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass, field
from typing import Any

import mujoco

mj: Any = mujoco
_INDENT = 3
_ENTRY = re.compile(r"^( *)(?:\(\w+\))?(\w+) \(([!?*R])\)\s*(.*)$")


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


@dataclass
class Spec:
    """The attributes and children that elements with a tag may have.

    Attributes:
        name: The tag.
        attributes: Names in MJCF -> their places in its own table.
        children: Tag -> its specification.
        repeated: Whether there may be several in one parent.
        implicit: Whether the element exists without being added, such as ``option`` or ``default.geom``.
        kind: Kind for ``find`` and ``find_all``: the tag, or ``actuator``, ``sensor`` and so on; '': none.
    """

    name: str
    attributes: dict[str, int]
    repeated: bool
    implicit: bool = False
    kind: str = ""
    children: dict[str, Spec] = field(default_factory=dict)

    @property
    def on_demand(self) -> bool:
        """Whether there may be at most one in a parent, which must be added."""
        return not self.repeated and not self.implicit

    @functools.cached_property
    def named_by(self) -> str:
        """The attribute with the name; '' if such elements have no names."""
        return _NAMES.get(self.name, "name" if self.kind else "")


_NAMES = {"default": "class", "composite": "prefix"}

GROUPS = ("actuator", "sensor", "tendon", "equality")
"""Sections whose elements have one kind."""
_KINDS = {
    "asset": ("mesh", "hfield", "skin", "texture", "material", "model"),
    "custom": ("numeric", "text", "tuple"), "keyframe": ("key",),
}  # fmt: skip
_TREE = ("body", "geom", "joint", "site", "camera", "light", "frame", "composite", "flexcomp")
KINDS = (
    *_TREE,
    *GROUPS,
    "contact",
    "deformable",
    "plugin",
    *(kind for kinds in _KINDS.values() for kind in kinds),
    "default",
    "attachment_frame",
)
"""Kinds for ``find_all``."""
FRAME_CHILDREN = ("joint", "freejoint", "inertial")
"""Elements that an attachment frame may have."""


@functools.cache
def root() -> Spec:
    """Return the specification of ``<mujoco>``."""
    stack: list[Spec] = []
    for line in mj.mj_printSchema(False, False).splitlines():
        entry = _ENTRY.match(line)
        if entry is None:
            _add_attributes(stack[-1], line.split())
            continue
        depth, tag = len(entry[1]) // _INDENT, entry[2]
        spec = Spec(tag, {}, entry[3] in "*R")
        _add_attributes(spec, entry[4].split())
        del stack[depth:]
        if stack:
            stack[-1].children[tag] = spec
        stack.append(spec)
    top = stack[0]
    # Bodies hold bodies; the world is the body at the top. MuJoCo's table leaves out frames and copies.
    body = top.children.pop("body")
    body.kind, body.children["body"] = "body", body
    frame, replicate = Spec("frame", {}, True, kind="frame"), Spec("replicate", {}, True)
    _add_attributes(frame, ["name", "childclass", "pos", "quat", "axisangle", "xyaxes", "zaxis", "euler"])
    _add_attributes(replicate, ["count", "offset", "euler", "sep", "childclass"])
    body.children |= {"frame": frame, "replicate": replicate}
    frame.children = replicate.children = body.children
    body.children["freejoint"].repeated = False
    for tag in ("geom", "joint", "site", "camera", "light", "composite", "flexcomp"):
        body.children[tag].kind = tag
    body.children["freejoint"].kind = "joint"
    for tag in ("geom", "site", "skin"):
        body.children["composite"].children[tag].implicit = True
    world_children = {k: v for k, v in body.children.items() if k not in ("inertial", "joint", "freejoint")}
    top.children["worldbody"] = Spec("worldbody", {}, False, True, children=world_children)
    for name, section in top.children.items():
        section.repeated, section.implicit = False, True
        for tag, child in section.children.items():
            if name in (*GROUPS, "contact", "deformable"):
                child.kind = name
            elif tag in _KINDS.get(name, ()):
                child.kind = tag
            elif name in ("compiler", "option", "visual"):
                child.implicit = True
    top.children["extension"].children["plugin"].children["instance"].kind = "plugin"
    default = top.children["default"]
    nested = Spec("default", default.attributes, True, False, "default", default.children)
    for child in default.children.values():
        child.implicit = True
    default.kind = "default"
    default.children["default"] = nested
    return top


def _add_attributes(spec: Spec, names: list[str]) -> None:
    for name in names:
        spec.attributes.setdefault(name, _FIRST.get(name, len(_FIRST) + len(spec.attributes)))


_FIRST = {"name": 0, "prefix": 0, "class": 1, "objtype": 2, "objname": 3, "reftype": 4, "refname": 5, "type": 6}
"""Positions at which PyMJCF writes some attributes."""


ARRAYS = _words(
    "act actrange actuatorfrcrange ambient anchor attenuation axis axisangle bias biasprm bindpos bindquat cell "
    "center ctrl ctrlrange damping diaginertia diffuse dir dynprm elevation euler ffrange fluidcoef focal "
    "focalpixel forcerange friction fromto fullinertia gainprm gear gravity grid gridrange id interval lengthrange "
    "magnetic markrgb mpos mquat nodecoord normal o_friction o_solimp o_solref offset origin params point polycoef "
    "pos principal principalpixel qpos quat qvel range rangefinder refpos refquat relpose rgb1 rgb2 rgba scale "
    "sectionsize sensorsize size solimp solimpfix solimpfriction solimplimit solref solreffix solreffriction "
    "solreflimit spacing specular springdamper springlength stiffness surfacevel texcoord texrepeat user velrange "
    "vertex vertweight wind xyaxes zaxis "
)
"""Attributes that read as arrays of floats."""
LENGTHS = {
    **dict.fromkeys(("pos", "euler", "zaxis", "axis", "dir", "gravity", "wind", "anchor"), 3),
    **dict.fromkeys(("quat", "axisangle", "rgba", "refquat"), 4), "xyaxes": 6, "fromto": 6, "gear": 6,
    **dict.fromkeys(("solref", "ctrlrange", "forcerange", "solreflimit", "solreffriction", "springlength",
                     "springdamper"), 2),
    **dict.fromkeys(("solimp", "solimplimit", "solimpfriction"), 5),
}  # fmt: skip
"""Largest number of entries of an attribute, if it is the same for all tags."""
INTEGER_ARRAYS = _words(
    "actuatorgroupdisable cellcount count elemtexcoord face gridsize inertiagrouprange resolution vertid "
)
INTEGERS = _words(
    "actdim activelayers cameraid ccd_iterations conaffinity condim contype dim group height iterations "
    "ls_iterations maxhullvert nchannel ncol nconmax njmax nkey noslip_iterations nrow nsample nstack num numquads "
    "numslices numstacks nuser_actuator nuser_body nuser_cam nuser_geom nuser_jnt nuser_sensor nuser_site "
    "nuser_tendon nuserdata offheight offsamples offwidth priority sdf_initpoints sdf_iterations shadowsize subgrid "
)
FLOATS = _words(
    "accel actuatorlength actuatortendon actuatorwidth adhesion alpha area armature azimuth boundinertia boundmass "
    "bulbradius ccd_tolerance coef contactheight contactwidth cranklength cutoff dampratio delay density diameter "
    "divisor emission exponent extent fitscale fogend fogstart force forcewidth fovy fpmax framelength framewidth "
    "frictionloss fvmax gain gap glow gravcomp haze impratio inertiabox inflate inheritrange intensity inttotal ipd "
    "jointlength jointwidth kp kv linewidth lmax lmin ls_tolerance margin mass maxforce meaninertia meanmass "
    "meansize metallic noise noslip_tolerance o_margin poisson prm radius random realtime ref reflectance roughness "
    "settotalmass shadowclip shadowscale shininess sleep_tolerance softness solmix springref stiffnessrot tausmooth "
    "thickness time timeconst timestep tolerance tolrange torque torquescale viscosity vmax width young zfar znear "
)
_OTHERWISE = {
    ("option.flag", "*"): "text", ("visual.scale", "*"): "float", ("visual.rgba", "*"): "array",
    ("visual.map", "stiffness"): "float", ("visual.global", "bvactive"): "text", ("visual.headlight", "active"): "int",
    ("muscle", "timeconst"): "array", ("muscle", "scale"): "float", ("material", "specular"): "float",
    ("light", "range"): "float", ("texture", "width"): "int", ("numeric", "size"): "int", ("numeric", "data"): "array",
    ("lengthrange", "interval"): "float", ("lengthrange", "mode"): "text", ("visual.global", "elevation"): "float",
    ("edge", "stiffness"): "float", ("edge", "damping"): "float", ("elasticity", "damping"): "float",
    ("skin", "texcoord"): "array", ("flexcomp", "element"): "array", ("flex", "element"): "ints",
    ("replicate", "count"): "int", ("text", "data"): "text",
}  # fmt: skip


@functools.cache
def form(path: str, tag: str, name: str) -> str:
    """Return the type of an attribute: ``array``, ``ints``, ``int``, ``float`` or ``text``.

    Args:
        path: Section and tag, for elements such as ``visual.map``.
    """
    for key in ((path, "*"), (path, name), (tag, name)):
        if key in _OTHERWISE:
            return _OTHERWISE[key]
    for names, found in ((ARRAYS, "array"), (INTEGER_ARRAYS, "ints"), (INTEGERS, "int"), (FLOATS, "float")):
        if name in names:
            return found
    return "text"


_REFERENCES = {
    **{name: name.rstrip("12") for name in (
        "body", "body1", "body2", "geom", "geom1", "geom2", "joint", "joint1", "joint2", "site", "site1", "site2",
        "tendon", "tendon1", "tendon2", "actuator", "camera", "material", "mesh", "hfield", "texture", "flex",
    )},
    **dict.fromkeys(("subtree1", "subtree2", "target"), "body"),
    **dict.fromkeys(("cranksite", "refsite", "sidesite", "slidersite"), "site"),
    "instance": "instance", "jointinparent": "joint", "objname": "objtype", "refname": "reftype",
    "class": "default", "childclass": "default",
}  # fmt: skip


@functools.cache
def reference(path: str, tag: str, name: str) -> str | None:
    """Return the kind of element to which an attribute refers, or the attribute with the kind; None: no reference."""
    if path.startswith(("visual", "option")) or (name, tag) in (("class", "default"), ("body", "flex")):
        return None
    return _REFERENCES.get(name)


KEYED = {"qpos": "joint", "qvel": "joint", "act": "actuator", "ctrl": "actuator", "mpos": "body", "mquat": "body"}
"""Attribute of a keyframe -> the kind of element to which its numbers belong."""
KIND_OF_TAG = {
    "freejoint": "joint",
    **{tag: "actuator" for tag in ("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder",
                                   "muscle", "adhesion")},
    **dict.fromkeys(("connect", "weld"), "equality"), **dict.fromkeys(("fixed", "spatial"), "tendon"),
    "xbody": "body", "pair": "contact", "exclude": "contact", "flex": "deformable", "instance": "plugin",
}  # fmt: skip
"""Other names of kinds."""
SMALLER = _words("timestep tolerance ls_tolerance noslip_tolerance ccd_tolerance znear ")
LARGER = _words(
    "iterations ls_iterations noslip_iterations ccd_iterations sdf_iterations sdf_initpoints njmax nconmax zfar memory "
)
"""Settings of which the larger value holds if models differ; in ``SMALLER`` the smaller one; others must be equal."""
OWN_SETTINGS = frozenset(("meshdir", "texturedir", "assetdir", "angle"))
"""Settings of ``compiler`` that apply to each model separately."""
