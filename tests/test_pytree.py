"""Trees of arrays: JAX's and flax's, and the same leaves in the same order without JAX."""

import dataclasses
from collections import OrderedDict
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from sim2real import pytree

plain = SimpleNamespace(
    dataclass=pytree.dataclass,
    field=pytree.field,
    flatten=pytree.plain_flatten,
    flatten_with_path=pytree.plain_flatten_with_path,
    map=pytree.plain_map,
    leaves=lambda tree: pytree.plain_flatten(tree)[0],
    structure=lambda tree: pytree.plain_flatten(tree)[1],
    unflatten=lambda shape, values: shape.unflatten(values),
)
"""What the module offers on a computer without JAX."""


class Pair(NamedTuple):
    b: object
    a: object


def message(make):
    """Return a class of messages, made by flax or in plain Python."""

    @make.dataclass
    class Message:
        second: object
        first: object
        name: object = make.field(pytree_node=False, default="constant")

    return Message


TREES = [
    lambda make: 1.0,
    lambda make: None,
    lambda make: {"b": 1, "a": [2, (3, None)], "c": OrderedDict(z=4, y=5)},
    lambda make: Pair({"x": 1}, [2]),
    lambda make: message(make)(first=[1, 2], second={"q": 3, "p": 4}, name="n"),
    lambda make: {"deep": [message(make)(1, message(make)(2, 3))]},
    lambda make: [],
]


@pytest.mark.parametrize("tree", TREES)
def test_leaves_are_those_of_jax_in_its_order_and_make_the_tree_again(tree):
    ours, theirs = tree(plain), tree(struct)
    assert plain.leaves(ours) == jax.tree_util.tree_leaves(theirs)
    paths = [".".join(map(str, path)) for path, _ in plain.flatten_with_path(ours)[0]]
    names = [
        ".".join(str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path)
        for path, _ in jax.tree_util.tree_flatten_with_path(theirs)[0]
    ]
    assert paths == names
    values, structure = plain.flatten(ours)
    assert plain.unflatten(structure, values) == ours
    assert plain.structure(ours) == structure
    assert plain.leaves(plain.map(lambda a, b: a + b, ours, ours)) == [2 * value for value in values]


def test_constants_belong_to_the_structure():
    kind = message(plain)
    assert plain.structure(kind(1, 2, "n")) != plain.structure(kind(1, 2, "m"))
    assert plain.leaves(kind(1, 2).replace(first=5)) == [1, 5]
    with pytest.raises(ValueError, match="trees differ"):
        plain.map(lambda a, b: a, {"a": 1}, {"b": 1})
    with pytest.raises(dataclasses.FrozenInstanceError):
        kind(1, 2).first = 3


def test_with_jax_its_classes_are_those_of_flax():
    ours, theirs = message(pytree), message(struct)
    kind, other = (make(first=[1, jnp.zeros(2)], second={"q": 3.0}, name="n") for make in (ours, theirs))
    assert jax.tree.leaves(jax.tree.map(np.shape, kind)) == jax.tree.leaves(jax.tree.map(np.shape, other))
    paths = [[jax.tree_util.keystr(p) for p, _ in pytree.flatten_with_path(tree)[0]] for tree in (kind, other)]
    assert paths[0] == paths[1]
    assert jax.jit(lambda tree: tree.replace(second=tree.first))(kind).second[0] == 1
    assert jax.tree.structure(kind) != jax.tree.structure(kind.replace(name="m"))
