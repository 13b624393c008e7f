"""What a stage that moves a robot says about its rig: when it opens, and afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real.hardware.rig import ServoRig
from sim2real.stages.console import note
from sim2real.stages.robot import Session

LATE_SHARE = 0.01
"""Share of late answers above which the stage warns."""


def announce(session: Session) -> None:
    """Say what the servos do by themselves when this computer's side dies, and what stops them then."""
    for line in session.rig.bus.without_host():
        note(f"if this process dies: {line}; the guardian takes the torque off")


def rig_summary(rig: ServoRig) -> dict[str, Any]:
    """Return what the rig adds to an episode's summary.

    Returns:
        ``late_replies``: answers whose sample's time is not sure, or that came after they had been asked for again;
        ``late_s``: by how much answers took longer than their bytes, median, 99 % and largest [s];
        ``suspects``: what was odd about the measurements.
    """
    late = rig.bus.late_s
    quantiles = np.quantile(late, [0.5, 0.99, 1.0]).tolist() if late.size else [None] * 3
    return {"late_replies": rig.bus.late_replies, "late_s": quantiles, "suspects": list(rig.suspects)}


def answer_rows(summary: Mapping[str, Any]) -> list[list[Any]]:
    """Return the row of the timing table that the bus has: answers, how late they were [ms], how many too late."""
    if "late_s" not in summary:
        return []
    late = [q if q is None else round(1e3 * q, 2) for q in summary["late_s"]]
    nothing = [None] * 3
    return [["answers", summary["transactions"], *nothing, *late, *nothing, summary["late_replies"]]]


def warn(summary: Mapping[str, Any]) -> None:
    """Say what was odd, but no reason to stop."""
    share = summary["late_replies"] / max(1, summary["transactions"])
    if share > LATE_SHARE:
        note(
            f"warning: {share:.1%} of the answers came late: when those samples were taken is not sure\n"
            "hint: set the adapter's latency timer to 1 ms, and close what else runs on this machine"
        )
    for suspect in summary["suspects"]:
        note(f"warning: {suspect}\nhint: does it lie on something, or does its encoder stand still?")
