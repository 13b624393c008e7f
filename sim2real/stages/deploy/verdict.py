"""The verdict on a deployment, by a table of rules, and the next command."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import GOOD_SUCCESS
from sim2real.artifacts.deployment import Deployment, Drift, Finding, Reason, Status, Verdict, as_here
from sim2real.artifacts.identification import ComparedError, Identification
from sim2real.artifacts.paths import shown
from sim2real.artifacts.run import MANIFEST, finished
from sim2real.errors import OtherMotion, Sim2RealError
from sim2real.installation import has_jax
from sim2real.robots.robot import RecordedRobot, watched
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.load import defaults_of
from sim2real.stages.shared.identification import command
from sim2real.stages.terminal.console import progress
from sim2real.stages.terminal.interruption import patiently

_FAULTY_RATIO = 1.6
"""No parameters explain a joint's motion if the error, with parameters fitted to the deployment, is more than this many
times the expected error.
"""
_MAX_UNEXPLAINED = 0.5
"""Nor do parameters explain the motion if a fit to the log leaves more than this share of the error."""
_MAX_LATE_SHARE = 0.01
"""Largest share of steps that may take longer than the longest step of training."""
_MAX_PAUSES_S = 0.1
"""Longest time that an episode may lose in pauses [s]: beyond it, a policy that fails is not judged."""
_ENOUGH_S = 12.0
"""Shortest length of a deployment's logs from which to identify [s]."""


def judge(
    deployment: Deployment, robot: RecordedRobot, identification: Identification | None, folder: Path
) -> Deployment:
    """Return a deployment with the tests of its model, and a verdict.

    Args:
        robot: In the world of the identification.
        identification: The model; None: it is not tested.
        folder: Folder of the deployment, which the next command names.
    """
    deployment = _tested(deployment, robot, identification)
    verdict = decide(deployment)
    if identification is not None:
        usual = defaults_of(robot).identify
        verdict = replace(verdict, terms=terms_to_identify(usual, robot, identification, deployment.drift))
    typed = next_command(verdict, deployment, robot, identification, folder)
    return replace(deployment, verdict=replace(verdict, next=typed))


def _tested(deployment: Deployment, robot: RecordedRobot, identification: Identification | None) -> Deployment:
    """Return a deployment with the tests of the model on its logs; a test that fails must not lose the deployment."""
    if identification is None:
        return replace(deployment, untested=Reason(Finding.NO_MODEL))
    if not has_jax():
        log = shown(deployment.logs[0].path)
        text = f"a computer with JAX tests the model: `sim2real validate RUN/identify --log {log}`"
        return replace(deployment, untested=Reason(Finding.UNTESTED, text))
    from sim2real.stages.deploy.replay import tested

    try:
        with progress(None, "test the model on the deployment"):
            replay, drift = patiently(lambda: tested(robot, identification, [r.episode for r in deployment.logs]))
    except OtherMotion as error:
        return replace(deployment, untested=Reason(Finding.OTHER_MOTION, str(error.args[0])))
    except (Sim2RealError, ArithmeticError, np.linalg.LinAlgError) as error:
        return replace(deployment, untested=Reason(Finding.UNTESTED, str(error.args[0])))
    return replace(deployment, replay=tuple(replay), drift=drift)


# -- the rules: the first one whose findings are not empty decides


def decide(deployment: Deployment) -> Verdict:
    """Return the verdict on a deployment, without the next command: the first rule that finds something decides."""
    for find, status, stages in RULES:
        if reasons := find(deployment):
            return Verdict(status, tuple(reasons), stages)
    raise AssertionError("the last rule always finds something")


def _no_comparison(d: Deployment) -> list[Reason]:
    """There is neither a model to test nor a simulation."""
    nothing = d.untested == Reason(Finding.NO_MODEL) and not any(e.simulation for e in d.episodes)
    return [Reason(Finding.NO_MODEL)] if nothing else []


def _unexplained(d: Deployment) -> list[Reason]:
    """No parameters explain the motion, not even those fitted to these logs: identifying again would not help."""
    fitted = {r.joint: _ratio(as_here(r)) for r in d.replay}
    left = {r.joint: fitted[r.joint] / max(_ratio(r), 1e-9) for r in d.replay}
    faulty = [name for name in fitted if fitted[name] > _FAULTY_RATIO and not left[name] <= _MAX_UNEXPLAINED]
    return [Reason(Finding.UNEXPLAINED, max(faulty, key=lambda name: fitted[name]))] if faulty else []


def _harmless(d: Deployment) -> list[Reason]:
    """A parameter changed, but all predictions are within their expected errors and the policy succeeds."""
    holds = all(r.ratio is not None and r.ratio <= 1.0 for r in d.replay)
    return [Reason(Finding.SUCCESS), *_changed(d)] if holds and _changed(d) and not _failed(d) else []


def _changed(d: Deployment) -> list[Reason]:
    """The drift test found a changed parameter."""
    return [Reason(Finding.CHANGED, d.drift.named.name)] if d.drift and d.drift.named else []


def _wrong(d: Deployment) -> list[Reason]:
    """Errors are above the expected ones; the worst joint comes first."""
    exceeded = sorted((r for r in d.replay if r.exceeded), key=_ratio, reverse=True)
    wrong = [Reason(Finding.WRONG, r.joint) for r in exceeded]
    likely = [Reason(Finding.LIKELY, d.drift.likely.name)] if d.drift and d.drift.likely else []
    return [*wrong, *likely] if wrong else []


