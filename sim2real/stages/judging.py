"""What a deployment says about its model and its policy: recorded commands played again, drift, and what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import Advice, Deployment, Gap, Replay
from sim2real.artifacts.drift import Changed, Drift
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.identify import drift, prediction
from sim2real.identify.problem import Problem
from sim2real.identify.refine import refine
from sim2real.identify.segments import Span
from sim2real.robots.base import RecordedRobot
from sim2real.robots.worlds import in_world
from sim2real.stages import identified, left_out
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.console import note, progress, table
from sim2real.stages.cutting import reach
from sim2real.stages.interruption import patiently
from sim2real.stages.next_step import LATER, commands
from sim2real.stages.pipeline import Pipeline

AS_HERE = "as in this log"
"""The model with the parameters that the deployment's own log has."""
_SEGMENT_S = 0.4
"""Length of a segment at least [s]; a balanced pendulum's errors grow tenfold in 0.2 s: longer ones say little."""
_LEAST = 12
"""Segments that a test needs at least."""
_STEPS = 15
"""Most steps of a refinement of all parameters."""
_OFF = 3.0
"""Up to this many times the error that the identification promised, the model holds: a policy moves otherwise than an
excitation, and of hidden pendulums that had not changed some were 1.6 times as far off."""
_UNEXPLAINED = 0.5
"""Above this share of the error, parameters that are fitted to the log itself do not explain a joint's motion."""
_NOISE = 2.0
"""Errors below this many deviations of the measurement are its noise."""
_LATE = 0.01
"""Share of the steps that may take longer than any in training."""
_GOOD, _WORSE = 0.9, 0.1
"""Success that needs no more training; by how much it may be below that in simulation."""


def judged(
    deployed: Deployment, pipeline: Pipeline, bundle: Bundle, found: Identification | None, folder: Path
) -> Deployment:
    """Return a deployment with its model tested on its own logs, its times beside the policy's, and a verdict.

    Args:
        deployed: What happened.
        pipeline: The robot.
        bundle: The policy.
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
            rows, drifted = patiently(lambda: tested(pipeline, found, [r.episode for r in deployed.recordings]))
    except Sim2RealError as error:  # the robot has run: what it did must not be lost
        advice = Advice("not judged", (str(error.args[0]),))
        return replace(deployed, advice=commands(advice, pipeline, found, folder, deployed))
    if any(row.quantity == f"{ROUND_TRIP}_s" for row in times):
        now = {c.name: c.now for c in drifted.changes}.get(ROUND_TRIP)
        times = tuple(_with_real(t, now) if t.quantity == f"{ROUND_TRIP}_s" else t for t in times)
    deployed = replace(deployed, trained=times, replay=tuple(rows), drift=drifted)
    advice = verdict(deployed, bundle)
    return replace(deployed, advice=commands(advice, pipeline, found, folder, deployed))


def tested(pipeline: Pipeline, found: Identification, episodes: Sequence[Episode]) -> tuple[list[Replay], Drift]:
    """Play recorded commands to the identified and to the nominal model, and test the parameters.

    What is compared is what the sensor said with what the model's sensor would say, as late and at the log's times.

    Args:
        pipeline: The robot.
        found: What was identified.
        episodes: The logs.

    Raises:
        Sim2RealError: When the logs are too short, or what was identified does not fit the robot.
    """
    robot = left_out.having(in_world(pipeline.load(), found.world), [p.name for p in found.parameters])
    late = [p.upper for p in found.parameters if p.kind == "delay" and p.upper is not None]
    longest_s = max([pipeline.identify.max_delay_s, *late])
    config = replace(pipeline.identify, settle_s=found.settle_s, max_delay_s=longest_s)
    problem, ahead_s = segments(robot, found, episodes, config)
    if found.posterior is None:
        raise Sim2RealError("this identification was interrupted: it does not say how sure its estimates are")
    drifted, x = drift.drift(problem, found.posterior, found.widening or 1.0, robot.causes)
    z = refine(problem, problem.table.at_scale(x)[None], _STEPS, 2).z
    here = {n: float(np.ravel(v)[0]) for n, v in problem.table.decode(z).items()}
    nominal = {p.name: p.nominal for p in problem.model.parameters}
    models = {"identified": {n: found.values[n] for n in nominal}, AS_HERE: here, "nominal": nominal}
    every = np.ones(problem.segments, bool)
    columns = prediction.samples(problem, models, config.settle_s, every)
    errors = prediction.errors(problem, columns, list(models), config.settle_s, [ahead_s])
    promised = _promised(found, ahead_s)
    rows = []
    for position in identified.positions(problem, robot.units):
        rmse = {e.model: e.rmse.get(position.column) for e in errors if e.held_out}
        rmse = {m: e if e is not None and math.isfinite(e) else None for m, e in rmse.items()}
        own = promised.get(position.column)
        least = _NOISE * position.sigma
        rows.append(Replay(position.name, position.unit, ahead_s, rmse, None if own is None else max(own, least)))
    return rows, drifted


def segments(
    robot: RecordedRobot, found: Identification, episodes: Sequence[Episode], config: IdentifyConfig
) -> tuple[Problem, float]:
    """Return logs in short segments, with the parameters that were identified, and how far ahead they predict [s].

    Args:
        robot: The robot.
        found: What was identified.
        episodes: The logs.
        config: How residuals are made.

    Raises:
        Sim2RealError: When there is too little to test.
    """
    model = robot.identifiable(config.max_delay_s)
    if own := [p.name for p in model.parameters if p.free and p.per_recording]:
        raise Sim2RealError(f"{', '.join(own)} differ from recording to recording: of a new log they are not known")
    horizons = sorted({p.horizon_s for p in found.prediction})
    length_s = max(_SEGMENT_S, config.settle_s + (horizons[0] if horizons else 0.0))
    ahead_s = max([h for h in horizons if config.settle_s + h <= length_s + 1e-9], default=length_s - config.settle_s)
    spans = []
    for r, episode in enumerate(episodes):
        begin, end = reach(episode, config)
        spans += [Span(r, float(b)) for b in np.arange(begin, end - length_s + 1e-6, length_s)]
    if len(spans) < _LEAST:
        seconds = sum(e.duration_s for e in episodes)
        raise Sim2RealError(f"{seconds:.1f} s of deployment are too little to test the model on")
    fixed = {p.name: p.estimate for p in found.parameters if p.verdict == "fixed"}
    table = model.parameters.with_fixed({n: v for n, v in fixed.items() if n in {p.name for p in model.parameters}})
    free = {p.name for p in table if p.free}
    wider = {
        p.name: (min(p.lower, table[p.name].low), max(p.upper, table[p.name].high))
        for p in found.parameters
        if p.name in free and p.kind != "delay" and p.lower is not None and p.upper is not None
    }
    return Problem(model, list(episodes), spans, length_s, config, table.with_bounds(wider)), ahead_s


def verdict(deployed: Deployment, bundle: Bundle) -> Advice:
    """Return what a deployment that was tested asks for, the command left out.

    What is wrong with the model comes first, see ``verdict_of``; then a policy that was trained for other times, or
    that is not good enough.

    Args:
        deployed: With replay, drift and times.
        bundle: The policy.
    """
    if told := verdict_of(deployed.replay, deployed.drift):
        return told
    if late := list(_too_late(deployed, bundle)):
        return Advice("re-train", tuple(late))
    success = next((g for g in deployed.gap if g.quantity == "success"), None)
    if success is not None and success.real is not None:
        simulated = success.simulation if success.simulation is not None else 1.0
        if success.real < min(_GOOD, simulated - _WORSE):
            why = f"the model holds, but success is {success.real:.2f}, in simulation {simulated:.2f}"
            return Advice("re-train", (why,))
        if success.real < _GOOD:
            return Advice("re-train", (f"the model holds, and success is {success.real:.2f}, as in simulation",))
    return Advice("fine", ("the robot is the one that was identified, and as fast as in training",))


def verdict_of(replay: Sequence[Replay], drifted: Drift | None) -> Advice | None:
    """Return what is wrong with the model; None if it holds.

    First what no parameters explain: then it is no use to identify again. Then drift, then a model that is further off
    than it promised.

    Args:
        replay: How far models are off.
        drifted: What has changed.
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
        return Advice("re-identify", tuple(f"{r.name}: {_error(r, 'identified')}" for r in off))
    return None


