"""When models have to be compiled, and when the last result still holds."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics.c.physics import Physics
from sim2real.composer.task import Task

if TYPE_CHECKING:
    from sim2real.composer.types import MjModel


class Compiler:
    """Compiles a task's models, and only when something in them has changed."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._text = ""
        self._model: MjModel | None = None

    def start(self, legacy_step: bool) -> Physics:
        """Return the task's world in its initial state, in memory of its own: arrays of earlier episodes stay."""
        model = self._task.root_entity.mjcf_model.root_model
        text = model.to_xml_string()  # which names files by their contents
        if text != self._text:
            self._model, self._text = mj.MjModel.from_xml_string(text, model.get_assets()), text
        return Physics(copy.copy(self._model), legacy_step)
