"""Run the policy on the robot, behind the safety gate, and compare with the simulation."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, named_leaves
from sim2real.graph.node import TICKS_PER_S
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.graph.windows import newest_message
from sim2real.hardware.truth import read_truth
from sim2real.log.ages import input_ages
from sim2real.log.reader import read_log
from sim2real.policy.bundle import load_bundle, read_weights
from sim2real.runtime.bursts import make_room
from sim2real.runtime.compiled import CompiledGraph
from sim2real.stages.config import DeployConfig
from sim2real.stages.console import note, progress, table
from sim2real.stages.interruption import patiently
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.record import TRUTH
from sim2real.stages.rig import opened, show_withheld, warn
from sim2real.stages.robot import Robot, Session, moving_robot
from sim2real.stages.runs import OpenStage, StageFolder, finished, newest, open_stage
from sim2real.stages.session import check_deadlines, run_episode, timing_rows
from sim2real.stages.train import computation_delays, load_parameters
from sim2real.train.networks import Policy

_SIMULATIONS = 32


def run(pipeline: Pipeline, config: DeployConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Deploy the policy and write logs, scores and the gap to simulation; in a dry run the logs alone.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder to add to; None takes the one of the bundle.
    """
    robot = moving_robot(pipeline)
    bundle, run_dir = _find_bundle(pipeline, config, root, run_dir)
    policy = _load_policy(robot, bundle)
    with open_stage(root, pipeline.name, "deploy", config, {"bundle": bundle}, run_dir, config.dry_run) as stage:
        values = _identified(pipeline, stage.run_dir)
        logs = [stage.output(f"log_{i}", f"episode_{i}.mcap") for i in range(config.episodes)]
        with opened(robot, config, stage.folder / TRUTH) as session:
            if session.embedded is not None:
                stage.output("truth", TRUTH)
            timing = [_deploy(pipeline, robot, session, policy, i, log, config) for i, log in enumerate(logs)]
        print(table(*timing_rows(timing[-1])))
        for summary in timing:
            warn(summary)
        if config.dry_run:
            show_withheld(timing)
            note("dry run: there is no gap report, for nothing was moved that a simulation could be compared with")
            result: dict[str, Any] = {"dry_run": True, "episodes": [], "gap": []}
        else:
            result = _report(robot, stage, policy, values, logs, timing, config)
        stage.output("result", "result.json").write_text(
            json.dumps({**result, "timing": timing, "units": dict(robot.UNITS)}, indent=1)
        )
        from sim2real.view.page import deploy_page  # matplotlib and jinja2 take 0.5 s to import

        stage.output("page", deploy_page(stage.folder).name)
        stage.summary(
            {
                **{
                    f"success, deployment {i}": round(e["real"]["success"], 3) for i, e in enumerate(result["episodes"])
                },
                "lost replies": timing[-1]["lost_replies"],
                "late replies": timing[-1]["late_replies"],
                "odd measurements": sum(len(summary["suspects"]) for summary in timing),
                "command timeouts": timing[-1]["command_timeouts"],
            }
        )
        if config.strict_timing:
            for summary in timing:
                check_deadlines(summary)
    return stage.result


def _report(
    robot: Robot,
    stage: OpenStage,
    policy: Policy,
    values: Mapping[str, float] | None,
    logs: Sequence[Path],
    timing: Sequence[Mapping[str, Any]],
    config: DeployConfig,
) -> dict[str, Any]:
    """Simulate the same, write it, print the gap, and return scores and gap."""
    episodes, truth = [read_log(log) for log in logs], stage.folder / TRUTH
    real = [_states(truth, s, episode, robot) for episode, s in zip(episodes, timing, strict=True)]
    # What is compared is of one kind: true states with true ones, and what sensors said with what they would say.
    seen = "world" if truth.is_file() else "sensor"
    with progress(None, "simulate the same"):
        simulated, timeline = patiently(
            lambda: _simulate(robot, policy, values, episodes[0], config.duration_s, len(logs), seen)
        )
    result = _compare(robot, real, simulated)
    result["gap"] += _age_rows(robot, episodes, timeline)
    columns: dict[str, Any] = _first_episodes(simulated, len(logs))
    np.savez_compressed(stage.output("simulation", "simulation.npz"), **columns)
    headers = ["quantity", "robot", "simulation", "gap"]
    print(table([[g["quantity"], g["real"], g["simulation"], g["gap"]] for g in result["gap"]], headers))
    return result


def _deploy(
    pipeline: Pipeline, robot: Robot, session: Session, policy: Policy, trial: int, log: Path, config: DeployConfig
) -> dict[str, Any]:
    if config.dry_run:  # to bring it to its start would move it
        note(
            f"dry run: the robot stays where it is, not brought to its start; {config.duration_s:g} s on {config.port}"
        )
    else:
        note(f"waiting for the robot to come to rest, then {config.duration_s:g} s on {config.port}")
        robot.prepare(session, config.settle_s)
    nodes, params = robot.deployment_nodes(session, policy, trial)
    return run_episode(pipeline, robot, session, nodes, params, log, config.duration_s, config, "deploy")


