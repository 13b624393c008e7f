"""Arenas: the entity that contains all others."""

from __future__ import annotations

import copy
import functools
from typing import TYPE_CHECKING, Any

from sim2real.composer.entity import Entity
from sim2real.composer.mjcf import RootElement as Model
from sim2real.composer.mjcf.element import Element

if TYPE_CHECKING:
    from sim2real.composer.types import RandomState

BASE = """
<mujoco model="base">
  <compiler angle="radian" eulerseq="xyz" boundmass="1e-5" boundinertia="1e-11"/>
  <option cone="elliptic" noslip_tolerance="0" timestep="0.002"/>
  <visual>
    <map znear="0.01"/>
    <headlight diffuse=".6 .6 .6" ambient=".3 .3 .3" specular="0 0 0"/>
    <scale forcewidth="0.01" contactwidth="0.06" contactheight="0.01" jointwidth=".01" framewidth=".01"
      framelength=".3"/>
  </visual>
</mujoco>
"""
"""dm_control's base arena, without the no-slip solver, which MJX lacks."""


@functools.cache
def _base() -> Model:
    return Model.from_xml_string(BASE)


class Arena(Entity):
    """The root entity: global settings, and the parts that subclasses build.

    Args:
        name: Name of the model; default: the file's.
        xml_path: MJCF file; default: ``BASE``.
    """

    def _build(self, *args: Any, **kwargs: Any) -> None:
        options = dict(zip(("name", "xml_path"), args, strict=False)) | kwargs
        path = options.get("xml_path")
        self._mjcf_root = Model.from_path(path) if path else copy.copy(_base())
        if options.get("name"):
            self._mjcf_root.model = options["name"]

    @property
    def mjcf_model(self) -> Model:
        """The model."""
        root = self.__dict__.get("_mjcf_root")
        return super().mjcf_model if root is None else root

    def _make_model(self) -> Model:
        return copy.copy(_base())

    def add_free_entity(self, entity: Entity) -> Element:
        """Attach an entity that moves freely; return its frame."""
        frame = self.attach(entity)
        frame.add("freejoint")
        return frame

    def add_entity(self, entity: Entity, attachment_frame: Model | Element | None = None) -> Element:
        """Attach an entity; the same as ``attach``."""
        return self.attach(entity, attachment_frame)

    @property
    def ground_geoms(self) -> list[Element]:
        """The geoms of the ground; default: none."""
        return []

    def regenerate(self, random_state: RandomState) -> None:
        """Lay the arena out again; subclasses override it."""
