"""How an identification is scored on later logs; every field is a flag. Imports no JAX."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg


@dataclass(frozen=True)
class ValidateConfig:
    """Score what was identified on later logs."""

    parameters: Annotated[Positional[Path | None], arg(metavar="PARAMETERS")] = None
    """parameters.json, or the folder of an identification."""
    log: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Log that was not identified from, one flag a log."""
    horizon_s: float = 0.0
    """How far ahead is predicted [s]; 0: as far as the identification was judged."""
    free_run_s: float = 10.0
    """Longest simulation from a single initial state [s]."""
    mapping: Annotated[Path | None, arg(metavar="FILE")] = None
    """Mapping of logs of another recorder; default: the pipeline's, or one is proposed."""
    force: bool = False
    """Score a log that was fitted all the same."""
    json: bool = False
    """Print JSON instead of tables."""
