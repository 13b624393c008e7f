"""What attributes of MJCF hold, and which of them name elements: the tables of dm_control, wherever it has an entry."""

import re

from sim2real.composer.mjcf import schema

NAMING = re.compile(
    r"(body|geom|joint|site|tendon|actuator|camera|mesh|material|hfield|texture|target|subtree)[12]?"
    r"|jointinparent|refsite|cranksite|slidersite|sidesite|objname|refname"
)
"""Attributes that name an element, in all of MuJoCo's schema."""
FORMS = {"Integer": "int", "Float": "float", "Array": "array", "Keyword": "text", "String": "text"}


def elements(spec, path=()):
    """Yield section and tag, and what MJCF says of such an element; of our table or of dm_control's."""
    for tag, child in spec.children.items():
        if tag not in path and tag not in ("frame", "replicate", "default"):
            inner = (*path, tag)
            yield ".".join(inner[-2:]) if len(path) < 2 else tag, tag, child
            yield from elements(child, inner)


def test_attributes_hold_what_they_hold_in_dm_control(oracle):
    theirs = {place: spec for place, _, spec in elements(oracle.mjcf.schema.MUJOCO)}
    compared, wrong = 0, []
    for place, tag, spec in elements(schema.root()):
        for name in set(spec.attributes) & set(getattr(theirs.get(place), "attributes", ())):
            about = theirs[place].attributes[name]
            kind, target = about.type.__name__, schema.reference(place, tag, name)
            if kind == "Reference":
                expected = about.other_kwargs["reference_namespace"].removeprefix("attrib:")
                agrees = schema.KIND_OF_TAG.get(target, target) == expected
            elif kind in FORMS:
                form = schema.form(place, tag, name)
                expected = "ints" if about.other_kwargs.get("dtype") is int else FORMS[kind]
                agrees = target is None and form == expected
            else:
                continue
            compared += 1
            wrong += [] if agrees else [(place, name, kind, expected, target)]
    assert compared > 500
    assert {row[:2] for row in wrong} == {("skin", "texcoord")}  # numbers, which dm_control takes for a keyword


def test_every_attribute_that_is_called_like_an_element_names_one():
    found = [
        (place, name, schema.reference(place, tag, name))
        for place, tag, spec in elements(schema.root())
        for name in spec.attributes
        if NAMING.fullmatch(name) and tag not in ("flex", "flexcomp") and not place.startswith("visual")
    ]
    assert len(found) > 100
    assert not [row for row in found if row[2] is None]
