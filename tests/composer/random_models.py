"""Random models, made with PyMJCF or with our ``mjcf`` by the same calls: composed, changed, copied, detached."""

import contextlib
import copy
import importlib
from types import SimpleNamespace

import mujoco
import numpy as np
import random_links
from mujoco.introspect.structs import STRUCTS

KINDS = (
    "body", "joint", "geom", "site", "camera", "light", "actuator", "sensor", "equality", "tendon", "key", "material",
)  # fmt: skip
SHAPES = {"sphere": 1, "capsule": 2, "box": 3, "cylinder": 2, "ellipsoid": 3}
POSES = {"quat": 4, "axisangle": 4, "euler": 3, "zaxis": 3, "xyaxes": 6}
ACTUATORS = {
    "motor": {}, "position": {"kp": 4.0}, "velocity": {"kv": 0.5}, "damper": {"kv": 0.5, "ctrlrange": [0, 1]},
    "intvelocity": {"kp": 2.0, "actrange": [-1, 1]}, "cylinder": {"timeconst": 0.1, "area": 2.0},
    "general": {"dyntype": "filter", "dynprm": [0.1], "biastype": "affine", "biasprm": [0.0, -1.0]},
}  # fmt: skip
DEFAULTS = {
    "geom": {"rgba": 4, "friction": 3, "density": 0, "solref": 2},
    "joint": {"damping": 0, "armature": 0, "stiffness": 0},
    "site": {"rgba": 4, "size": 1}, "motor": {"gear": 6, "ctrlrange": 2}, "general": {"gear": 1, "forcerange": 2},
    "position": {"kp": 0, "gear": 3}, "equality": {"solref": 2}, "tendon": {"width": 0, "rgba": 4},
}  # fmt: skip
DOCUMENT = """<mujoco model="doc"><compiler angle="{unit}"/>
  <default><joint margin="{a}"/><default class="thin"><geom size="{a}"/>
  <joint range="-.5 {a}" limited="true"/><motor gear="{a}"/></default></default>
  <asset><texture name="tex" type="2d" builtin="flat" width="4" height="4"/><material name="mat" texture="tex"/>
    <mesh name="tetra" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>
  <worldbody><body name="b0" pos="0 0 {a}" childclass="thin"><joint name="j0"/><geom name="g0" material="mat"/>
    <site name="s0" euler="0 {a} 0"/><body name="b1" pos="0 .2 .1"><joint name="j1" axis="0 1 0"/><geom class="thin"/>
    <geom name="g1" type="mesh" mesh="tetra"/></body>{more}</body></worldbody>
  <actuator><motor name="a0" class="thin" joint="j0"/><position joint="j1" kp="3"/></actuator>
  <sensor><jointpos joint="j0"/><framepos name="n0" objtype="site" objname="s0" reftype="body" refname="b1"/></sensor>
  {rest}</mujoco>"""
MORE = (
    "", '<composite prefix="cable" type="cable" curve="s" count="4 1 1" size="1" initial="none"><geom type="capsule" '
    'size=".01"/><joint kind="main"/></composite>',
    '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" radius=".01" mass="1"><edge equality="true"/>'
    "</flexcomp>", '<camera name="eye" mode="targetbody" target="b1"/>',
)  # fmt: skip
REST = (
    "", '<deformable><skin name="skin" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2"><bone body="b1" bindpos="0 0 0" '
    'bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin></deformable>',
    '<extension><plugin plugin="mujoco.pid"><instance name="pid"><config key="kp" value="4"/></instance></plugin>'
    '</extension><actuator><plugin name="aid" plugin="mujoco.pid" instance="pid" joint="j1"/></actuator>',
    '<custom><tuple name="two"><element objtype="joint" objname="j0"/><element objtype="body" objname="b1"/></tuple>'
    '<numeric name="num" data="1 2"/></custom><contact><exclude body1="b0" body2="b1"/></contact>',
    '<tendon><spatial name="line" width="0.01"><site site="s0"/><geom geom="g0" sidesite="s0"/><site site="s0"/>'
    "</spatial></tendon>",
)  # fmt: skip


def names(model):
    objects = {kind: getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}") for kind in KINDS}
    count = {"camera": "ncam", "joint": "njnt", "equality": "neq", "material": "nmat", "actuator": "nactuator"}
    return {
        kind: [mujoco.mj_id2name(model, objects[kind], i) for i in range(getattr(model, count.get(kind, f"n{kind}")))]
        for kind in KINDS
    }


def differing_arrays(a, b):
    fields = [f.name for f in STRUCTS["mjModel"].fields if getattr(f, "array_extent", None)]
    skipped = {"names", "paths"} | {f for f in fields if f.startswith("name_")}
    return [f for f in fields if f not in skipped and not np.array_equal(getattr(a, f), getattr(b, f))]


