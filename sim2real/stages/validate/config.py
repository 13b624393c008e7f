"""Flags of validate. Imports no JAX, so that ``--help`` stays instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sim2real.stages.flag import Flag


@dataclass(frozen=True)
class ValidateConfig:
    """Score an identification on later logs."""

    parameters: Annotated[Path | None, Flag("PARAMETERS", positional=True)] = None
    """parameters.json, or the folder of an identification."""
    log: Annotated[tuple[str, ...], Flag("FILE ...")] = ()
    """Later logs."""
    horizon_s: float = 0.0
    """Horizon of the predictions [s]; 0: that of the identification's verdict."""
    free_run_s: float = 0.0
    """Longest simulation from a single initial state [s]; 0: that of the identification's bounds."""
    force: bool = False
    """Score a log even if it was fitted."""
    json: bool = False
    """Print JSON instead of tables."""
