"""The printed form of a recording session."""

from __future__ import annotations

from collections.abc import Mapping

from sim2real.stages.on_robot.episode import timing_rows
from sim2real.stages.on_robot.open_robot import show_withheld, warn
from sim2real.stages.terminal.console import table
from sim2real.types import Json


def show(summary: Mapping[str, Json], dry_run: bool) -> None:
    """Print the timing table and the warnings of a session; after a dry run the commands that stayed unsent too."""
    print(table(*timing_rows(summary)))
    warn(summary)
    if dry_run:
        show_withheld([summary])
