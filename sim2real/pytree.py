"""Trees of arrays: messages, states and parameters.

``@pytree.dataclass`` makes a frozen dataclass of arrays, with ``replace``, like ``flax.struct.dataclass``, whose
classes also work here. If JAX is installed, the classes are registered with it, and the functions are JAX's; otherwise
functions in Python give the same leaves in the same order.
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar, dataclass_transform

from sim2real.installation import has_jax
from sim2real.types import PyTree

T = TypeVar("T")
LEAVES = "_leaves_of_tree"
"""Attribute of a class made by ``dataclass``: names of the fields with leaves."""


def field(pytree_node: bool = True, **options: PyTree) -> PyTree:
    """Return a field of a dataclass; with ``pytree_node=False``, a constant of the tree without leaves."""
    return dataclasses.field(metadata={"pytree_node": pytree_node}, **options)


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def dataclass(cls: type[T]) -> type[T]:
    """Make a frozen dataclass that is a tree, with the method ``replace``."""
    made: PyTree = dataclasses.dataclass(frozen=True)(cls)
    is_leaf = {f.name: f.metadata.get("pytree_node", True) for f in dataclasses.fields(made)}
    names = [name for name, leaf in is_leaf.items() if leaf]
    setattr(made, LEAVES, tuple(names))
    if not hasattr(made, "replace"):
        made.replace = dataclasses.replace
    if has_jax():
        jax.tree_util.register_dataclass(made, names, [name for name in is_leaf if name not in names])
    return made


Path = tuple[str | int, ...]
"""Keys from the root to a leaf."""


class Structure(NamedTuple):
    """A tree without its leaves.

    Attributes:
        kind: Type of the node; None: a leaf.
        keys: Names or numbers of the parts.
        constants: Names and values of the fields that are constants.
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


def plain_flatten(tree: PyTree) -> tuple[list[PyTree], Structure]:
    """Return the leaves of a tree, and its structure."""
    entries, shape = plain_flatten_with_path(tree)
    return [leaf for _, leaf in entries], shape


def plain_flatten_with_path(tree: PyTree) -> tuple[list[tuple[Path, PyTree]], Structure]:
    """Return the leaves of a tree with their paths, and the tree's structure."""
    entries: list[tuple[Path, PyTree]] = []
    return entries, _walk(tree, (), entries)


def plain_map(function: Callable[..., PyTree], tree: PyTree, *others: PyTree) -> PyTree:
    """Return a tree with the results of a function of the leaves of trees of one structure."""
    values, shape = plain_flatten(tree)
    columns = [plain_flatten(other) for other in others]
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


if TYPE_CHECKING or has_jax():
    import jax
    from jax.tree_util import tree_flatten as flatten
    from jax.tree_util import tree_flatten_with_path as flatten_with_path
    from jax.tree_util import tree_leaves as leaves
    from jax.tree_util import tree_map as map
    from jax.tree_util import tree_structure as structure
    from jax.tree_util import tree_unflatten as unflatten
else:
    flatten, flatten_with_path, map = plain_flatten, plain_flatten_with_path, plain_map
    leaves = lambda tree: flatten(tree)[0]  # noqa: E731
    structure = lambda tree: flatten(tree)[1]  # noqa: E731
    unflatten = lambda shape, values: shape.unflatten(values)  # noqa: E731
