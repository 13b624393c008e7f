"""The command to type after a deployment."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sim2real.artifacts.deployment import Advice, Deployment
from sim2real.artifacts.estimation.drift import Drift
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.manifest import MANIFEST
from sim2real.robots.worlds import in_world
from sim2real.stages.estimation import recording_advice
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import shown

LATER = "take longer than"
"""How the reason is put that asks for other times in training."""
ENOUGH_S = 12.0
"""So much motion in a deployment's own logs is enough to identify from [s]."""


def commands(
    told: Advice, pipeline: Pipeline, found: Identification | None, folder: Path, deployed: Deployment
) -> Advice:
    """Return advice with the command that follows it.

    Args:
        deployed: With its logs, and whether the robot has changed.
    """
    if told.status == "fine" or told.joint:
        return told
    run = ["--run", shown(folder.parent)] if (folder / MANIFEST).is_file() else []
    home = shlex.join(run)
    train = shlex.join(["sim2real", "train", *pipeline.words, *run])
    if found is None:
        return replace(told, next=shlex.join(["sim2real", "identify", *pipeline.words, *run]))
    logs = logs_to_identify([r.path for r in deployed.logs], deployed.drift, found, folder)
    terms = terms_to_identify(pipeline.identify.terms, pipeline, found, deployed.drift)
    if told.status == "not judged" or not logs:
        record = shlex.join(["sim2real", "record", *pipeline.words])
        then = shlex.join(["sim2real", "identify", *pipeline.words, "--terms", terms])
        return replace(told, next=record if terms == pipeline.identify.terms else f"{record} && {then}")
    again = recording_advice.command(pipeline, replace(pipeline.identify, log=logs, terms=terms), Path("runs"), home)
    if told.status == "re-identify":
        return replace(told, next=again)
    return replace(told, next=f"{again} && {train}" if needs_timing(told) else train)


def terms_to_identify(wanted: str, pipeline: Pipeline, found: Identification, drift: Drift | None) -> str:
    """Return which optional terms to identify with: as before, and that of what has changed, such as a payload.

    A model that lacks what has changed bends its other parameters to make up for it: that of an SO-101 which carries
    30 % more had a gain of 2.6 N m/rad, its own was 5.8.

    Args:
        wanted: What a flag or the pipeline says; see ``IdentifyConfig``.
    """
    if wanted in ("auto", "all"):
        return wanted
    robot, longest_s = in_world(pipeline.load(), found.world), pipeline.identify.max_delay_s
    table, own = robot.watched(longest_s).parameters, robot.identifiable(longest_s).parameters.terms
    changed = (drift.named or drift.likely) if drift is not None else None
    new = [p.term for p in table if changed is not None and p.name == changed.name and p.term]
    terms = tuple(dict.fromkeys([*(own if found.terms is None else found.terms), *new]))
    return wanted if terms == own else ",".join(terms) or "none"


def needs_timing(told: Advice) -> bool:
    """Return whether training has to draw its timing from a newer log: it takes that of the identification."""
    return told.status == "re-train" and any(LATER in reason for reason in told.reasons)


def logs_to_identify(own: Sequence[Path], drift: Drift | None, found: Identification, folder: Path) -> tuple[str, ...]:
    """Return the logs to identify from: the deployment's, and the recordings unless the robot has changed since then.

    Args:
        folder: The deployment's; recordings are named relative to its run.

    Returns:
        Paths, the deployment's first: training takes its timing from the first; empty where the logs are too short.
    """
    logs = tuple(shown(path) for path in own)
    if drift is not None and (drift.alarms or drift.likely):
        return logs if drift.seconds >= ENOUGH_S else ()
    before = (folder.parent / log.path for log in found.logs)
    return (*logs, *(shown(path) for path in before if path.is_file()))
