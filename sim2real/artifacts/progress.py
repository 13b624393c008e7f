"""Files that a stage writes while it computes, for a viewer that joins it: curves, and the best fit so far."""

import json
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.files import replacing

PROGRESS = "progress.jsonl"
"""One line for each point of the curves: ``epoch_ns`` and ``values``, name -> a number for each seed."""
BEST_FIT = "best_fit.npz"
"""Columns of the segments, see ``Identification.samples``."""


def write_progress(folder: Path, values: Mapping[str, np.ndarray | float]) -> None:
    """Append a point to the curves of a stage. A full disk is no reason to stop it."""
    rows = {name: np.atleast_1d(np.asarray(value, np.float64)).tolist() for name, value in values.items()}
    with suppress(OSError), open(folder / PROGRESS, "a", encoding="utf-8") as stream:
        stream.write(json.dumps({"epoch_ns": time.time_ns(), "values": rows}) + "\n")


def write_best_fit(folder: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Replace the best fit so far, at once: a reader never sees a part of it."""
    arrays: dict[str, Any] = dict(columns)
    with suppress(OSError), replacing(folder / BEST_FIT) as stream:
        np.savez(stream, **arrays)
