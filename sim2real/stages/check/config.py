"""Flags of check. Imports no JAX, so that ``--help`` stays instant."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from sim2real.errors import UsageError
from sim2real.stages.flag import Flag
from sim2real.stages.session.config import RecordConfig


@dataclass(frozen=True)
class CheckConfig:
    """Predict which parameters a recording, or a planned one, can determine, before a search."""

    log: Annotated[tuple[str, ...], Flag("FILE ...")] = ()
    """Logs to judge; default: the newest recording, and without one the planned excitation."""
    plan: bool = False
    """Judge the planned excitation even if there is a recording."""
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Bounds of a parameter instead of the pipeline's; repeat the flag for each parameter."""
    fix: dict[str, float] = field(default_factory=dict)
    """Value at which a parameter is fixed; repeat the flag for each parameter."""
    world: str | None = None
    """World of an installed package in which parameters are judged; default: the robot's own."""
    json: bool = False
    """Print JSON instead of tables."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    record: RecordConfig = field(default_factory=RecordConfig)
    """The planned excitation."""

    def __post_init__(self) -> None:
        """Check the fields."""
        if self.plan and self.log:
            raise UsageError("plan and log exclude each other: a plan is judged without a log")
