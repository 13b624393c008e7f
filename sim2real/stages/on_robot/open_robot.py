"""Opening the robot for a stage that moves it, and the printed state of its rig."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.hardware.safety.rig import Rig
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.robots.robot import Robot, Session
from sim2real.runtime.clock import realtime
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.record.config import RecordConfig
from sim2real.stages.terminal.console import note, table

LATE_SHARE = 0.01
"""Share of late answers above which the stage warns."""


@contextmanager
def opened(robot: Robot, config: RecordConfig | DeployConfig, truth_path: Path) -> Iterator[Session]:
    """Open the robot for a stage, with torque off; in a dry run with torque withheld until it is closed.

    Args:
        config: Port, limits, seed, and whether it is a dry run.

    Raises:
        UsageError: The session has no rig, or its device moves in a dry run.
    """
    if config.dry_run:
        note("dry run: torque stays off and no goal is sent; what would have been sent is logged")
    hanging = isinstance(config, RecordConfig) and not config.standing
    limits = config.gate.on(config.port)
    with robot.drive.connect(config.port, limits, truth_path, config.seed, hanging) as session, realtime():
        _require_rig(session.rig)
        if config.dry_run:
            session.rig.withhold_torque()
        announce(session, urgent=config.port != "embedded")
        yield session


def _require_rig(rig: object) -> None:
    """Refuse what has no safety gate, no guardian and no dry run: sessions come from plug-ins too."""
    if not isinstance(rig, Rig):
        raise UsageError(
            f"this robot's session has a {type(rig).__name__} for a rig",
            hint="make its `rig` a sim2real.hardware.safety.rig.Rig of a sim2real.hardware.device.Device",
        )


def announce(session: Session, urgent: bool) -> None:
    """Print what the motors do when the control process dies, and what stops them then."""
    for line in session.rig.device.without_host():
        note(f"if this process dies: {line}; the guardian takes the torque off", urgent)


def announce_following(rig: Rig) -> None:
    """Print by which figures joints are watched that do not follow their commands; or that none are."""
    following = rig.following
    if following is None:
        note("no motor is watched for letting go: how it follows its commands is not known, or following_rad is inf")
        return
    limit = np.max(following.limit)
    most = f"{limit:.0%} of their push" if following.unit == "1" else f"{limit:.2g} {following.unit}"
    note(f"a joint that is more than {most} off its commands stops the robot, by {following.source}")


def rig_summary(rig: Rig) -> dict[str, Any]:
    """Return what the rig adds to an episode's summary.

    Returns:
        ``late_replies``: answers whose sample's time is not sure, or that came after they had been asked for again;
        ``late_s``: by how much answers took longer than their bytes, median, 99 % and largest [s].
    """
    counters = rig.device.counters
    quantiles = np.quantile(counters.late_s, [0.5, 0.99, 1.0]).tolist() if counters.late_s.size else [None] * 3
    return {"late_replies": counters.late_replies, "late_s": quantiles}


def bus_use(robot: Robot, rig: Rig) -> dict[str, dict[str, list[int]]]:
    """Return for each node that talks to the device how long its transactions took; see ``BusUse`` [us]."""
    users = {SENSOR: rig.measuring, ACTUATOR: rig.commanding}
    return {name: {kind: values.tolist() for kind, values in asdict(use).items()} for name, use in users.items()}


def answer_rows(summary: Mapping[str, Any]) -> list[list[Any]]:
    """Return the row of the timing table that the bus has: answers, how late they were [ms], how many too late."""
    if "late_s" not in summary:
        return []
    late = [q if q is None else round(1e3 * q, 2) for q in summary["late_s"]]
    nothing = [None] * 3
    return [["answers", summary["transactions"], *nothing, *late, *nothing, summary["late_replies"]]]


def warn(summary: Mapping[str, Any], embedded: bool) -> None:
    """Print the warnings of a session that did not stop it."""
    share = summary["late_replies"] / max(1, summary["transactions"])
    if share > LATE_SHARE:
        note(
            f"warning: {share:.1%} of the answers came late: when those samples were taken is not sure\n"
            "hint: close what else runs on this computer"
            + ("" if embedded else ", and set the latency timer of a USB adapter to 1 ms")
        )


def show_withheld(summaries: Sequence[Mapping[str, Any]]) -> None:
    """Print what the episodes of a dry run would have sent."""
    several = len(summaries) > 1
    rows = []
    for number, summary in enumerate(summaries):
        for s in summary["sent"]:
            figures = [s["unit"], s["commands"], s["low"], s["mean"], s["high"]]
            rows.append([*([number] if several else []), s["name"], *figures])
    heads = ["would have been sent to", "unit", "commands", "min", "mean", "max"]
    print(table(rows, [*(["episode"] if several else []), *heads]))
    note("dry run: no joint was moved; no later stage uses this as a recording")