def _paused(d: Deployment) -> list[Reason]:
    """The policy failed in an episode with pauses, which simulations do not have."""
    lost = max(e.paused_s for e in d.episodes) > _MAX_PAUSES_S
    return [Reason(Finding.PAUSED), *_failed(d)] if lost and _failed(d) else []


def _failed_late(d: Deployment) -> list[Reason]:
    """The policy failed while steps took longer than in training: train with the timing of a newer log."""
    return _failed(d) if _late(d) else []


def _failed(d: Deployment) -> list[Reason]:
    """The policy failed too often; if the task has no success, late steps count instead."""
    success = d.score("success").real
    if success is None:
        return [*_late(d), _model(d)] if _late(d) else []
    return [*_late(d), Reason(Finding.SUCCESS), _model(d)] if success < GOOD_SUCCESS else []


def _not_tested(d: Deployment) -> list[Reason]:
    """The model could not be tested, so that success may be luck."""
    return [d.untested] if d.untested is not None and d.untested.finding is Finding.UNTESTED else []


def _good(d: Deployment) -> list[Reason]:
    """No other rule applies."""
    return [Reason(Finding.SUCCESS), _model(d), *_late(d)]


RULES: tuple[tuple[Callable[[Deployment], list[Reason]], Status, tuple[str, ...]], ...] = (
    # finding        verdict               stages to run next
    (_no_comparison, "not judged",         ("identify",)),
    (_unexplained,   "look at this joint", ()),
    (_harmless,      "fine",               ()),
    (_changed,       "re-identify",        ("identify",)),
    (_wrong,         "re-identify",        ("identify",)),
    (_paused,        "not judged",         ("deploy",)),
    (_failed_late,   "re-train",           ("identify", "train")),
    (_failed,        "re-train",           ("train",)),
    (_not_tested,    "not judged",         ("record",)),
    (_good,          "fine",               ()),
)  # fmt: skip


def _late(d: Deployment) -> list[Reason]:
    nodes = dict.fromkeys(node for e in d.episodes for node in e.late)
    return [Reason(Finding.LATE, node) for node in nodes if d.late_share(node) > _MAX_LATE_SHARE]


def _model(d: Deployment) -> Reason:
    return d.untested or Reason(Finding.HOLDS)


def _ratio(row: ComparedError) -> float:
    """Return the ratio of an error to the expected one: 1 without one, infinite if the model diverged."""
    return 1.0 if row.ratio is None else row.ratio


# -- the command to type next


def next_command(
    verdict: Verdict,
    deployment: Deployment,
    robot: RecordedRobot,
    identification: Identification | None,
    folder: Path,
) -> str:
    """Return the command that runs the next stages; "" if none is needed.

    Args:
        deployment: With its logs and the drift of the robot.
        folder: Folder of the deployment.
    """
    run = ["--run", shown(folder.parent)] if (folder / MANIFEST).is_file() else []
    stages, default = verdict.stages, defaults_of(robot).identify
    if not stages:
        return ""
    if identification is None and finished(folder.parent, "record") is None:
        stages = ("record", *stages)
    typed = {stage: shlex.join(["sim2real", stage, robot.name, *run]) for stage in stages}
    if identification is None:
        return " && ".join(typed.values())
    then = [typed[stage] for stage in stages if stage in ("train", "deploy")]
    if "identify" not in stages and "record" not in stages:
        return " && ".join(then)
    usual = replace(default, terms=verdict.terms)
    logs = logs_to_identify([r.path for r in deployment.logs], deployment.drift, identification, folder)
    # If the logs do not suffice, record the robot first.
    if "record" in stages or not logs:
        record = shlex.join(["sim2real", "record", robot.name])
        identify = shlex.join(["sim2real", "identify", robot.name, "--terms", verdict.terms])
        return record if verdict.terms == default.terms else f"{record} && {identify}"
    return " && ".join([command(robot, replace(usual, log=logs), Path("runs"), shlex.join(run)), *then])


def terms_to_identify(
    usual: IdentifyConfig, robot: RecordedRobot, identification: Identification, drift: Drift | None
) -> str:
    """Return the optional terms to identify with next; see ``Verdict``.

    Args:
        usual: The robot's settings.
        robot: In the world of the identification.
    """
    if usual.terms in ("auto", "all"):
        return usual.terms
    default = robot.identifiable(usual.max_delay_s).parameters.terms
    before = default if (used := identification.used_terms) is None else used
    changed = None if drift is None else drift.named or drift.likely
    offered = {p.name: p.term for p in watched(robot, usual.max_delay_s).parameters}
    added = "" if changed is None else offered.get(changed.name, "")
    terms = (*before, added) if added and added not in before else before
    return usual.terms if terms == default else ",".join(terms) or "none"


def logs_to_identify(
    deployed: Sequence[Path], drift: Drift | None, identification: Identification, folder: Path
) -> tuple[str, ...]:
    """Return the logs to identify from: the deployment's, and the earlier logs if the robot has not changed.

    Args:
        deployed: Logs of the deployment.
        folder: Folder of the deployment; the identification names its logs relative to the run.

    Returns:
        Paths, the deployment's first, because training takes its timing from the first; empty if the logs are too
        short.
    """
    logs = tuple(shown(path) for path in deployed)
    if drift is not None and (drift.alarms or drift.likely):
        return logs if drift.seconds >= _ENOUGH_S else ()
    identified = (folder.parent / log.path for log in identification.logs)
    return (*logs, *(shown(path) for path in identified if path.is_file()))
