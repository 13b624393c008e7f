"""Read and replace a leaf of a parameter tree by its path, ``node.field.field[index]``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace

from numpy.typing import ArrayLike

from sim2real.errors import UsageError
from sim2real.later import jax, jnp
from sim2real.types import PyTree

_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[-?\d+\])*)$")


def get_leaf(tree: PyTree, path: str) -> PyTree:
    """Return the leaf at a path of mappings, dataclasses and array indices.

    Raises:
        UsageError: The path does not exist; the message lists the names that do.
    """
    for name, index in _steps(path):
        tree = _child(tree, name, path)
        if index:
            tree = _indexed(tree, index, path)[index]
    return tree


def set_leaf(tree: PyTree, path: str, value: ArrayLike) -> PyTree:
    """Return the tree with another value at a path; an index replaces one entry of an array.

    Args:
        tree: Mappings and dataclasses, such as ``mjx.Model``.
        path: Such as ``world.model.dof_damping[0]``.

    Raises:
        UsageError: The path does not exist.
    """
    return _set(tree, _steps(path), value, path)


def _set(tree: PyTree, steps: list[tuple[str, tuple[int, ...]]], value: ArrayLike, path: str) -> PyTree:
    (name, index), *rest = steps
    child = _child(tree, name, path)
    if rest:
        if index:
            raise UsageError(f"the path {path!r} goes on after an index: only the last name may have one")
        replaced = _set(child, rest, value, path)
    elif index:
        replaced = _indexed(child, index, path).at[index].set(value)
    else:
        replaced = value
    if isinstance(tree, Mapping):
        return {**tree, name: replaced}
    method = getattr(tree, "replace", None)  # flax and MJX dataclasses
    return method(**{name: replaced}) if callable(method) else replace(tree, **{name: replaced})


def _steps(path: str) -> list[tuple[str, tuple[int, ...]]]:
    steps = []
    for part in path.split("."):
        match = _STEP.match(part)
        if not match:
            raise UsageError(f"{path!r} is no path", hint="write node.field.field[index]")
        steps.append((match[1], tuple(int(i) for i in re.findall(r"-?\d+", match[2]))))
    return steps


def _indexed(leaf: ArrayLike, index: tuple[int, ...], path: str) -> jax.Array:
    array = jnp.asarray(leaf)
    if len(index) != array.ndim or any(not -n <= i < n for i, n in zip(index, array.shape, strict=True)):
        raise UsageError(f"the path {path!r} needs an index into shape {array.shape}, got {list(index)}")
    return array


def _child(tree: PyTree, name: str, path: str) -> PyTree:
    if isinstance(tree, Mapping):
        if name in tree:
            return tree[name]
        names = list(tree)
    else:
        if is_dataclass(tree) and name in {f.name for f in fields(tree)}:
            return getattr(tree, name)
        names = [f.name for f in fields(tree)] if is_dataclass(tree) else []
    raise UsageError(f"the path {path!r} finds no {name!r}. Available: {', '.join(map(str, names)) or 'nothing'}")
