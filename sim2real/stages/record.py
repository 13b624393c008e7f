"""Record the robot under an excitation."""

from __future__ import annotations

import json
from pathlib import Path

from sim2real.stages.config import RecordConfig
from sim2real.stages.console import note, table
from sim2real.stages.excitation import excitation
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.rig import opened, show_withheld, warn
from sim2real.stages.robot import moving_robot
from sim2real.stages.runs import StageFolder, open_stage
from sim2real.stages.session import check_deadlines, run_episode, timing_rows

LOG = "session.mcap"
TRUTH = "truth.bin"


def run(pipeline: Pipeline, config: RecordConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Play the excitation on the robot and write the log.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder to add to; None makes a new one.
    """
    robot = moving_robot(pipeline)
    signal = excitation(config, robot.RATE_HZ, len(robot.ACTION))
    with open_stage(root, pipeline.name, "record", config, run_dir=run_dir, dry_run=config.dry_run) as stage:
        log = stage.output("log", LOG)
        note(f"recording {config.duration_s:g} s of {config.excitation} on {config.port}")
        with opened(robot, config, stage.folder / TRUTH) as session:
            nodes = robot.recording_nodes(session, signal)
            if session.embedded is not None:
                stage.output("truth", TRUTH)
            summary = run_episode(pipeline, robot, session, nodes, {}, log, config.duration_s, config, "record")
        stage.output("timing", "timing.json").write_text(json.dumps(summary, indent=1))
        print(table(*timing_rows(summary)))
        warn(summary)
        if config.dry_run:
            show_withheld([summary])
        stage.summary(
            {
                "seconds": config.duration_s,
                "lost replies": summary["lost_replies"],
                "late replies": summary["late_replies"],
                "odd measurements": len(summary["suspects"]),
                "transactions": summary["transactions"],
                "commands clamped": summary["gate"]["clamped"],
            }
        )
        if config.strict_timing:
            check_deadlines(summary)
    return stage.result
