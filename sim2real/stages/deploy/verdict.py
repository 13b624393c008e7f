"""The verdict on a deployment: the model tested on the deployment's logs, drift of the robot, timing and success."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import GOOD_SUCCESS, Bundle
from sim2real.artifacts.deployment import AS_HERE, Advice, Changed, Deployment, Drift, Gap, Replay
from sim2real.artifacts.identification import MAX_ERROR_RATIO, ROUND_TRIP, Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Timing
from sim2real.errors import OtherMotion, Sim2RealError
from sim2real.installation import has_jax
from sim2real.robots.robot import RecordedRobot
from sim2real.stages.deploy.next_command import LATER, PAUSED, with_command
from sim2real.stages.terminal.console import progress, shown
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


def judge(
    deployment: Deployment, robot: RecordedRobot, bundle: Bundle, identification: Identification | None, folder: Path
) -> Deployment:
    """Return a deployment with the tests of its model, its times beside those of training, and a verdict.

    Args:
        identification: The model; None: it is not tested.
        folder: Folder of the deployment, for the next command.
    """

    def advised(judged: Deployment, advice: Advice) -> Deployment:
        return replace(judged, advice=with_command(advice, robot, identification, folder, judged))

    times = tuple(_times_of_training(deployment, bundle))
    deployment = replace(deployment, trained=times)
    if identification is None:
        reason = "this run has no identification, so there is no model to compare with"
        if not any(deployment.simulated):
            return advised(deployment, Advice("not judged", (reason,)))
        # A simulation with nominal parameters judges the policy alone.
        advice = _policy_advice(deployment, bundle) or Advice("fine", ("the policy succeeds, as in simulation",))
        return advised(deployment, replace(advice, reasons=(*advice.reasons, reason)))
    # Test the model on the deployment's logs. A test that fails must not lose the deployment.
    try:
        if not has_jax():
            log = shown(deployment.logs[0].path)
            raise Sim2RealError(f"a computer with JAX tests the model: `sim2real validate RUN/identify --log {log}`")
        from sim2real.stages.deploy.replay import tested

        with progress(None, "test the model on the deployment"):
            replay, drift = patiently(lambda: tested(robot, identification, [r.episode for r in deployment.logs]))
    except OtherMotion as error:
        # The policy alone is judged, beside its simulation with identified parameters.
        advice = _policy_advice(deployment, bundle) or Advice("fine", ("the policy succeeds, as in simulation",))
        reason = f"the deployment does not test the model: {error.args[0]}"
        return advised(deployment, replace(advice, reasons=(*advice.reasons, reason)))
    except (Sim2RealError, ArithmeticError, np.linalg.LinAlgError) as error:
        advice, reason = _policy_advice(deployment, bundle), str(error.args[0])
        if advice is None:
            return advised(deployment, Advice("not judged", (reason,)))
        return advised(deployment, replace(advice, reasons=(*advice.reasons, reason)))
    # The drift test estimates the present sum of the delays, unless the change is that of another parameter.
    other_changed = drift.named is not None and drift.named.name != ROUND_TRIP
    round_trip_s = None if other_changed else {c.name: c.now for c in drift.changes}.get(ROUND_TRIP)
    times = tuple(_with_real(t, round_trip_s) if t.quantity == f"{ROUND_TRIP}_s" else t for t in times)
    deployment = replace(deployment, trained=times, replay=tuple(replay), drift=drift)
    return advised(deployment, verdict(deployment, bundle))


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
        pause = f"an episode lost {lost_s:.2g} s {PAUSED}, and no simulation has such pauses"
        return replace(policy, status="not judged", reasons=(pause, *policy.reasons, "the model holds"))
    return replace(policy, reasons=(*policy.reasons, "the model holds"))


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
        return Advice("re-identify", (f"the robot has changed: {_change(named)}", *_other_alarms(drift)))
    if wrong := [r for r in replay if _error_ratio(r, "identified") > MAX_ERROR_RATIO]:
        likely = drift.likely if drift else None
        guess = [f"most likely the robot has changed: {_change(likely)}"] if likely else []
        return Advice("re-identify", (*(f"{r.name}: {_error(r, 'identified')}" for r in wrong), *guess))
    return None


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


def _times_of_training(deployment: Deployment, bundle: Bundle) -> list[Gap]:
    """Return the robot's times beside those of training: the sum of the delays, and each node's computation time."""
    rows = []
    if delays := bundle.contract.delays_s:
        rows.append(Gap(f"{ROUND_TRIP}_s", None, float(sum(delays.values())), None, "s"))
    steps = _computation_times(deployment)
    for node, drawn in (bundle.episodes.drawn_s if bundle.episodes else {}).items():
        if node in steps and drawn.size and steps[node].size:
            for label, q in (("p50", 0.5), ("p99", 0.99)):
                real, trained = float(np.quantile(steps[node], q)), float(np.quantile(drawn, q))
                rows.append(Gap(f"step_of_{node}_{label}_s", real, trained, real - trained, "s"))
    return rows


def _computation_times(deployment: Deployment) -> dict[str, np.ndarray]:
    """Return the computation times of each node's steps in all episodes ``(N,)`` [s]."""
    parts: dict[str, list[np.ndarray]] = {}
    for recording in deployment.recordings:
        for node, times_s in Timing.of(recording.episode).steps_s.items():
            parts.setdefault(node, []).append(times_s)
    return {node: np.concatenate(times_s) for node, times_s in parts.items()}


def _with_real(row: Gap, real: float | None) -> Gap:
    """Return a row of times with the robot's value and the gap."""
    if real is None or row.simulation is None:
        return row
    return replace(row, real=real, gap=real - row.simulation)


def _late_nodes(deployment: Deployment, bundle: Bundle) -> list[str]:
    """Return a sentence for each node whose steps take longer than in training."""
    sentences, slack_s = [], _LATENESS_PERIODS / bundle.contract.rate_hz
    for node, times_s in _computation_times(deployment).items():
        drawn_s = bundle.episodes.drawn_s.get(node) if bundle.episodes else None
        if drawn_s is None or not drawn_s.size or not times_s.size:
            continue
        longest_s = float(drawn_s.max())
        share = float(np.mean(times_s > longest_s + slack_s))
        if share > _MAX_LATE_SHARE:
            sentences.append(f"{share:.1%} of the steps of {node} {LATER} the {1e3 * longest_s:.1f} ms of training")
    return sentences


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


def _other_alarms(drift: Drift) -> list[str]:
    others = ", ".join(name for name in drift.alarms if drift.named is None or name != drift.named.name)
    return [f"less likely, each alone: {others}"] if others else []