def show(deployed: Deployment) -> None:
    """Print the tests and the verdict of a deployment."""
    if deployed.trained:
        rows = [[g.quantity, g.real, g.simulation, g.gap] for g in deployed.trained]
        print(table(rows, ["times", "robot", "in training", "gap"]))
    if deployed.replay:
        models = list(deployed.replay[0].rmse)
        rows = [[r.name, *(r.rmse.get(m) for m in models), r.promised, r.unit] for r in deployed.replay]
        print(table(rows, [f"commands played again, {deployed.replay[0].horizon_s:g} s", *models, "promised", "unit"]))
    if deployed.drift is not None:
        alarms = set(deployed.drift.alarms)
        rows = [
            [c.name, c.before, c.now, f"[{c.low95:.4g}, {c.high95:.4g}]", c.unit, c.explains, c.name in alarms]
            for c in deployed.drift.changes
        ]
        print(table(rows, ["changed alone", "identified", "now", "95 % interval", "unit", "explains", "alarm"]))
    if deployed.advice is not None:
        note(f"verdict: {deployed.advice.status}")
        for reason in deployed.advice.reasons:
            note(f"  {reason}")
        if deployed.advice.next:
            note(f"next: {deployed.advice.next}")


def _promised(found: Identification, ahead_s: float) -> Mapping[str, float]:
    """Return the identified model's error on held-out data, by field."""
    rows = [p for p in found.prediction if p.model == "identified" and p.held_out and p.horizon_s == ahead_s]
    return {n: e for row in rows for n, e in row.rmse.items() if e is not None}


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
    said = []
    for node, taken in _steps(deployed).items():
        drawn = bundle.episodes.drawn_s.get(node) if bundle.episodes else None
        if drawn is None or not drawn.size or not taken.size:
            continue
        longest = float(drawn.max())
        share = float(np.mean(taken > longest))
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


def _also(drifted: Drift) -> list[str]:
    others = ", ".join(name for name in drifted.alarms if drifted.named is None or name != drifted.named.name)
    return [f"less likely, each by itself: {others}"] if others else []