def _find_bundle(
    pipeline: Pipeline, config: DeployConfig, root: Path, run_dir: Path | None
) -> tuple[Path, Path | None]:
    if config.bundle is not None:
        return Path(config.bundle), run_dir
    trained = newest(root, pipeline.name, "train", run_dir)
    return trained.output("bundle"), run_dir or trained.run_dir


def _load_policy(robot: Robot, bundle: Path) -> Policy:
    contract = load_bundle(bundle).contract
    expected = [(name, tuple(units), history) for name, units, history in robot.OBSERVATION]
    found = [(t.name, tuple(t.units), t.history) for t in contract.observation]
    if found != expected or contract.rate_hz != robot.RATE_HZ:
        raise Sim2RealError(
            f"the policy in {bundle} sees {found} at {contract.rate_hz:g} Hz, "
            f"this robot shows {expected} at {robot.RATE_HZ:g} Hz",
            hint="train a policy for this pipeline",
        )
    sends = [(a.name, a.unit) for a in contract.action]
    if sends != robot.ACTION:
        raise Sim2RealError(
            f"the policy in {bundle} sends {sends}, this robot takes {robot.ACTION}",
            hint="train a policy for this pipeline",
        )
    for action, (low, high) in zip(contract.action, robot.ACTION_BOUNDS, strict=True):
        if action.low < np.float32(low) or action.high > np.float32(high):  # training rounds them so
            raise Sim2RealError(
                f"the policy in {bundle} sends {action.name!r} from {action.low:g} to {action.high:g} {action.unit}, "
                f"this robot bears {low:g} to {high:g}",
                hint="train a policy for this pipeline",
            )
    return Policy.from_weights(read_weights(bundle))


