"""Where the milliseconds go between a motion and the motion that answers it: steps on the robot, judged in 30 s."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sim2real.artifacts.estimation.links import links_table
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import LOG, TRUTH, Recording
from sim2real.artifacts.run.run_folder import StageFolder, open_stage
from sim2real.robots.contract import Robot
from sim2real.stages.excitation.signals import excitation
from sim2real.stages.identify.stage import identify
from sim2real.stages.latency.config import LatencyConfig
from sim2real.stages.latency.result import Latency
from sim2real.stages.on_robot.open_robot import show_withheld, warn
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.record.stage import record
from sim2real.stages.terminal.console import artifact_table, note, progress, table

_PICTURE = "latency.png"


def run(pipeline: Pipeline, config: LatencyConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Test the latency in a folder of its own; in a dry run nothing moves, and the device's share stays unknown.

    Args:
        config: The steps, and how the motion is judged.
        run_dir: Run folder to add to; None makes a new one.
    """
    robot = moving_robot(pipeline)
    excitation(
        config, robot.rate_hz, len(robot.agent.action)
    )  # what cannot be played is refused before a folder is made
    with open_stage(root, pipeline.name, "latency", config, run_dir=run_dir, dry_run=config.dry_run) as stage:
        stage.output("log", LOG)
        if config.port == "embedded":
            stage.output("truth", TRUTH)
        recording = record(pipeline, stage.folder, config)
        summary = recording.summary
        warn(summary)
        found = None if config.dry_run else identify(pipeline, recording, config.identify)
        if config.dry_run:
            show_withheld([summary])
        chain = chain_of(robot)
        latency = Latency.of(recording, chain, found)
        for name, path in {**recording.timing.save(stage.folder), **latency.save(stage.folder)}.items():
            stage.output(name, path)
        with progress(None, "latency: picture"):
            from sim2real.stages.latency.figure import picture  # matplotlib takes 0.5 s to import

            picture(stage.output("picture", _PICTURE), latency, recording, chain, found.links if found else ())
        print(table(*rows(latency)))
        if found is not None and found.links:
            print(artifact_table(links_table(found.links)))
        stage.summary(_summary(latency, found, recording))
    return stage.result


def chain_of(robot: Robot) -> tuple[str, str, str]:
    """Return the nodes that a measurement passes on its way to a motor, in this order."""
    return robot.roles.sensor, robot.roles.supervisor, robot.roles.actuator


def rows(latency: Latency) -> tuple[list[list[Any]], list[str]]:
    """Return the table of a latency: rows and headers, times in ms."""
    lines: list[list[Any]] = [
        [p.name, p.where if p.counted else f"({p.where})", *_ms(p.took.p50, p.took.p99, p.took.max)]
        for p in latency.parts
    ]
    if hidden := latency.hidden:
        lines.append([f"{hidden.about}, from the motion", "device", *_ms(hidden.estimate), None, None])
    lines.append(["sum of the medians, without what is in ()", "", *_ms(latency.total_s), None, None])
    return lines, ["part", "where", "p50", "p99", "max [ms]"]


def _ms(*seconds: float | None) -> list[float | None]:
    return [None if s is None else round(1e3 * s, 2) for s in seconds]


def _summary(latency: Latency, found: Identification | None, recording: Recording) -> dict[str, Any]:
    lines: dict[str, Any] = {}
    if (hidden := latency.hidden) is not None:
        lines["device"] = (
            f"{1e3 * hidden.estimate:.1f} ms [{1e3 * hidden.low95:.1f}, {1e3 * hidden.high95:.1f}], {hidden.verdict}"
        )
    for where in ("host", "bus"):
        own = [p.took.p50 or 0.0 for p in latency.parts if p.where == where and p.counted]
        lines[where] = f"{1e3 * sum(own):.1f} ms, by medians"
    if latency.transactions is not None:
        lines["lost answers"] = f"{latency.lost} of {latency.transactions}"
        lines["late answers"] = latency.late
    if found is not None and found.verdict.status != "accepted":
        note(f"the motion's share comes from an identification that is not accepted: {found.verdict.status}")
        for reason in found.verdict.reasons:
            note(f"  {reason}")
    lines["seconds"] = recording.episode.duration_s
    return lines
