"""Models and elements with PyMJCF's names: ``mjcf.from_path``, ``mjcf.RootElement`` and so on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sim2real.composer.mjcf import compose as _compose
from sim2real.composer.mjcf import element as element
from sim2real.composer.mjcf.element import Element as Element
from sim2real.composer.mjcf.files import Asset as Asset
from sim2real.composer.mjcf.files import export_with_assets as export_with_assets
from sim2real.composer.mjcf.files import export_with_assets_as_zip as export_with_assets_as_zip
from sim2real.composer.mjcf.model import RootElement as RootElement

element.RootElement = RootElement  # as in PyMJCF

PREFIX_SEPARATOR = "/"
"""Separator between the names of models and elements."""

from_xml_string = RootElement.from_xml_string
from_path = RootElement.from_path
from_file = RootElement.from_file


def get_attachment_frame(mjcf_model: RootElement) -> Any:
    """Return the body that holds an attached model, or None; if the model has a body with a free joint, that body."""
    parent = mjcf_model.parent_model
    return None if parent is None else _compose.free_body(mjcf_model) or parent.frames[mjcf_model]


def get_freejoint(element: Element) -> Element | None:
    """Return the free joint of a body, or None."""
    for joint in element._children if element.kind == "body" else ():
        if joint.tag == "freejoint" or (joint.tag == "joint" and _compose.inherited(joint, "type") == "free"):
            return joint
    return None


def get_frame_freejoint(mjcf_model: RootElement) -> Element | None:
    """Return the free joint that moves an attached model, in its frame or in the model; or None."""
    frame = get_attachment_frame(mjcf_model)
    return None if frame is None else get_freejoint(frame)


def get_frame_joints(mjcf_model: RootElement) -> list[Element] | None:
    """Return all joints of the frame of an attached model; None if it is not attached."""
    frame = get_attachment_frame(mjcf_model)
    return None if frame is None else [c for c in frame._children if c.kind == "joint"]


def commit_defaults(element: Element, attributes: Iterable[str] | None = None) -> None:
    """Copy the values that an element takes from its classes of defaults into its own attributes.

    Args:
        attributes: Names of the attributes; default: all.
    """
    for default in _compose.classes(element):
        held = default._present(element.tag)
        for name, value in held.get_attributes().items() if held is not None else ():
            if (attributes is None or name in attributes) and getattr(element, name) is None:
                setattr(element, name, value)


def __getattr__(name: str) -> Any:
    """Import the physics at its first use, because it needs the elements."""
    if name in ("Physics", "Binding"):
        from sim2real.composer.physics.c import physics

        return getattr(physics, name)
    raise AttributeError(f"module 'sim2real.composer.mjcf' has no attribute {name!r}")
