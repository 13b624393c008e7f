"""Flags of validate. Imports no JAX, so that ``--help`` stays instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg


@dataclass(frozen=True)
class ValidateConfig:
    """Score an identification on later logs."""

    parameters: Annotated[Positional[Path | None], arg(metavar="PARAMETERS")] = None
    """parameters.json, or the folder of an identification."""
    log: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Later logs."""
    horizon_s: float = 0.0
    """Horizon of the predictions [s]; 0: that of the identification's verdict."""
    free_run_s: float = 0.0
    """Longest simulation from a single initial state [s]; 0: that of the identification's bounds."""
    mapping: Annotated[Path | None, arg(metavar="FILE")] = None
    """Mapping of logs of another recorder; default: the pipeline's, or one is proposed."""
    force: bool = False
    """Score a log even if it was fitted."""
    json: bool = False
    """Print JSON instead of tables."""
