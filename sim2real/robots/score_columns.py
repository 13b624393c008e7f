"""The columns that a deployment and its simulation are scored on."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real.robots.contract import Robot
from sim2real.types import PyTree


def as_columns(fields: Mapping[str, PyTree]) -> dict[str, np.ndarray]:
    """Return the fields ``(N, ...)`` as columns ``(N,)``: a vector's entries become ``name[i]``."""
    columns = {}
    for name, values in fields.items():
        flat = np.asarray(values).reshape(len(values), -1)
        columns |= {name if flat.shape[1] == 1 else f"{name}[{i}]": column for i, column in enumerate(flat.T)}
    return columns


def as_sent(robot: Robot, decided: Mapping[str, Any], commanded: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns of the supervisor's message without its command, and of the command to the motors."""
    field = robot.drive.command
    return as_columns({**{n: v for n, v in decided.items() if n != field}, "command": commanded[field]})
