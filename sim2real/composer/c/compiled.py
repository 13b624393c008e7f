"""When models have to be compiled, and when the last result still holds."""

from __future__ import annotations

import copy
import sys
from typing import Any

import numpy as np

from sim2real.composer.c.physics import Physics
from sim2real.composer.models.translate import mj
from sim2real.composer.task import Task

_PART_NAMES: dict[type, tuple[str, ...]] = {}
_PLAIN = (int, float, str, bytes, mj.MjModel)


class Compiler:
    """Compiles a task's models, and only when something in them has changed.

    Args:
        task: The task.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._key: Any = None
        self._model: Any = None
        self._content = np.empty(0, np.uint8)
        self._last: _Loan | None = None

    def start(self, legacy_step: bool) -> Physics:
        """Return the task's world in its initial state.

        The ``MjModel`` and ``MjData`` are those of the last physics when it is gone, nobody holds a part of them, and
        the model is as it was compiled; else they are new.
        """
        model = self._task.root_entity.mjcf_model.root_model
        key = [(m, m.revision()) for m in model.all_models()]
        if None in (revision for _, revision in key) or key != self._key:
            self._model, self._key, self._last = model.compile(), key, None
            self._content = _content(self._model)
        if self._last is None or self._last.is_held() or not np.array_equal(_content(self._last.model), self._content):
            self._last = _Loan(self._model)
        mj.mj_resetData(self._last.model, self._last.data)
        return Physics(self._last.model, legacy_step, self._last.data)


class _Loan:
    """A model and a state that are lent out, and whether anybody still holds them or an array of theirs.

    Args:
        model: The model that it copies.
    """

    def __init__(self, model: Any) -> None:
        self.model = copy.copy(model)
        self.data = mj.MjData(self.model)
        self._parts = [self.model, self.data, *_parts(self.model), *_parts(self.data)]
        self._holders = self._count()

    def _count(self) -> int:
        return sum(map(sys.getrefcount, self._parts))

    def is_held(self) -> bool:
        """Return whether a part of it is referred to from elsewhere."""
        return self._count() != self._holders


def _parts(owner: Any) -> list[Any]:
    """Return the arrays and lists of a model or a state that it hands out again and again."""
    if type(owner) not in _PART_NAMES:
        names = [n for n in dir(owner) if not n.startswith("_")]
        found = [n for n in names if not isinstance(getattr(owner, n), _PLAIN) and _is_kept(owner, n)]
        _PART_NAMES[type(owner)] = tuple(found)
    return [getattr(owner, name) for name in _PART_NAMES[type(owner)]]


def _is_kept(owner: Any, name: str) -> bool:
    return not callable(getattr(owner, name)) and getattr(owner, name) is getattr(owner, name)


def _content(model: Any) -> np.ndarray:
    """Return all that is in a model as bytes."""
    made = np.empty(mj.mj_sizeModel(model), np.uint8)
    mj.mj_saveModel(model, None, made)
    return made