def _states(
    truth: Path, summary: Mapping[str, Any], episode: Episode, robot: Robot
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return times [s] and states of a deployment: the true ones of an embedded robot, else what was measured."""
    sent = _sent(robot, episode.outputs[robot.SUPERVISOR], episode.outputs[robot.COMMAND[0]])
    if truth.is_file():
        t_ns, states = read_truth(truth).states()
        t_s = (t_ns - summary["monotonic_ns"]) / 1e9
        inside = (t_s >= 0) & (t_s <= episode.duration_s)
        return t_s[inside], {**sent, **{n: s[inside] for n, s in states.items()}}
    steps = episode.steps["sensor"]
    t_s = np.where(steps.ts_overwrite >= 0, steps.ts_overwrite, steps.start) / TICKS_PER_S
    return t_s, {**sent, **_columns(episode.outputs["sensor"])}


def _columns(fields: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the fields ``(N, ...)`` as columns ``(N,)``: a vector's entries become ``name[i]``."""
    columns = {}
    for name, values in fields.items():
        flat = np.asarray(values).reshape(len(values), -1)
        columns |= {name if flat.shape[1] == 1 else f"{name}[{i}]": column for i, column in enumerate(flat.T)}
    return columns


def _sent(robot: Robot, decided: Mapping[str, Any], commanded: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the columns of what the supervisor sent besides its command, and of the command to the motors."""
    field = robot.COMMAND[1]
    return _columns({**{n: v for n, v in decided.items() if n != field}, "command": commanded[field]})


def _identified(pipeline: Pipeline, run_dir: Path) -> dict[str, float] | None:
    """Return the parameters to simulate with, read before anything moves; None when the run holds none."""
    identified = finished(run_dir, "identify")
    if identified is None:
        return None
    document = load_parameters(identified.output("parameters"), pipeline)
    return {p["name"]: float(p["estimate"]) for p in document["parameters"] if p["kind"] != "derived"}


def _simulate(
    robot: Robot,
    policy: Policy,
    values: Mapping[str, float] | None,
    episode: Episode,
    duration_s: float,
    episodes: int,
    seen: str,
) -> tuple[list[tuple[np.ndarray, dict[str, np.ndarray]]] | None, Timeline | None]:
    """Return times [s] and states of the same policy in simulation, from rest, on timelines like the robot's.

    ``seen`` says which states: those of the ``world``, or as the ``sensor`` measures them, as late as on the robot.
    Steps that took longer than a period of the policy are left out: hiccups, after which it would make several steps at
    once, each of which the program would have to hold. What they did on the robot, the ages in the gap report tell.
    None and None where there is nothing to simulate with.
    """
    if values is None:
        return None, None
    try:
        computation, hiccups = computation_delays(episode, 1.0 / robot.RATE_HZ)
    except Sim2RealError as error:  # the robot has run: what it did must not be lost
        note(f"warning: nothing to compare with: {error.args[0]}")
        return None, None
    if hiccups:
        left = ", ".join(f"{count} of {name}" for name, count in hiccups.items())
        note(f"the simulation leaves out steps that took longer than a period of the policy: {left}")
    nodes, _ = robot.training(values, {}, computation, True)
    timeline = draw(nodes, duration_s, _SIMULATIONS, 0)
    make_room(nodes, timeline)
    graph = CompiledGraph(nodes, robot.SUPERVISOR, timeline)
    # Each deployment's own trial in turn: its simulation has the same to do.
    trials = [robot.simulation_params(values, policy, e % episodes) for e in range(_SIMULATIONS)]
    params = jax.tree_util.tree_map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trials)
    recorded = (seen, robot.SUPERVISOR, robot.COMMAND[0])

    def one(eps: jax.Array, params: Any) -> Any:
        return graph.rollout(graph.init(jax.random.key(0), params, eps=eps), record=recorded)[1]

    records = jax.tree_util.tree_map(np.asarray, jax.jit(jax.vmap(one))(np.arange(_SIMULATIONS), params))
    return [_run(graph, records, robot, e, seen) for e in range(_SIMULATIONS)], timeline


def _age_rows(robot: Robot, episodes: Sequence[Episode], timeline: Timeline | None) -> list[dict[str, Any]]:
    """Return rows of the gap table: how old the data were that policy and actuator acted on, on the robot and here."""
    rows = []
    for reader in (robot.SUPERVISOR, robot.COMMAND[0]):
        measured = [input_ages(e, reader) for e in episodes]
        for name in measured[0]:
            ages = [a[name][np.isfinite(a[name])] for a in measured if name in a]
            simulated = None
            if timeline is not None and (reader, name) in timeline.edges:
                simulated = _drawn_ages(timeline, reader, name)
            for label, of in (("p50", 0.5), ("max", 1.0)):
                r = _mean([float(np.quantile(a, of)) for a in ages if a.size])
                s = None if simulated is None else float(np.mean(np.quantile(simulated, of, axis=1)))
                gap = None if r is None or s is None else r - s
                quantity = f"age_of_{name}_in_{reader}_{label}_s"
                rows.append({"quantity": quantity, "real": r, "simulation": s, "gap": gap})
    return rows


def _drawn_ages(timeline: Timeline, reader: str, name: str) -> np.ndarray:
    """Return how old the newest message of each step is in drawn timelines [s]; the same steps of all, ``(E, N)``."""
    edge, vertex = timeline.edges[reader, name], timeline.vertices[reader]
    newest = newest_message(edge, vertex)[:, : int(vertex.count.min())]
    first = int((newest < 0).sum(axis=1).max())
    sent = np.take_along_axis(timeline.vertices[edge.sender].end, newest.clip(0), axis=1)
    return (vertex.start[:, : newest.shape[1]] - sent)[:, first:] / TICKS_PER_S


def _run(
    graph: CompiledGraph, records: Mapping[str, Any], robot: Robot, e: int, seen: str
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return times [s] and states of one simulation."""

    def sent(node: str) -> dict[str, Any]:
        ran = records[node].seq[e] >= 0
        return {n: np.asarray(leaf)[e][ran] for n, leaf in named_leaves(records[node].output).items()}

    def steps(node: str) -> np.ndarray:
        return records[node].seq[e][records[node].seq[e] >= 0]

    name, vertices = robot.COMMAND[0], graph.timeline.vertices
    when = vertices[name].end[e][steps(name)] / TICKS_PER_S
    columns = {**_sent(robot, sent(robot.SUPERVISOR), sent(name)), **_columns(sent(seen))}
    if seen == "world":  # a tick's message is its state at the end
        t_s = (steps(seen) + 1) / graph.nodes[seen].rate
    else:
        t_s = vertices[seen].start[e][steps(seen)] / TICKS_PER_S
    return t_s, {**columns, "t_command": when}


def _compare(robot: Robot, real: list[Any], simulated: list[Any] | None) -> dict[str, Any]:
    """Return the scores of every deployment, and the gap table: means over deployments and over simulations.

    None stands for a score that there is not, such as when a goal was reached that never was.
    """
    on_robot = [_scores(robot, t, s) for t, s in real]
    in_simulation = [_scores(robot, t, s) for t, s in simulated or []]
    episodes = [
        {"real": score, "simulation": in_simulation[i] if i < len(in_simulation) else None}
        for i, score in enumerate(on_robot)
    ]
    gap = []
    for quantity in on_robot[0]:
        r, s = (_mean([score[quantity] for score in scores]) for scores in (on_robot, in_simulation))
        gap.append({"quantity": quantity, "real": r, "simulation": s, "gap": None if r is None or s is None else r - s})
    return {"episodes": episodes, "gap": gap}


def _scores(robot: Robot, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in robot.score(t_s, states).items()}


def _mean(values: list[float | None]) -> float | None:
    there = [v for v in values if v is not None]
    return float(np.mean(there)) if there else None


def _first_episodes(simulated: list[Any] | None, count: int) -> dict[str, np.ndarray]:
    columns: dict[str, np.ndarray] = {}
    for i, (t, states) in enumerate((simulated or [])[:count]):
        columns |= {f"t_{i}": t, **{f"{name}_{i}": values for name, values in states.items()}}
    return columns
