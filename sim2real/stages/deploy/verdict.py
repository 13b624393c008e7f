"""The verdict on a deployment: model, robot, timing and success; and the command that follows from it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import GOOD_SUCCESS, Bundle
from sim2real.artifacts.deployment import AS_HERE, Advice, Changed, Deployment, Drift, Gap, Replay
from sim2real.artifacts.identification import MAX_ERROR_RATIO, ROUND_TRIP, Identification
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import MANIFEST
from sim2real.artifacts.timing import Timing
from sim2real.errors import OtherMotion, Sim2RealError
from sim2real.installation import has_jax
from sim2real.robots.robot import RecordedRobot, in_world, watched
from sim2real.stages.load import defaults_of
from sim2real.stages.shared.identification import command
from sim2real.stages.terminal.console import progress
from sim2real.stages.terminal.interruption import patiently

_FAULTY_RATIO = 2.0
"""Ratio of the error to its bound, with the parameters fitted to the deployment, above which a joint moves as no
parameters explain."""
_MAX_UNEXPLAINED = 0.5
"""Largest share of the error that may remain after a fit to the log; above it no parameters explain the motion."""
_MAX_LATE_SHARE = 0.01
"""Largest share of steps that may take longer than the longest step of training."""
_LATENESS_PERIODS = 0.1
"""A step is late if it exceeds the longest of training by this share of the policy's period."""
_MAX_PAUSES_S = 0.1
"""Longest time that an episode may lose in pauses; a policy that then fails is not judged."""
_MAX_SUCCESS_GAP = 0.1
"""Largest difference of success in simulation and on the robot."""
_LATER, _PAUSED = "take longer than", "to pauses of its nodes"
"""Words of the reasons for new timing in training, and for another deployment."""
_ENOUGH_S = 12.0
"""Length of a deployment's logs that suffices to identify from [s]."""


def judge(
    deployment: Deployment, robot: RecordedRobot, bundle: Bundle, identification: Identification | None, folder: Path
) -> Deployment:
    """Return a deployment with the tests of its model, its times beside those of training, and a verdict.

    Args:
        identification: The model; None: it is not tested.
        folder: Folder of the deployment, for the next command.
    """
    deployment = replace(deployment, trained=tuple(_times_of_training(deployment, bundle)))
    if identification is None:
        advice = Advice("not judged", ("this run has no identification, so there is no model to compare with",))
        if any(deployment.simulated):  # with nominal parameters
            advice = _of_policy(deployment, bundle, advice.reasons[0], fine=True)
    else:
        # A test that fails must not lose the deployment.
        try:
            deployment = _tested(deployment, robot, identification)
            advice = verdict(deployment, bundle)
        except OtherMotion as error:
            reason = f"the deployment does not test the model: {error.args[0]}"
            advice = _of_policy(deployment, bundle, reason, fine=True)
        except (Sim2RealError, ArithmeticError, np.linalg.LinAlgError) as error:
            advice = _of_policy(deployment, bundle, str(error.args[0]), fine=False)
    return replace(deployment, advice=with_command(advice, robot, identification, folder, deployment))


def _of_policy(deployment: Deployment, bundle: Bundle, reason: str, fine: bool) -> Advice:
    """Return the verdict where the model is not tested.

    Args:
        reason: Why it is not.
        fine: Whether the policy is beside a simulation, so that its success suffices.
    """
    advice = _policy_advice(deployment, bundle)
    if advice is None and not fine:
        return Advice("not judged", (reason,))
    advice = advice or Advice("fine", ("the policy succeeds, as in simulation",))
    return replace(advice, reasons=(*advice.reasons, reason))


def _tested(deployment: Deployment, robot: RecordedRobot, identification: Identification) -> Deployment:
    """Return a deployment with the tests of the model on its logs."""
    if not has_jax():
        log = shown(deployment.logs[0].path)
        raise Sim2RealError(f"a computer with JAX tests the model: `sim2real validate RUN/identify --log {log}`")
    from sim2real.stages.deploy.replay import tested

    with progress(None, "test the model on the deployment"):
        replay, drift = patiently(lambda: tested(robot, identification, [r.episode for r in deployment.logs]))
    # The drift test estimates the present sum of the delays, unless the change is that of another parameter.
    other_changed = drift.named is not None and drift.named.name != ROUND_TRIP
    now = None if other_changed else {c.name: c.now for c in drift.changes}.get(ROUND_TRIP)
    trip = f"{ROUND_TRIP}_s"
    trained = tuple(replace(t, real=now) if t.quantity == trip else t for t in deployment.trained)
    return replace(deployment, trained=trained, replay=tuple(replay), drift=drift)


