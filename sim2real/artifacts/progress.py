"""Curves that a stage writes while it computes, for a viewer that joins it."""

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

PROGRESS = "progress.jsonl"
"""One line for each point of the curves: ``epoch_ns`` and ``values``, name -> a number for each seed."""


def write_progress(folder: Path, values: Mapping[str, np.ndarray | float]) -> None:
    """Append a point to the curves of a stage. A full disk is no reason to stop it."""
    rows = {name: np.atleast_1d(np.asarray(value, np.float64)).tolist() for name, value in values.items()}
    with suppress(OSError), open(folder / PROGRESS, "a", encoding="utf-8") as stream:
        stream.write(json.dumps({"epoch_ns": time.time_ns(), "values": rows}) + "\n")
