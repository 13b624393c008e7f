"""The stage latency: steps on the robot, and the parts of the delay between a motion and the motion that answers it."""

from pathlib import Path

from sim2real.artifacts.recording import LOG, TRUTH
from sim2real.artifacts.run.run_folder import StageFolder, open_stage
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR
from sim2real.robots.robot import Robot
from sim2real.stages.excitation.signals import excitation
from sim2real.stages.identify.stage import identify
from sim2real.stages.latency.config import LatencyConfig
from sim2real.stages.latency.result import Latency
from sim2real.stages.latency.show import latency_summary, show
from sim2real.stages.on_robot.open_robot import show_withheld, warn
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.record.stage import record
from sim2real.stages.terminal.console import progress

_PICTURE = "latency.png"


def run(pipeline: Pipeline, config: LatencyConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Test the latency in a folder of its own; in a dry run nothing moves, and the device's share stays unknown.

    Args:
        run_dir: Run folder to add to; None: a new one.
    """
    # Refuse an excitation that the robot cannot play, before a folder is made.
    robot = moving_robot(pipeline)
    excitation(config, robot.rate_hz, len(robot.agent.action))
    with open_stage(root, pipeline.name, "latency", config, run_dir=run_dir, dry_run=config.dry_run) as stage:
        # Record the steps.
        stage.output("log", LOG)
        if config.port == "embedded":
            stage.output("truth", TRUTH)
        recording = record(pipeline, stage.folder, config)
        warn(recording.summary)

        # Estimate the device's share from the motion.
        identification = None if config.dry_run else identify(pipeline, recording, config.identify)
        if config.dry_run:
            show_withheld([recording.summary])
        chain = chain_of(robot)
        latency = Latency.of(recording, chain, identification)
        for name, path in {**recording.timing.save(stage.folder), **latency.save(stage.folder)}.items():
            stage.output(name, path)

        # Draw and print.
        with progress(None, "latency: picture"):
            from sim2real.stages.latency.figure import picture  # matplotlib takes 0.5 s to import

            links = identification.links if identification else ()
            picture(stage.output("picture", _PICTURE), latency, recording, chain, links)
        show(latency, identification)
        stage.summary(latency_summary(latency, recording.episode.duration_s))
    return stage.result


def chain_of(robot: Robot) -> tuple[str, str, str]:
    """Return the nodes that a measurement passes on its way to a motor, in this order."""
    return SENSOR, AGENT, ACTUATOR
