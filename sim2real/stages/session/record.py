"""Record the robot under an excitation."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import LOG, TRUTH, Recording
from sim2real.artifacts.run import StageFolder, open_stage
from sim2real.robots.loop import SENSOR
from sim2real.robots.nodes import recording_nodes
from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.stages.live import live_view, scene_of
from sim2real.stages.load import AnyRobot, defaults_of, moving, robot_of
from sim2real.stages.session.config import RecordConfig
from sim2real.stages.session.episode import check_deadlines, opened, show_sessions
from sim2real.stages.session.excitation import played
from sim2real.stages.shared.arguments import AnyPath, config_of, folder_of
from sim2real.stages.terminal.console import note, table
from sim2real.types import Json


def record(robot: AnyRobot, folder: AnyPath, config: RecordConfig | Mapping[str, Json] | None = None) -> Recording:
    """Play the excitation on the robot and record it.

    Args:
        robot: The robot, or the name of its pipeline.
        folder: Folder for the log; a log is never overwritten.
        config: Settings; default: the robot's. A dict has the settings that differ from these.

    Returns:
        The recording; ``summary`` has the session's timing.

    Raises:
        Sim2RealError: The robot was stopped; the log has everything up to then.
    """
    robot, folder = moving(robot_of(robot)), folder_of(folder)
    config = config_of(config, defaults_of(robot).record)
    log, truth = folder / LOG, folder / TRUTH
    signal = None if config.by_hand else played(config, robot, announce=True)
    duration_s = config.duration_s if signal is None else len(signal) / robot.drive.rate_hz
    note(f"recording {duration_s:g} s of {config.excitation} on {config.port}")
    scene, hanging = partial(scene_of, robot), not config.standing
    with live_view(config.view, folder, robot.name, scene), opened(robot, config, truth, hanging) as bench:
        if signal is None:
            bench.rig.withhold_torque()
            note("torque is off: move the robot by hand", urgent=True)
        nodes = recording_nodes(robot, bench.rig, signal, config.standing)
        bench.run_episode(nodes, {}, log, duration_s, "record")
    return Recording.load(log, truth)


def run(robot: RecordedRobot, config: RecordConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Record in a stage folder.

    Args:
        run_dir: Run folder to add to; None: a new one.
    """
    # Refuse an excitation that the robot cannot play, before a folder is made.
    robot = moving(robot)
    if not config.by_hand:
        played(config, robot)
    with open_stage(root, robot.name, "record", config, {}, run_dir, config.dry_run or config.by_hand) as stage:
        stage.output("log", LOG)
        if config.port == "embedded":
            stage.output("truth", TRUTH)
        recording = record(robot, stage.folder, config)
        summary = recording.summary
        for name, path in recording.timing.save(stage.folder).items():
            stage.output(name, path)
        show_sessions([recording], robot)
        if config.by_hand:
            _show_by_hand(recording, robot)
        stage.summary(
            {
                "seconds": config.duration_s,
                "lost replies": summary["lost_replies"],
                "late replies": summary["late_replies"],
                "transactions": summary["transactions"],
                "commands clamped": summary["gate"]["clamped"],
            }
        )
        if config.strict_timing:
            check_deadlines(summary)
    return stage.result


def _show_by_hand(recording: Recording, robot: Robot) -> None:
    """Print how far each joint was moved by hand, and the command that plays the motion."""
    outputs, rows = recording.episode.outputs[SENSOR], []
    for channel in robot.drive.channels:
        values = np.asarray(channel.of(outputs[channel.position]), np.float64)
        rows.append([channel.label or channel.position, values.min(), values.max(), np.ptp(values)])
    print(table(rows, ["joint", "lowest [rad]", "highest [rad]", "moved by [rad]"]))
    note(
        "torque was off and the torque of the hand is not measured, so this log determines no parameter\n"
        f"next: sim2real record {robot.name} --excitation {shown(recording.path)}"
    )
