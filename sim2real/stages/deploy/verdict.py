"""What a deployment says about its model and its policy: recorded commands played again, drift, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Advice, Deployment, Gap, Replay
from sim2real.artifacts.estimation.drift import Changed, Drift
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.stages.deploy.next_command import LATER, commands
from sim2real.stages.deploy.trajectories import off_course
from sim2real.stages.estimation.replay import AS_HERE, tested
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import artifact_table, note, progress
from sim2real.stages.terminal.interruption import patiently

_OFF = 3.0
"""Up to this many times the error that the identification promised, the model holds: a policy moves otherwise than an
excitation, and of hidden pendulums that had not changed some were 1.6 times as far off."""
_UNEXPLAINED = 0.5
"""Above this share of the error, parameters that are fitted to the log itself do not explain a joint's motion."""
_LATE = 0.01
"""Share of the steps that may take longer than any in training."""
_SLACK = 0.1
"""Share of the policy's period by which they may do so: at 50 Hz, 2 ms, less than a servo's own delay varies by."""
_MOST = 3
"""Sentences about courses that a verdict has at most."""
_GOOD, _WORSE = 0.9, 0.1
"""Success that needs no more training; by how much it may be below that in simulation."""


def judged(
    deployed: Deployment, pipeline: Pipeline, bundle: Bundle, found: Identification | None, folder: Path
) -> Deployment:
    """Return a deployment with its model tested on its own logs, its times beside the policy's, and a verdict.

    Args:
        found: What was identified; None: there is nothing to test.
        folder: The deployment's, for the command to type.
    """
    times = tuple(_trained(deployed, bundle))
    deployed = replace(deployed, trained=times)
    if found is None:
        why = "nothing was identified in this run, so there is no model to compare with"
        return replace(deployed, advice=commands(Advice("not judged", (why,)), pipeline, None, folder, deployed))
    try:
        with progress(None, "test the model on the deployment"):
            rows, drifted = patiently(lambda: tested(pipeline, found, [r.episode for r in deployed.logs]))
    except (Sim2RealError, ArithmeticError, np.linalg.LinAlgError) as error:  # what the robot did must not be lost
        told, why = _of_policy(deployed, bundle), str(error.args[0])
        advice = Advice("not judged", (why,)) if told is None else replace(told, reasons=(*told.reasons, why))
        return replace(deployed, advice=commands(advice, pipeline, found, folder, deployed))
    if any(row.quantity == f"{ROUND_TRIP}_s" for row in times):
        other = drifted.named is not None and drifted.named.name != ROUND_TRIP
        now = None if other else {c.name: c.now for c in drifted.changes}.get(ROUND_TRIP)
        times = tuple(_with_real(t, now) if t.quantity == f"{ROUND_TRIP}_s" else t for t in times)
    deployed = replace(deployed, trained=times, replay=tuple(rows), drift=drifted)
    advice = verdict(deployed, bundle)
    return replace(deployed, advice=commands(advice, pipeline, found, folder, deployed))


def verdict(deployed: Deployment, bundle: Bundle) -> Advice:
    """Return what a deployment that was tested asks for, the command left out.

    What is wrong with the model comes first, see ``verdict_of``; then whole episodes that differ from their
    simulations; then a policy that was trained for other times, or that is not good enough.

    Args:
        deployed: With replay, courses, drift and times.
    """
    if told := verdict_of(deployed.replay, deployed.drift):
        return told
    if off := tuple(off_course(deployed)):
        return Advice("re-identify", (*off[:_MOST], f"commands played again hold {_ahead(deployed)} ahead, though"))
    if told := _of_policy(deployed, bundle):
        return replace(told, reasons=(*told.reasons, "the model holds"))
    return Advice("fine", ("the robot is the one that was identified, and as fast as in training",))


def _of_policy(deployed: Deployment, bundle: Bundle) -> Advice | None:
    """Return what is wrong with the policy, whatever its model is; None if it is good enough."""
    if late := list(_too_late(deployed, bundle)):
        return Advice("re-train", tuple(late))
    success = next((g for g in deployed.gap if g.quantity == "success"), None)
    if success is None or success.real is None:
        return None
    simulated = success.simulation if success.simulation is not None else 1.0
    if success.real < min(_GOOD, simulated - _WORSE):
        return Advice("re-train", (f"success is {success.real:.2f}, in simulation {simulated:.2f}",))
    return Advice("re-train", (f"success is {success.real:.2f}, as in simulation",)) if success.real < _GOOD else None


