"""From a model to the frame and the joints that hold it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from sim2real.composer.models import builder
from sim2real.composer.models.composition import compose
from sim2real.composer.models.element import Element
from sim2real.composer.models.mjcf import schema
from sim2real.composer.models.model import Model


def get_attachment_frame(mjcf_model: Model) -> Any:
    """Return the body that holds an attached model, or None."""
    parent = mjcf_model.parent_model
    if parent is None:
        return None
    body = compose.free_body(mjcf_model)
    return parent.find("attachment_frame", mjcf_model.model) if body is None else mjcf_model.handle("body", body)


def get_freejoint(element: Element) -> Element | None:
    """Return the free joint of a body, or None."""
    return element.freejoint if element.kind == "body" else None


def get_frame_freejoint(mjcf_model: Model) -> Element | None:
    """Return the free joint that moves an attached model: of its frame, or its own one; or None."""
    frame = get_attachment_frame(mjcf_model)
    return None if frame is None else get_freejoint(frame)


def get_frame_joints(mjcf_model: Model) -> list[Element] | None:
    """Return all joints of the frame of an attached model, or None when it is not attached."""
    frame = get_attachment_frame(mjcf_model)
    return None if frame is None else frame.find_all("joint", immediate_children_only=True)


def commit_defaults(element: Element, attributes: Iterable[str] | None = None) -> None:
    """Give an element, as its own, the values that it takes from its classes of defaults.

    Args:
        attributes: Names of the attributes; default: all.
    """
    for record in builder.class_records(element):  # a class has one actuator for all tags
        for name in record.values.keys() & schema.attributes(element.kind, element.tag):
            if (attributes is None or name in attributes) and getattr(element, name) is None:
                setattr(element, name, record.values[name])
