"""Reading and replacing a leaf in a tree of parameters by its path, ``node.field.field[index]``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import jax.numpy as jnp

from sim2real.errors import UsageError

_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[-?\d+\])*)$")


def get_leaf(tree: Any, path: str) -> Any:
    """Return what stands at a path of mappings, dataclasses and array indices.

    Raises:
        UsageError: When the path leads nowhere; the message lists what there is.
    """
    for name, index in _steps(path):
        tree = _child(tree, name, path)
        if index:
            tree = _indexed(tree, index, path)[index]
    return tree


def set_leaf(tree: Any, path: str, value: Any) -> Any:
    """Return the tree with another value at a path; an indexed entry of an array is replaced alone.

    Args:
        tree: Mappings and dataclasses, ``mjx.Model`` among them.
        path: Such as ``world.model.dof_damping[0]``.

    Raises:
        UsageError: When the path leads nowhere.
    """
    return _set(tree, _steps(path), value, path)


def _set(tree: Any, steps: list[tuple[str, tuple[int, ...]]], value: Any, path: str) -> Any:
    (name, index), *rest = steps
    child = _child(tree, name, path)
    if rest:
        if index:
            raise UsageError(f"the path {path!r} goes on behind an index: only its last step may have one")
        new = _set(child, rest, value, path)
    elif index:
        new = _indexed(child, index, path).at[index].set(value)
    else:
        new = value
    if isinstance(tree, Mapping):
        return {**tree, name: new}
    own = getattr(tree, "replace", None)  # flax and MJX dataclasses
    return own(**{name: new}) if callable(own) else replace(tree, **{name: new})


def _steps(path: str) -> list[tuple[str, tuple[int, ...]]]:
    steps = []
    for part in path.split("."):
        match = _STEP.match(part)
        if not match:
            raise UsageError(f"{path!r} is no path", hint="write node.field.field[index]")
        steps.append((match[1], tuple(int(i) for i in re.findall(r"-?\d+", match[2]))))
    return steps


def _indexed(leaf: Any, index: tuple[int, ...], path: str) -> Any:
    array = jnp.asarray(leaf)
    if len(index) != array.ndim or any(not -n <= i < n for i, n in zip(index, array.shape, strict=True)):
        raise UsageError(f"the path {path!r} needs an index into shape {array.shape}, got {list(index)}")
    return array


def _child(tree: Any, name: str, path: str) -> Any:
    if isinstance(tree, Mapping):
        if name in tree:
            return tree[name]
        names = list(tree)
    else:
        if is_dataclass(tree) and name in {f.name for f in fields(tree)}:
            return getattr(tree, name)
        names = [f.name for f in fields(tree)] if is_dataclass(tree) else []
    raise UsageError(f"the path {path!r} finds no {name!r}. Available: {', '.join(map(str, names)) or 'nothing'}")
