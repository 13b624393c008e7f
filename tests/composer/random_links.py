"""Random elements that name elements of other models: of those attached, of the one above, of one beside it."""

import numpy as np

TENDONS = ("fixed", "spatial", "around")
NOT_ON_MJX = ("weld", "tie", "distance")
"""What MJX computes otherwise (rows of "Differences from dm_control"), or does not have."""
KINDS = (*TENDONS, "joint", "weld", "tie", "pair", "exclude", "motor", "frame", "distance", "camera", "material")


def link(kit, seed, top, models, contacts, explicit, for_mjx):
    """Add some such elements to the models of a world, and call some elements otherwise afterwards.

    Args:
        kit: The modules that the models are made of.
        seed: Seed.
        top: The model at the top.
        models: Those attached to it.
        contacts: Whether geoms of two models may touch.
        explicit: Whether forces may depend on velocities, as in ``random_tasks``.
        for_mjx: Whether kinds that MJX computes otherwise are left out.
    """
    draw = np.random.RandomState([seed, 7])
    top.worldbody.add("site", name="here", pos=[0.3, 0.2, 1.5])
    for number in range(draw.randint(0, 6)):
        kind = KINDS[draw.randint(len(KINDS))]
        owner = [top, *models][draw.randint(1 + len(models))]
        by_text = owner is top and draw.rand() < 0.5
        if not (for_mjx and kind in NOT_ON_MJX):
            add(draw, kind, owner, models, f"x{number}", contacts, explicit, by_text)
    for model in [top, *models]:
        model.resolve_references()  # what a program gave as text stays text in dm_control
    for model in models:
        if draw.rand() < 0.4:
            for kind in ("joint", "site", "body", "geom"):
                found = [e for e in model.find_all(kind, exclude_attachments=True) if e.name]
                _shift(found)
        if draw.rand() < 0.3:
            model.model = f"{model.model}_again"


def _shift(elements):
    """Let each element have the name of the one before it."""
    names = [e.name for e in elements]
    for i, element in enumerate(elements):
        element.name = f"aside{i}"
    for element, name in zip(elements, names[1:] + names[:1], strict=True):
        element.name = name


def add(draw, kind, owner, models, name, contacts, explicit, by_text):
    """Add an element of a kind to a model, if there is what it names."""

    def pick(what, accept=lambda element: True):
        found = [e for m in models for e in m.find_all(what, exclude_attachments=True)]
        found = [e for e in found if getattr(e, "name", None) and e.name[-1] != "/" and accept(e)]
        element = found[draw.randint(len(found))] if found else None
        return element.full_identifier if element is not None and by_text else element

    joints = [pick("joint", lambda e: e.type in ("hinge", "slide")) for _ in range(2)]
    bodies, sites, geoms = ([pick(what) for _ in range(2)] for what in ("body", "site", "geom"))
    different = {what: a is not b and a != b for what, (a, b) in
                 {"joint": joints, "body": bodies, "geom": geoms, "site": sites}.items()}  # fmt: skip
    if kind in TENDONS:
        spring = {"stiffness": 2.0, "damping": 0.05 * explicit, "springlength": 0.2}
        if kind == "fixed" and joints[0] is not None and different["joint"]:
            tendon = owner.tendon.add("fixed", name=name, **spring)
            for joint in joints:
                tendon.add("joint", joint=joint, coef=float(draw.uniform(-1, 1)))
        elif kind != "fixed" and different["site"]:
            tendon = owner.tendon.add("spatial", name=name, **spring)
            tendon.add("site", site=sites[0])
            if kind == "around":
                round_geom = pick("geom", lambda e: e.type in ("sphere", "cylinder"))
                if round_geom is not None:
                    tendon.add("geom", geom=round_geom)
            tendon.add("site", site=sites[1])
        else:
            return
        owner.sensor.add("tendonpos", name=f"{name}n", tendon=tendon)
        owner.actuator.add("motor", name=f"{name}a", tendon=tendon, gear=[0.5])
    elif kind == "joint" and joints[0] is not None and different["joint"]:
        owner.equality.add("joint", name=name, joint1=joints[0], joint2=joints[1], polycoef=[0, 0.3, 0, 0, 0])
    elif kind == "weld" and different["body"]:
        owner.equality.add("weld", name=name, body1=bodies[0], body2=bodies[1], solref=[0.3, 1])
    elif kind == "tie" and different["body"]:
        owner.equality.add("connect", name=name, body1=bodies[0], body2=bodies[1], anchor=[0, 0, 0.1], solref=[0.3, 1])
    elif kind == "pair" and contacts and different["geom"]:
        owner.contact.add("pair", name=name, geom1=geoms[0], geom2=geoms[1], condim=3)
    elif kind == "exclude" and different["body"]:
        owner.contact.add("exclude", name=name, body1=bodies[0], body2=bodies[1])
    elif kind == "motor" and joints[0] is not None:
        actuator = owner.actuator.add("position", name=name, joint=joints[0], kp=1.0)
        owner.sensor.add("actuatorfrc", name=f"{name}n", actuator=actuator)
    elif kind == "frame":
        options = {"reftype": "body", "refname": bodies[0]} if draw.rand() < 0.5 else {}
        owner.sensor.add("framepos", name=name, objtype="site", objname=sites[0], **options)
    elif kind == "distance" and different["geom"]:
        owner.sensor.add("distance", name=name, geom1=geoms[0], geom2=geoms[1], cutoff=3.0)
    elif kind == "camera":
        owner.worldbody.add("camera", name=name, mode="targetbody", target=bodies[0], pos=[0, 0, 3])
    elif kind == "material":
        material = owner.asset.add("material", name=name, rgba=[1, 0, 0, 1])
        for model in models[:1]:
            model.find_all("geom")[0].material = material
