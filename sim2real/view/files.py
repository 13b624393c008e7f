"""Reading what stages wrote: JSON and arrays, with errors that name the file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.view.run import Artifact


class blaming:  # noqa: N801 - reads as a statement: with blaming(path, artifact)
    """Turns what a malformed file raises into an error that names the file."""

    def __init__(self, path: Path, artifact: Artifact) -> None:
        self.path, self.artifact = path, artifact

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Sim2RealError) or not isinstance(
            error, ValueError | KeyError | TypeError | AttributeError | IndexError | OSError
        ):
            return
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
        raise Sim2RealError(f"{self.path} is malformed: {reason}", hint=self.artifact.again) from error


def check(good: bool, reason: str) -> None:
    """Raise ValueError unless something is as it should be."""
    if not good:
        raise ValueError(reason)


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file."""
    data = json.loads(path.read_text(encoding="utf-8"))
    check(isinstance(data, dict), "not a JSON object")
    return data


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file."""
    import zipfile

    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (zipfile.BadZipFile, EOFError) as error:
        raise ValueError(str(error)) from error


def read_number(value: Any, missing: float | None = None) -> Any:
    """Return a number; ``missing`` for null; JSON spells infinite ones and NaN as strings."""
    if value is None:
        return missing
    found = float(value)
    return missing if missing is None and math.isnan(found) else found


def read_numbers(values: Sequence[Any]) -> np.ndarray:
    """Return nested lists of numbers as an array, NaN for null."""

    def flat(value: Any) -> Any:
        return [flat(v) for v in value] if isinstance(value, list) else read_number(value, math.nan)

    return np.array(flat(list(values)), np.float64)
