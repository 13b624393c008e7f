"""Flags of validate. Imports no JAX, so that ``--help`` stays instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sim2real.stages.flag import Flag


@dataclass(frozen=True)
class ValidateConfig:
    """Score an identification on later logs."""

    parameters: Annotated[str, Flag("RUN|PIPELINE|PARAMETERS", positional=True, needed=True)] = ""
    """parameters.json, the folder of an identification, a run, or a pipeline, whose newest identification is taken."""
    log: Annotated[tuple[str, ...], Flag("FILE ...", needed=True)] = ()
    """Later logs."""
    json: bool = False
    """Print JSON instead of tables."""
    runs: Path = Path("runs")
    """Folder of all runs."""