def kit(name):
    """Return the modules of a package."""
    root = {"dm_control": "dm_control", "sim2real": "sim2real.composer"}[name]
    return SimpleNamespace(name=name, mjcf=importlib.import_module(f"{root}.mjcf"))


class Draw(np.random.RandomState):
    """Draws what models are made of."""

    def chance(self, share):
        return self.rand() < share

    def pick(self, items):
        return items[self.randint(len(items))]

    def numbers(self, count):
        return np.round(self.uniform(0.1, 0.9, count or 1), 3).tolist() if count else float(np.round(self.rand(), 3))


def make(kit, seed):
    """Return the model at the top of a random world."""
    draw = Draw(seed)
    models = [_model(kit, draw, f"m{i}") for i in range(draw.randint(2, 5))]
    top, unit = kit.mjcf.RootElement(model="top"), draw.pick(["radian", "degree"])
    top.worldbody.add("geom", name="floor", type="plane", size=[1, 1, 0.1])
    if draw.chance(0.5):
        parts = {"more": draw.pick(MORE), "rest": draw.pick(REST), "a": draw.numbers(0) + 0.1, "unit": unit}
        models.append(kit.mjcf.from_xml_string(DOCUMENT.format(**parts)))
    if draw.chance(0.5) or len(models) > 4 or models[-1].model == "doc":
        top.compiler.angle = unit
    attached = [top]
    for model in models:
        attached.append(_attach(draw, draw.pick(attached), model))
    for number in range(draw.randint(0, 4)):
        random_links.add(draw, draw.pick(random_links.KINDS), top, attached, f"x{number}", True, True, draw.chance(0.3))
    for _ in range(draw.randint(0, 5)):
        if kit.name == "sim2real":  # what was written before a change is not what is written after it
            with contextlib.suppress(ValueError):
                top.to_xml_string()
        attached = _change(draw, top, attached)
    return top


def _model(kit, draw, name):
    model = kit.mjcf.RootElement(model=name if draw.chance(0.7) else "same")
    holder = model.default
    for level in range(draw.randint(0, 3)):
        for tag in draw.choice(sorted(DEFAULTS), draw.randint(0, 4), replace=False):
            for attribute, size in DEFAULTS[tag].items():
                if draw.chance(0.5):
                    setattr(getattr(holder, tag), attribute, draw.numbers(size))
        holder = holder.add("default", dclass=f"c{level}")
    classes = [d.dclass for d in model.find_all("default") if d.dclass]
    bodies = [model.worldbody]
    for number in range(draw.randint(1, 5)):
        body = draw.pick(bodies).add("body", **_named(draw, f"b{number}"), **_pose(draw))
        if classes and draw.chance(0.3):
            body.childclass = draw.pick(classes)
        for at in range(draw.randint(0, 3)):
            kind = draw.pick(["hinge", "slide", "hinge", "ball"])
            joint = body.add("joint", type=kind, **_named(draw, f"j{number}{at}"), **_class(draw, classes))
            if kind != "ball" and draw.chance(0.5):
                joint.set_attributes(axis=draw.numbers(3), range=[-draw.numbers(0), 1.0], limited="true")
            if joint.type == "ball":
                break
        shape = draw.pick(sorted(SHAPES))
        body.add("geom", type=shape, size=draw.numbers(SHAPES[shape]), **_named(draw, f"g{number}"),
                 **_class(draw, classes), **_pose(draw))  # fmt: skip
        body.add("site", **_named(draw, f"s{number}"), **_class(draw, classes), **_pose(draw))
        bodies.append(body)
    joints = [j for j in model.find_all("joint") if j.type != "ball"]
    for number, joint in enumerate(joints):
        tag = draw.pick(sorted(ACTUATORS))
        options = dict(ACTUATORS[tag]) | ({"gear": draw.numbers(draw.randint(1, 7))} if draw.chance(0.4) else {})
        if draw.chance(0.7):
            model.actuator.add(tag, joint=joint, **_named(draw, f"a{number}"), **_class(draw, classes), **options)
        if draw.chance(0.5):
            model.sensor.add("jointpos", joint=joint, **_named(draw, f"n{number}"))
    if len(joints) > 1 and draw.chance(0.5):
        tendon = model.tendon.add("fixed", name="t", **_class(draw, classes))
        for joint in joints[:2]:
            tendon.add("joint", joint=joint, coef=draw.numbers(0))
    model.option.iterations = int(draw.randint(10, 99))
    if draw.chance(0.3):
        model.option.timestep = draw.pick([0.001, 0.004])
    return model


def _named(draw, name):
    return {"name": name} if draw.chance(0.7) else {}


def _class(draw, classes):
    return {"dclass": draw.pick(classes)} if classes and draw.chance(0.4) else {}