def verdict(deployment: Deployment, bundle: Bundle) -> Advice:
    """Return the verdict on a deployment, without the next command.

    The first finding decides: a wrong model, see ``model_advice``; a policy that does not succeed often enough. While
    the policy succeeds and all predictions are within their expected errors, a change of a parameter is no reason to
    identify again, and late steps are none to train again.

    Args:
        deployment: With replay, drift and times.
    """
    model, policy = model_advice(deployment.replay, deployment.drift), _policy_advice(deployment, bundle)
    holds = all(r.expected is not None and _error_ratio(r, "identified") <= 1.0 for r in deployment.replay)
    if model is not None and model.status == "re-identify" and holds and policy is None:
        return Advice("fine", ("the policy succeeds and the model's errors are the expected ones", *model.reasons))
    if model is not None:
        return model
    if policy is None:
        if late := _late_nodes(deployment, bundle):
            return Advice("fine", ("the robot is the one that was identified, and the policy succeeds", *late))
        return Advice("fine", ("the robot is the one that was identified, and as fast as in training",))
    if (lost_s := max(map(_lost_s, deployment.recordings), default=0.0)) > _MAX_PAUSES_S:
        pause = f"an episode lost {lost_s:.2g} s {_PAUSED}, and no simulation has such pauses"
        return replace(policy, status="not judged", reasons=(pause, *policy.reasons, "the model holds"))
    return replace(policy, reasons=(*policy.reasons, "the model holds"))


# -- the model


def model_advice(replay: Sequence[Replay], drift: Drift | None) -> Advice | None:
    """Return the finding about the model; None if it holds.

    The order: motion that no parameters explain, where another identification would not help; drift; an error above
    the expected error.
    """
    # Compare the model fitted to these logs with the expected error: a large error of it is no error of the parameters.
    unexplained = {r.name: _error_ratio(r, AS_HERE) / max(_error_ratio(r, "identified"), 1e-9) for r in replay}
    faulty = [
        r for r in replay if _error_ratio(r, AS_HERE) > _FAULTY_RATIO and not unexplained[r.name] <= _MAX_UNEXPLAINED
    ]
    if faulty:
        worst = max(faulty, key=lambda r: _error_ratio(r, AS_HERE))
        reason = f"no parameters explain how {worst.name} moves: {_error(worst, AS_HERE)}"
        return Advice("look at this joint", (reason, "it may be loose, blocked, or touch something"), joint=worst.name)
    if drift is not None and (named := drift.named):
        others = ", ".join(name for name in drift.alarms if name != named.name)
        less = [f"less likely, each alone: {others}"] if others else []
        return Advice("re-identify", (f"the robot has changed: {_change(named)}", *less))
    if wrong := [r for r in replay if _error_ratio(r, "identified") > MAX_ERROR_RATIO]:
        likely = drift.likely if drift else None
        guess = [f"most likely the robot has changed: {_change(likely)}"] if likely else []
        return Advice("re-identify", (*(f"{r.name}: {_error(r, 'identified')}" for r in wrong), *guess))
    return None


def _error_ratio(row: Replay, model: str) -> float:
    """Return the ratio of a model's error to the expected one: 1 without one, infinite if the model diverged."""
    error = row.rmse.get(model)
    if row.expected is None:
        return 1.0
    return math.inf if error is None else error / row.expected


def _error(row: Replay, model: str) -> str:
    error, expected = row.rmse.get(model), row.expected or 0.0
    size = "it diverges" if error is None else f"off by {error:.2g} {row.unit}"
    return f"{size} {row.horizon_s:g} s ahead, expected were {expected:.2g} {row.unit}"


def _change(c: Changed) -> str:
    if c.unit == "":
        return f"{c.name} is {c.now:.2f} times its former value [{c.low95:.2f}, {c.high95:.2f}]"
    return f"{c.name} is {c.now:.4g} {c.unit} [{c.low95:.4g}, {c.high95:.4g}], identified were {c.before:.4g}"


# -- the policy, and the times of its nodes


def _policy_advice(deployment: Deployment, bundle: Bundle) -> Advice | None:
    """Return the finding about the policy; None if it succeeds often enough.

    Steps that take longer than in training explain a failure; they are none. Where nothing measures success, they are
    all that is known.
    """
    late = tuple(_late_nodes(deployment, bundle))
    success = next((g for g in deployment.gap if g.quantity == "success"), None)
    if success is None or success.real is None:
        return Advice("re-train", late) if late else None
    simulated = success.simulation if success.simulation is not None else 1.0
    if success.real < min(GOOD_SUCCESS, simulated - _MAX_SUCCESS_GAP):
        return Advice("re-train", (*late, f"success is {success.real:.2f}, in simulation {simulated:.2f}"))
    if success.real < GOOD_SUCCESS:
        return Advice("re-train", (*late, f"success is {success.real:.2f}, as in simulation"))
    return None


