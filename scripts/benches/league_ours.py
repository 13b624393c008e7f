"""Our own entry in the league: what `sim2real identify` does with a pipeline as it is set up, a fold at a time."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benches import identify, recordings
from benches.league_sets import DISK_BLOCK, DISK_BLOCKS, Fold
from benches.sysid import Recording

SETS = ("disk", "xl330", "so101")
"""Sets with a pipeline of ours."""


def fit(name: str, fold: Fold, data: Path, seed: int) -> tuple[Callable[[Sequence[Recording]], list[np.ndarray]], str]:
    """Identify with the pipeline's own configuration, which takes the time that it takes.

    Args:
        name: The set, and the pipeline.
        fold: What is held out; what is fitted is read anew, as logs.
        data: Folder of all recordings.
        seed: Seed of the search.

    Returns:
        What predicts the fold's test recordings, and what was done in words.
    """
    case = identify.make_case(argparse.Namespace(case=name, **dict.fromkeys(identify.BUDGET)))
    case = replace(case, config=replace(case.config, seed=seed))
    fit_spec, test_spec = fold.spec or ("", "")
    specs = [fit_spec]
    if name == "disk":
        left = int(fit_spec.split()[1])
        specs = [f"{DISK_BLOCK * i}:{DISK_BLOCK * (i + 1)}" for i in range(DISK_BLOCKS) if i != left]
    fitted = {k: e for spec in specs for k, e in recordings.load(name, data, spec).items()}
    found = identify.identify(case, fitted)
    test = recordings.load(name, data, test_spec, recordings.PAST)

    def predict(own: Sequence[Recording]) -> list[np.ndarray]:
        columns = identify.predict(case, {"identified": found.values}, test)
        return [_at(case, columns, r, one) for r, one in enumerate(own)]

    return predict, f"{found.search.evaluations if found.search else 0} candidates, then refined"


def _at(case: Any, columns: dict[str, np.ndarray], recording: int, own: Recording) -> np.ndarray:
    """Return predicted positions at a recording's stamps, ``(N, joints)``."""
    pick = (columns["recording"] == recording) & (columns["ahead"] > 0)
    t = columns["ahead"][pick]
    return np.stack([np.interp(own.t - own.t[0], t, columns[f"{f}_identified"][pick]) for f in case.fields], axis=1)
