"""The printed form of a recording session."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from sim2real.artifacts.recording import Recording
from sim2real.robots.loop import SENSOR
from sim2real.robots.robot import Robot
from sim2real.stages.on_robot.episode import timing_rows
from sim2real.stages.on_robot.open_robot import show_withheld, warn
from sim2real.stages.terminal.console import note, shown, table
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.stages.check.stage import Checked


def show(summary: Mapping[str, Json], dry_run: bool, embedded: bool) -> None:
    """Print the timing table and the warnings of a session; after a dry run the commands that stayed unsent too."""
    print(table(*timing_rows(summary)))
    warn(summary, embedded)
    if dry_run:
        show_withheld([summary])


def show_open(checked: Checked) -> None:
    """Print which parameters the recording of a planned motion leaves open."""
    groups = [", ".join(group) for group in checked.undetermined]
    if not groups:
        note("motion: its recording determines all parameters")
        return
    note(f"motion: its recording does not determine {' or '.join(groups)}", urgent=True)
    for message in checked.messages:
        note(f"- {message}")


def show_by_hand(recording: Recording, robot: Robot) -> None:
    """Print how far each joint was moved by hand, and the command that plays the motion."""
    outputs, rows = recording.episode.outputs[SENSOR], []
    for channel in robot.sensor.channels:
        values = np.asarray(channel.of(outputs[channel.position]), np.float64)
        rows.append([channel.label or channel.position, values.min(), values.max(), np.ptp(values)])
    print(table(rows, ["joint", "lowest [rad]", "highest [rad]", "moved by [rad]"]))
    note(
        "torque was off and the torque of the hand is not measured, so this log determines no parameter\n"
        f"next: sim2real record {robot.name} --excitation {shown(recording.path)}"
    )
