"""The command to type after a deployment."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sim2real.artifacts.deployment import Advice, Deployment, Drift
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run import MANIFEST
from sim2real.robots.robot import RecordedRobot, in_world
from sim2real.stages.load import defaults_of
from sim2real.stages.shared.identification import command
from sim2real.stages.terminal.console import shown

LATER = "take longer than"
"""Words of the reason for new timing in training."""
PAUSED = "to pauses of its nodes"
"""Words of the reason for another deployment."""
ENOUGH_S = 12.0
"""Length of a deployment's logs that suffices to identify from [s]."""


def with_command(
    advice: Advice, robot: RecordedRobot, identification: Identification | None, folder: Path, deployment: Deployment
) -> Advice:
    """Return advice with the command that carries it out.

    Args:
        deployment: With its logs and the drift of the robot.
    """
    if advice.status == "fine" or advice.joint:
        return advice
    run = ["--run", shown(folder.parent)] if (folder / MANIFEST).is_file() else []
    train = shlex.join(["sim2real", "train", robot.name, *run])
    if identification is None:
        return replace(advice, next=shlex.join(["sim2real", "identify", robot.name, *run]))
    logs = logs_to_identify([r.path for r in deployment.logs], deployment.drift, identification, folder)
    terms = terms_to_identify(defaults_of(robot).identify.terms, robot, identification, deployment.drift)
    if advice.status == "not judged" and any(PAUSED in reason for reason in advice.reasons):
        return replace(advice, next=shlex.join(["sim2real", "deploy", robot.name, *run]))
    # Without logs that suffice the robot is recorded first.
    if advice.status == "not judged" or not logs:
        record = shlex.join(["sim2real", "record", robot.name])
        identify = shlex.join(["sim2real", "identify", robot.name, "--terms", terms])
        return replace(advice, next=record if terms == defaults_of(robot).identify.terms else f"{record} && {identify}")
    config = replace(defaults_of(robot).identify, log=logs, terms=terms)
    identify = command(robot, config, Path("runs"), shlex.join(run))
    if advice.status == "re-identify":
        return replace(advice, next=identify)
    return replace(advice, next=f"{identify} && {train}" if needs_timing(advice) else train)


def terms_to_identify(
    configured: str, robot: RecordedRobot, identification: Identification, drift: Drift | None
) -> str:
    """Return the optional terms to identify with: those of the identification, and that of the parameter that changed.

    A model without the changed term, such as a payload, bends its other parameters instead.

    Args:
        configured: ``terms`` of ``IdentifyConfig``.
    """
    if configured in ("auto", "all"):
        return configured
    robot, max_delay_s = in_world(robot, identification.world), defaults_of(robot).identify.max_delay_s
    watched, default = robot.watched(max_delay_s).parameters, robot.identifiable(max_delay_s).parameters.terms
    changed = (drift.named or drift.likely) if drift is not None else None
    added = [p.term for p in watched if changed is not None and p.name == changed.name and p.term]
    before = default if identification.terms is None else identification.terms
    terms = tuple(dict.fromkeys([*before, *added]))
    return configured if terms == default else ",".join(terms) or "none"


def needs_timing(advice: Advice) -> bool:
    """Return whether training needs timing from a newer log; it takes the timing of the identification."""
    return advice.status == "re-train" and any(LATER in reason for reason in advice.reasons)


def logs_to_identify(
    deployed: Sequence[Path], drift: Drift | None, identification: Identification, folder: Path
) -> tuple[str, ...]:
    """Return the logs to identify from: the deployment's, and those of the identification if the robot has not changed.

    Args:
        deployed: Logs of the deployment.
        folder: Folder of the deployment; the identification names its logs relative to the run.

    Returns:
        Paths, the deployment's first, because training takes its timing from the first; empty if the logs are too
        short.
    """
    logs = tuple(shown(path) for path in deployed)
    if drift is not None and (drift.alarms or drift.likely):
        return logs if drift.seconds >= ENOUGH_S else ()
    identified = (folder.parent / log.path for log in identification.logs)
    return (*logs, *(shown(path) for path in identified if path.is_file()))
