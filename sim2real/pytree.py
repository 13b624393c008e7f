"""Trees of arrays: messages, states and parameters. JAX's functions, or plain ones on a computer without JAX.

``@pytree.dataclass`` makes a frozen dataclass of arrays, with ``replace``; see ``flax.struct.dataclass``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim2real.installation import has_jax

if TYPE_CHECKING:
    from flax.struct import dataclass as dataclass
    from flax.struct import field as field
    from jax.tree_util import tree_flatten as flatten
    from jax.tree_util import tree_flatten_with_path as flatten_with_path
    from jax.tree_util import tree_leaves as leaves
    from jax.tree_util import tree_map as map
    from jax.tree_util import tree_structure as structure
    from jax.tree_util import tree_unflatten as unflatten
elif has_jax():
    from flax.struct import dataclass, field
    from jax.tree_util import tree_flatten as flatten
    from jax.tree_util import tree_flatten_with_path as flatten_with_path
    from jax.tree_util import tree_leaves as leaves
    from jax.tree_util import tree_map as map
    from jax.tree_util import tree_structure as structure
    from jax.tree_util import tree_unflatten as unflatten
else:
    from sim2real import plain_pytree as plain

    dataclass, field, map, leaves, structure = plain.dataclass, plain.field, plain.map, plain.leaves, plain.structure
    flatten, flatten_with_path, unflatten = plain.flatten, plain.flatten_with_path, plain.unflatten
