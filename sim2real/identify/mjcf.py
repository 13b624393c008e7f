"""The identified model as MJCF, for any tool that reads it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.identify.parameter_paths import get_leaf, set_leaf
from sim2real.identify.parameters import ParameterTable


def identified_mjcf(spec: Any, table: ParameterTable, values: Mapping[str, Any], prefix: str = "world.model.") -> str:
    """Return a model's MJCF with what was found in place of its own numbers.

    Args:
        spec: ``mujoco.MjSpec`` of the nominal model; it is not changed.
        table: Parameters; those whose ``leaf`` starts with ``prefix`` are fields of the model: ``dof_damping[0]``.
        prefix: Where in the nodes' parameters the ``mjx.Model`` stands.

    Raises:
        UsageError: When a leaf names no field of the model, or no parameter is one.
    """
    own = spec.copy()
    model = own.compile()
    found = [p for p in table if p.leaf is not None and p.leaf.startswith(prefix)]
    if not found:
        raise UsageError(f"no parameter has a leaf that starts with {prefix!r}: the MJCF would stay as it is")
    for p in found:
        path = str(p.leaf)[len(prefix) :]
        field = path.partition("[")[0]
        if not isinstance(getattr(model, field, None), np.ndarray):
            raise UsageError(f"parameter {p.name!r}: MuJoCo's model has no array {field!r}")
        tree = set_leaf({field: np.asarray(getattr(model, field))}, path, values[p.name])
        getattr(model, field)[...] = np.asarray(get_leaf(tree, field))
    own.copy_back(model)
    return own.to_xml()
