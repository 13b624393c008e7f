"""The command to type after a deployment."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

from sim2real.artifacts.deployment import Advice, Deployment
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.manifest import MANIFEST
from sim2real.stages import advice
from sim2real.stages.console import shown
from sim2real.stages.pipeline import Pipeline

ENOUGH_S = 12.0
"""So much of a deployment's own logs is enough to identify from [s]."""


def commands(
    told: Advice, pipeline: Pipeline, found: Identification | None, folder: Path, deployed: Deployment
) -> Advice:
    """Return advice with the command that follows it.

    Args:
        told: The verdict.
        pipeline: The robot.
        found: What was identified.
        folder: The deployment's.
        deployed: With its logs, and whether the robot has changed.
    """
    if told.status == "fine" or told.joint:
        return told
    run = ["--run", shown(folder.parent)] if (folder / MANIFEST).is_file() else []
    home = shlex.join(run)
    train = shlex.join(["sim2real", "train", *pipeline.words, *run])
    if found is None:
        return replace(told, next=shlex.join(["sim2real", "identify", *pipeline.words, *run]))
    logs = logs_to_identify(deployed, found, folder)
    if told.status == "not judged" or not logs:
        return replace(told, next=shlex.join(["sim2real", "record", *pipeline.words]))
    again = advice.command(pipeline, replace(pipeline.identify, log=logs), Path("runs"), home)
    late = told.status == "re-train" and any("take longer" in reason for reason in told.reasons)
    if told.status == "re-identify":
        return replace(told, next=again)
    return replace(told, next=f"{again} && {train}" if late else train)


def logs_to_identify(deployed: Deployment, found: Identification, folder: Path) -> tuple[str, ...]:
    """Return the logs to identify from: the deployment's, and the recordings unless the robot has changed since then.

    Args:
        deployed: The deployment.
        found: What was identified.
        folder: The deployment's; recordings are named relative to its run.

    Returns:
        Paths, the deployment's first: training takes its timing from the first; empty where the logs are too short.
    """
    own = tuple(shown(r.path) for r in deployed.recordings)
    if deployed.drift is not None and deployed.drift.alarms:
        return own if sum(r.episode.duration_s for r in deployed.recordings) >= ENOUGH_S else ()
    before = (folder.parent / log.path for log in found.logs)
    return (*own, *(shown(path) for path in before if path.is_file()))