def _lost_s(recording: Recording) -> float:
    """Return the time that the slowest node of an episode lost in steps of two periods or more [s]."""
    lost_s = [0.0]
    for steps in recording.episode.steps.values():
        # A step that is a little late is no pause: the node returns to its schedule.
        gaps_s = np.diff(steps.begun_s)
        if gaps_s.size:
            period_s = float(np.median(gaps_s))
            lost_s.append(float(np.sum(gaps_s[gaps_s >= 2.0 * period_s] - period_s)))
    return max(lost_s)


def _times_of_training(deployment: Deployment, bundle: Bundle) -> list[Gap]:
    """Return the robot's times beside those of training: the sum of the delays, and each node's computation time."""
    rows = []
    if delays := bundle.contract.delays_s:
        rows.append(Gap(f"{ROUND_TRIP}_s", None, float(sum(delays.values())), "s"))
    for node, (took_s, drawn_s) in _computation_times(deployment, bundle).items():
        for label, q in (("p50", 0.5), ("p99", 0.99)):
            real, trained = float(np.quantile(took_s, q)), float(np.quantile(drawn_s, q))
            rows.append(Gap(f"step_of_{node}_{label}_s", real, trained, "s"))
    return rows


def _late_nodes(deployment: Deployment, bundle: Bundle) -> list[str]:
    """Return a sentence for each node whose steps take longer than in training."""
    sentences, slack_s = [], _LATENESS_PERIODS / bundle.contract.rate_hz
    for node, (took_s, drawn_s) in _computation_times(deployment, bundle).items():
        longest_s = float(drawn_s.max())
        share = float(np.mean(took_s > longest_s + slack_s))
        if share > _MAX_LATE_SHARE:
            sentences.append(f"{share:.1%} of the steps of {node} {_LATER} the {1e3 * longest_s:.1f} ms of training")
    return sentences


def _computation_times(deployment: Deployment, bundle: Bundle) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the computation times of each node's steps in all episodes, and in training ``(N,)`` [s]."""
    times = {}
    timings = [Timing.of(recording.episode).steps_s for recording in deployment.recordings]
    for node, drawn_s in (bundle.episodes.drawn_s if bundle.episodes else {}).items():
        took_s = np.concatenate([t[node] for t in timings if node in t] or [np.empty(0)])
        if drawn_s.size and took_s.size:
            times[node] = (took_s, drawn_s)
    return times


# -- the command to type next


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
    if advice.status == "not judged" and any(_PAUSED in reason for reason in advice.reasons):
        return replace(advice, next=shlex.join(["sim2real", "deploy", robot.name, *run]))
    usual = defaults_of(robot).identify
    logs = logs_to_identify([r.path for r in deployment.logs], deployment.drift, identification, folder)
    terms = terms_to_identify(usual.terms, robot, identification, deployment.drift)
    # Without logs that suffice the robot is recorded first.
    if advice.status == "not judged" or not logs:
        record = shlex.join(["sim2real", "record", robot.name])
        identify = shlex.join(["sim2real", "identify", robot.name, "--terms", terms])
        return replace(advice, next=record if terms == usual.terms else f"{record} && {identify}")
    identify = command(robot, replace(usual, log=logs, terms=terms), Path("runs"), shlex.join(run))
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
    default = robot.identifiable(max_delay_s).parameters.terms
    changed = (drift.named or drift.likely) if drift is not None else None
    added = [
        p.term
        for p in watched(robot, max_delay_s).parameters
        if changed is not None and p.name == changed.name and p.term
    ]
    before = default if identification.terms is None else identification.terms
    terms = tuple(dict.fromkeys([*before, *added]))
    return configured if terms == default else ",".join(terms) or "none"


def needs_timing(advice: Advice) -> bool:
    """Return whether training needs timing from a newer log; it takes the timing of the identification."""
    return advice.status == "re-train" and any(_LATER in reason for reason in advice.reasons)


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
        return logs if drift.seconds >= _ENOUGH_S else ()
    identified = (folder.parent / log.path for log in identification.logs)
    return (*logs, *(shown(path) for path in identified if path.is_file()))
