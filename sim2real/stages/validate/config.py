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
    json: bool = False
    """Print JSON instead of tables."""
