"""The tags of MJCF, their places and their attributes, according to MuJoCo's own parser."""

from __future__ import annotations

import functools
import re

from sim2real.composer.models.mjcf.translate import mj

_INDENT = 3
_ENTRY = re.compile(r"^( *)(\(?\w+\)?\w*) \([!?*R]\)\s*(.*)$")
_SHARED = ("asset", "contact", "custom", "keyframe", "body")
"""Sections whose elements are called like their kind."""

KIND_OF_TAG = {
    "freejoint": "joint",
    "worldbody": "body",
    **dict.fromkeys(
        ("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion"),
        "actuator",
    ),
    **dict.fromkeys(("connect", "weld", "flex"), "equality"),
    **dict.fromkeys(("fixed", "spatial"), "tendon"),
}
"""The kind of those tags that are not called like their kind; inside a section the section decides."""
SECTIONS = {
    "actuator": ("actuator",),
    "sensor": ("sensor",),
    "equality": ("equality",),
    "tendon": ("tendon",),
    "contact": ("pair", "exclude"),
    "asset": ("mesh", "material", "texture", "hfield", "skin"),
    "custom": ("numeric", "text", "tuple"),
    "keyframe": ("key",),
}
"""Section -> the kinds of its elements."""
SECTION_OF = {kind: section for section, kinds in SECTIONS.items() for kind in kinds}
"""Kind of element -> its section."""
FROM_DOCUMENTS = "write it in MJCF, read that with mjcf.from_xml_string and attach the model: MuJoCo's parser knows it"
"""The way to elements that programs cannot add."""


@functools.cache
def tables() -> dict[tuple[str, ...], frozenset[str]]:
    """Return path of tags, such as ``("actuator", "motor")`` -> names of attributes."""
    table: dict[tuple[str, ...], list[str]] = {}
    path: tuple[str, ...] = ()
    for line in mj.mj_printSchema(False, False).splitlines():
        entry = _ENTRY.match(line)
        if entry is None:
            table[path] += line.split()
            continue
        depth = len(entry[1]) // _INDENT
        path = (*path[:depth], entry[2].replace("(world)", ""))
        table[path] = entry[3].split()
    return {path[1:]: frozenset(names) for path, names in table.items()}


@functools.cache
def attributes(kind: str, tag: str) -> frozenset[str]:
    """Return the attributes of elements with a tag; nothing for a kind that MJCF spells in another way.

    Args:
        tag: Its tag, such as ``motor``; the same as the kind where there is only one.
    """
    names: frozenset[str] = frozenset()
    for path, more in tables().items():
        if path[-1:] == (tag,) and (path == ("body",) or (len(path) == 2 and path[0] in (kind, *_SHARED))):
            names |= more
    return names - {"class"} | ({"dclass"} if "class" in names else frozenset())
