"""Trees of arrays in plain Python, for a computer without JAX, with JAX's leaves in JAX's order."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import NamedTuple

from sim2real.types import PyTree

LEAVES = "_leaves_of_tree"
"""Attribute of a class made by ``dataclass``: names of the fields with leaves."""


def field(pytree_node: bool = True, **options: PyTree) -> PyTree:
    """Return a field of a dataclass; ``pytree_node=False``: a constant of the tree, without leaves."""
    return dataclasses.field(metadata={"pytree_node": pytree_node}, **options)


def dataclass(cls: type) -> PyTree:
    """Make a frozen dataclass that is a tree, with the method ``replace``."""
    tree_class: PyTree = dataclasses.dataclass(frozen=True)(cls)
    names = [f.name for f in dataclasses.fields(tree_class) if f.metadata.get("pytree_node", True)]
    setattr(tree_class, LEAVES, tuple(names))
    if "replace" not in vars(tree_class):
        tree_class.replace = dataclasses.replace
    return tree_class


Path = tuple[str | int, ...]
"""Keys on the way to a leaf."""


class Structure(NamedTuple):
    """A tree without its leaves.

    Attributes:
        kind: Type of the node; None: a leaf.
        keys: Names or numbers of the parts.
        constants: Names and values of the fields that are no parts.
    """

    kind: type | None
    keys: Path = ()
    parts: tuple[Structure, ...] = ()
    constants: tuple[tuple[str, PyTree], ...] = ()

    def unflatten(self, leaves: Sequence[PyTree]) -> PyTree:
        """Return the tree with these leaves."""
        return _build(self, iter(leaves))

    def __repr__(self) -> str:
        if self.kind is None:
            return "*"
        inner = ", ".join(f"{key}={part!r}" for key, part in zip(self.keys, self.parts, strict=True))
        return f"{self.kind.__name__}({inner})"


_LEAF = Structure(None)


def structure(tree: PyTree) -> Structure:
    """Return the structure of a tree."""
    return flatten(tree)[1]


def leaves(tree: PyTree) -> list[PyTree]:
    """Return the leaves of a tree."""
    return flatten(tree)[0]


def flatten(tree: PyTree) -> tuple[list[PyTree], Structure]:
    """Return the leaves of a tree, and its structure."""
    entries, shape = flatten_with_path(tree)
    return [leaf for _, leaf in entries], shape


def flatten_with_path(tree: PyTree) -> tuple[list[tuple[Path, PyTree]], Structure]:
    """Return the leaves of a tree with their keys on the way, and the tree's structure."""
    entries: list[tuple[Path, PyTree]] = []
    return entries, _walk(tree, (), entries)


def unflatten(shape: Structure, values: Sequence[PyTree]) -> PyTree:
    """Return the tree of a structure with these leaves."""
    return shape.unflatten(values)


def map(function: Callable[..., PyTree], tree: PyTree, *others: PyTree) -> PyTree:
    """Return a tree with the results of a function of the leaves of trees of one structure."""
    values, shape = flatten(tree)
    columns = [flatten(other) for other in others]
    if any(other != shape for _, other in columns):
        raise ValueError(f"trees differ: {shape} and {[other for _, other in columns]}")
    return shape.unflatten([function(*row) for row in zip(values, *(c[0] for c in columns), strict=True)])


def _walk(node: PyTree, path: Path, entries: list[tuple[Path, PyTree]]) -> Structure:
    """Append the leaves below a node; return its structure."""
    kind, constants = type(node), ()
    if node is None:
        keys, parts = (), ()
    elif LEAVES in vars(kind):
        keys = getattr(kind, LEAVES)
        parts = [getattr(node, key) for key in keys]
        constants = tuple((f.name, getattr(node, f.name)) for f in dataclasses.fields(node) if f.name not in keys)
    elif kind in (dict, OrderedDict):
        keys = tuple(node) if kind is OrderedDict else tuple(sorted(node))
        parts = [node[key] for key in keys]
    elif kind in (list, tuple) or (isinstance(node, tuple) and hasattr(kind, "_fields")):
        keys = getattr(kind, "_fields", range(len(node)))
        parts = list(node)
    else:
        entries.append((path, node))
        return _LEAF
    inner = tuple(_walk(part, (*path, key), entries) for key, part in zip(keys, parts, strict=True))
    return Structure(kind, tuple(keys), inner, constants)


def _build(shape: Structure, values: PyTree) -> PyTree:
    kind = shape.kind
    if kind is None:
        return next(values)
    parts = [_build(part, values) for part in shape.parts]
    if kind is type(None):
        return None
    if LEAVES in vars(kind):
        return kind(**{str(key): part for key, part in zip(shape.keys, parts, strict=True)}, **dict(shape.constants))
    if kind in (dict, OrderedDict):
        return kind(zip(shape.keys, parts, strict=True))
    return kind(*parts) if hasattr(kind, "_fields") else kind(parts)