def verdict_of(replay: Sequence[Replay], drifted: Drift | None) -> Advice | None:
    """Return what is wrong with the model; None if it holds.

    First what no parameters explain: then it is no use to identify again. Then drift, then a model that is further off
    than it promised.
    """
    share = {r.name: _beyond(r, AS_HERE) / max(_beyond(r, "identified"), 1e-9) for r in replay}
    odd = [r for r in replay if _beyond(r, AS_HERE) > _OFF and not share[r.name] <= _UNEXPLAINED]
    if odd:
        worst = max(odd, key=lambda r: _beyond(r, AS_HERE))
        why = f"no parameters explain how {worst.name} moves: {_error(worst, AS_HERE)}"
        return Advice("look at this joint", (why, "it may be loose, blocked, or touch something"), joint=worst.name)
    if drifted is not None and (named := drifted.named):
        return Advice("re-identify", (f"the robot has changed: {_change(named)}", *_also(drifted)))
    if off := [r for r in replay if _beyond(r, "identified") > _OFF]:
        likely = drifted.likely if drifted else None
        guess = [f"most likely the robot has changed: {_change(likely)}"] if likely else []
        return Advice("re-identify", (*(f"{r.name}: {_error(r, 'identified')}" for r in off), *guess))
    return None


def show(deployed: Deployment) -> None:
    """Print the tests and the verdict of a deployment."""
    if deployed.trained:
        print(artifact_table(deployed.times_table()))
    if deployed.replay:
        print(artifact_table(deployed.replay_table()))
    if deployed.drift is not None:
        print(artifact_table(deployed.drift.rows()))
    if deployed.advice is not None:
        note(f"verdict: {deployed.advice.status}")
        for reason in deployed.advice.reasons:
            note(f"  {reason}")
        if deployed.advice.next:
            note(f"next: {deployed.advice.next}")


def _trained(deployed: Deployment, bundle: Bundle) -> list[Gap]:
    """Return the robot's times beside those of training: the sum of the delays, and what each node's steps take."""
    rows = []
    if delays := bundle.contract.delays_s:
        rows.append(Gap(f"{ROUND_TRIP}_s", None, float(sum(delays.values())), None, "s"))
    steps = _steps(deployed)
    for node, drawn in (bundle.episodes.drawn_s if bundle.episodes else {}).items():
        if node in steps and drawn.size and steps[node].size:
            for label, of in (("p50", 0.5), ("p99", 0.99)):
                real, own = float(np.quantile(steps[node], of)), float(np.quantile(drawn, of))
                rows.append(Gap(f"step_of_{node}_{label}_s", real, own, real - own, "s"))
    return rows


def _steps(deployed: Deployment) -> dict[str, np.ndarray]:
    """Return how long the steps of each node took in all episodes ``(N,)`` [s]."""
    found: dict[str, list[np.ndarray]] = {}
    for recording in deployed.recordings:
        for node, taken in Timing.of(recording.episode).steps_s.items():
            found.setdefault(node, []).append(taken)
    return {node: np.concatenate(parts) for node, parts in found.items()}


def _with_real(row: Gap, now: float | None) -> Gap:
    return row if now is None or row.simulation is None else replace(row, real=now, gap=now - row.simulation)


def _too_late(deployed: Deployment, bundle: Bundle) -> list[str]:
    """Return sentences about nodes whose steps take longer than the policy was trained with."""
    said, slack_s = [], _SLACK / bundle.contract.rate_hz
    for node, taken in _steps(deployed).items():
        drawn = bundle.episodes.drawn_s.get(node) if bundle.episodes else None
        if drawn is None or not drawn.size or not taken.size:
            continue
        longest = float(drawn.max())
        share = float(np.mean(taken > longest + slack_s))
        if share > _LATE:
            said.append(f"{share:.1%} of the steps of {node} {LATER} the {1e3 * longest:.1f} ms of training")
    return said


def _beyond(row: Replay, model: str) -> float:
    """Return how many times the promised error a model's is; 1 where nothing was promised, infinite if it diverged."""
    error = row.rmse.get(model)
    if row.promised is None:
        return 1.0
    return math.inf if error is None else error / row.promised


def _error(row: Replay, model: str) -> str:
    error, promised = row.rmse.get(model), row.promised or 0.0
    found = "it diverges" if error is None else f"off by {error:.2g} {row.unit}"
    return f"{found} {row.horizon_s:g} s ahead, promised were {promised:.2g} {row.unit}"


def _change(c: Changed) -> str:
    if c.unit == "":
        return f"{c.name} is {c.now:.2f} times what it was [{c.low95:.2f}, {c.high95:.2f}]"
    return f"{c.name} is {c.now:.4g} {c.unit} [{c.low95:.4g}, {c.high95:.4g}], identified were {c.before:.4g}"


def _ahead(deployed: Deployment) -> str:
    return f"{max(row.horizon_s for row in deployed.replay):g} s"


def _also(drifted: Drift) -> list[str]:
    others = ", ".join(name for name in drifted.alarms if drifted.named is None or name != drifted.named.name)
    return [f"less likely, each by itself: {others}"] if others else []