def _pose(draw):
    turn = draw.pick([*POSES, ""])
    return {"pos": draw.numbers(3)} | ({turn: draw.numbers(POSES[turn])} if turn else {})


def _attach(draw, parent, model):
    sites = [s for s in parent.find_all("site", exclude_attachments=True) if s.parent.tag != "frame"]
    frame = draw.pick(sites).attach(model) if sites and draw.chance(0.6) else parent.attach(model)
    if frame.parent.tag == "worldbody" and parent.parent_model is None and draw.chance(0.3):
        frame.add("freejoint")
    elif draw.chance(0.4):
        for name in draw.pick([(None,), ("x", "y"), ("b0",), ("same",)]):
            frame.add("joint", type="slide", axis=draw.numbers(3), **({"name": name} if name else {}))
    if not frame.all_children() or frame.find_all("joint", immediate_children_only=True):
        frame.add("inertial", mass=1.0, pos=[0, 0, 0], diaginertia=[1, 1, 1])
    return model


def _change(draw, top, models):
    """Change the world; return the models that are in it afterwards."""
    kind = draw.pick(["rename", "option", "default", "again", "copy", "remove", "pose", "model", "delete"])
    model = draw.pick(models)
    named = [
        e for k in ("body", "joint", "geom", "site", "actuator") for e in model.find_all(k, exclude_attachments=True)
    ]
    named = list(filter(_has_name, named))
    if kind == "rename":
        for i, element in enumerate(named):
            if draw.chance(0.5):
                element.name = f"new{i}"
    elif kind == "option":
        model.option.gravity = draw.numbers(3)
        model.option.flag.contact = draw.pick(["enable", "disable"])
    elif kind == "default":
        model.default.geom.rgba = draw.numbers(4)
        model.default.motor.gear = draw.numbers(2)
    elif kind == "again" and model is not top and not _is_named_elsewhere(model, models):
        model.detach()
        models = [m for m in models if m.root_model is top]
        _attach(draw, draw.pick(models), model)
        models = [top, *(m for m in models[1:]), model]
    elif kind == "copy" and model is not top and not any(m.parent_model is model for m in models):
        twin = copy.copy(model) if draw.chance(0.5) else copy.deepcopy(model)
        twin.model = "twin"
        _attach(draw, top, twin)
        models = [*models, twin]
    elif kind == "remove" and model is not top:
        for sensor in model.find_all("sensor", exclude_attachments=True)[:1]:
            sensor.remove()
    elif kind == "delete":
        for geom in model.find_all("geom", exclude_attachments=True)[:1]:
            del geom.pos
            geom.friction = [0.5]
    elif kind == "pose":
        for geom in named[:3]:
            if geom.tag in ("geom", "site") and geom.pos is not None:
                geom.pos[:] = draw.numbers(3)
    elif kind == "model" and model is not top:
        model.model = f"renamed{len(models)}_{draw.randint(1000)}"
    return models


def _has_name(element):
    """Return whether an element has a name of its own, and is no frame."""
    return not element.full_identifier.endswith("/") and element.name


def _is_named_elsewhere(model, models):
    """Return whether another model, or one that is attached to it, is in the way of taking a model off."""
    others = ("equality", "contact", "tendon", "sensor", "actuator")
    return any(m.parent_model is model for m in models) or any(
        models[0].find_all(k, exclude_attachments=True) for k in others
    )


def compiled(kit, seed):
    """Return the ``MjModel`` of a seed, or the error of MuJoCo or of the package."""
    try:
        model = make(kit, seed)
        return mujoco.MjModel.from_xml_string(model.to_xml_string(), model.get_assets())
    except ValueError as error:
        return error


def _found(model):
    """Return the elements of each kind as they are found in a world, and in the models that are attached."""
    holders = [model, *model.find_all("attachment_frame")]
    kinds = [k for k in KINDS if k not in ("light", "key")]
    return [
        [[e.full_identifier for e in h.find_all(k, exclude_attachments=own)] for k in kinds for own in (True, False)]
        for h in holders
    ]


def compare(seed):
    """Return what differs between dm_control's model of a seed and ours; '' where both refuse it."""
    theirs, mine = (compiled(kit(name), seed) for name in ("dm_control", "sim2real"))
    if isinstance(theirs, Exception) or isinstance(mine, Exception):
        refused = [type(m).__name__ if isinstance(m, Exception) else "" for m in (theirs, mine)]
        return "" if all(refused) else f"refused by one: {refused}: {theirs} {mine}"
    found = (_found(make(kit(name), seed)) for name in ("dm_control", "sim2real"))
    if next(found) != next(found):
        return "elements are found in another order"
    one, other = names(theirs), names(mine)
    if one != other:
        return str(
            {k: [p for p in zip(one[k], other[k], strict=False) if p[0] != p[1]] for k in one if one[k] != other[k]}
        )
    return ", ".join(differing_arrays(theirs, mine))
