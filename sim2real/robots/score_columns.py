"""What a deployment is scored on: the columns that robots and simulations of them leave."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real.robots.contract import Robot


def as_columns(fields: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the fields ``(N, ...)`` as columns ``(N,)``: a vector's entries become ``name[i]``."""
    found = {}
    for name, values in fields.items():
        flat = np.asarray(values).reshape(len(values), -1)
        found |= {name if flat.shape[1] == 1 else f"{name}[{i}]": column for i, column in enumerate(flat.T)}
    return found


def as_sent(robot: Robot, decided: Mapping[str, Any], commanded: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns of what the supervisor sent besides its command, and of the command to the motors."""
    field = robot.drive.command
    return as_columns({**{n: v for n, v in decided.items() if n != field}, "command": commanded[field]})
