"""When models have to be compiled, and when the last result still holds."""

from __future__ import annotations

import copy
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.models.mjcf.translate import mj
from sim2real.composer.physics.c.physics import Physics
from sim2real.composer.task import Task

if TYPE_CHECKING:
    from sim2real.composer.models.model import Model
    from sim2real.composer.types import MjData, MjModel

_PART_NAMES: dict[type, tuple[str, ...]] = {}
_PLAIN = (int, float, str, bytes, mj.MjModel)


class Compiler:
    """Compiles a task's models, and only when something in them has changed."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._key: list[tuple[Model, int | None]] | None = None
        self._model: MjModel | None = None
        self._content = np.empty(0, np.uint8)
        self._memory: _Memory | None = None

    def start(self, legacy_step: bool) -> Physics:
        """Return the task's world in its initial state, in memory without outside references: see ``_Memory``."""
        model = self._task.root_entity.mjcf_model.root_model
        key = [(m, m.revision()) for m in model.all_models()]
        if None in (revision for _, revision in key) or key != self._key:
            self._model, self._key, self._memory = model.compile(), key, None
            self._content = _content(self._model)
        memory = self._memory
        if memory is None or memory.is_held() or not np.array_equal(_content(memory.model), self._content):
            memory = self._memory = _Memory(self._model)
        mj.mj_resetData(memory.model, memory.data)
        return Physics(memory.model, legacy_step, memory.data)


class _Memory:
    """An ``MjModel`` and an ``MjData`` that serve one episode after another, unless other code has kept a part of them.

    A program may keep an array such as ``physics.data.qpos``; the next episode must not change its numbers. dm_control
    allocates new memory for each episode; that takes two thirds of a reset. So the memory is used again if no other
    code refers to a part of it.

    MuJoCo creates each array of a model or a state once and returns the same object every time. A reference to it, or
    to a slice of it, raises Python's reference count of that object. If all counts equal those at the start, the memory
    is free. A count that differs for another reason costs new memory, never a wrong number.
    """

    def __init__(self, model: MjModel) -> None:
        self.model = copy.copy(model)
        self.data = mj.MjData(self.model)
        self._parts = [self.model, self.data, *_parts(self.model), *_parts(self.data)]
        self._at_first = self._counts()

    def _counts(self) -> list[int]:
        return list(map(sys.getrefcount, self._parts))

    def is_held(self) -> bool:
        """Return whether a part of it is referred to from elsewhere."""
        return self._counts() != self._at_first


def _parts(owner: MjModel | MjData) -> list[Any]:
    """Return the arrays and lists of a model or a state that it hands out again and again."""
    if type(owner) not in _PART_NAMES:
        names = [n for n in dir(owner) if not n.startswith("_")]
        parts = [n for n in names if not isinstance(getattr(owner, n), _PLAIN) and _is_kept(owner, n)]
        _PART_NAMES[type(owner)] = tuple(parts)
    return [getattr(owner, name) for name in _PART_NAMES[type(owner)]]


def _is_kept(owner: MjModel | MjData, name: str) -> bool:
    return not callable(getattr(owner, name)) and getattr(owner, name) is getattr(owner, name)


def _content(model: MjModel) -> np.ndarray:
    """Return the contents of a model as bytes."""
    content = np.empty(mj.mj_sizeModel(model), np.uint8)
    mj.mj_saveModel(model, None, content)
    return content
