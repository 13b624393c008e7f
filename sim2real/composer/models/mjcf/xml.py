"""Elements as MJCF: their explicit attributes, without those of classes of defaults."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from sim2real.composer.models.mjcf.targets import targets
from sim2real.composer.models.mjcf.tendon_paths import path_of
from sim2real.composer.models.mjcf.translate import mj
from sim2real.composer.models.tree import Handle, Tree

if TYPE_CHECKING:
    from sim2real.composer.types import Value


def to_xml_string(element: Value, prefix_root: Tree[Handle] | None, self_only: bool, pretty_print: bool) -> str:
    """Return an element as MJCF.

    Args:
        prefix_root: The model that names are relative to; default: the element's own.
    """
    node = _node(element, prefix_root or element.root, self_only)
    if pretty_print:
        ElementTree.indent(node)
    return ElementTree.tostring(node, encoding="unicode", short_empty_elements=True).replace(" />", "/>")


_ORDER = ("inertial", "joint", "geom", "site", "camera", "light", "body")


def _node(element: Value, top: Tree[Handle], self_only: bool) -> ElementTree.Element:
    explicit = element.recorded().values
    node = ElementTree.Element(element.tag)
    if element.name and not element.is_worldbody and element.kind != "inertial":
        node.set("name", element.root.identify(element, relative_to=top))
    for key in explicit:
        value = explicit[key] if key.startswith("file") else getattr(element, key)
        if key != "name" and value is not None:
            node.set("class" if key == "dclass" else key, _text(value, top))
    if self_only:
        return node
    # Add the children; an attachment frame also holds those of the attached model.
    children = element.all_children() if element.kind == "body" else []
    if element.is_frame:
        children += element.root.attachments[element._native.name[:-1]].model.worldbody.all_children()
    node.extend(_node(child, top, False) for child in sorted(children, key=lambda e: _ORDER.index(e.kind)))
    # Paths of tendons and references of tuples are child elements in MJCF.
    if element.kind == "tendon":
        for part in path_of(element.root, element._native):
            ElementTree.SubElement(node, part.tag, {k: _text(v, top) for k, v in part.values.items()})
    if element.kind == "tuple":
        for number, (_, kind, name) in enumerate(targets("tuple", element._native)):
            target = element.root.references.get((element._native, f"objname[{number}]"), name)
            prm = _text(element._native.objprm[number], top)
            ElementTree.SubElement(node, "element", {"objtype": kind, "objname": _text(target, top), "prm": prm})
    return node


def _text(value: Value, top: Tree[Handle]) -> str:
    """Return a value as MJCF has it: elements by their names, numbers with all their digits."""
    if isinstance(value, Handle):
        return value.root.identify(value, relative_to=top)
    if hasattr(value, "dclass"):
        return value.dclass or "main"
    if isinstance(value, bool | np.bool_):
        return str(value).lower()
    if isinstance(value, float | int | np.number | np.ndarray | list | tuple) and not isinstance(value, mj.mjtLimited):
        return " ".join(f"{v:.17g}" if isinstance(v, float) else str(v) for v in np.ravel(value).tolist())
    return str(value)
