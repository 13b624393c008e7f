"""Run a policy on the robot, behind the safety gate, and compare with the simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import PROBE, Deployment, EpisodeRow, log_of
from sim2real.artifacts.identification import ROUND_TRIP, Identification, compared_table
from sim2real.artifacts.recording import TRUTH, Recording
from sim2real.artifacts.run import StageFolder, finished, open_stage
from sim2real.errors import Sim2RealError, UsageError
from sim2real.hardware.device import Following
from sim2real.installation import has_jax
from sim2real.policy.contract import PolicyContract
from sim2real.robots.robot import GRAVITY, RecordedRobot, Robot, RobotTask, tilt_of
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.deploy.episodes import run_episodes
from sim2real.stages.load import AnyRobot, defaults_of, moving, robot_of, shipped_policy
from sim2real.stages.session.episode import check_deadlines, show_sessions
from sim2real.stages.shared import arguments
from sim2real.stages.shared.arguments import in_world_of
from sim2real.stages.shared.find_run import find_bundle
from sim2real.stages.terminal.console import artifact_table, note
from sim2real.types import Json

_TRAIN, _EMBEDDED = "train a policy for this pipeline", "embedded"


def deploy(
    robot: AnyRobot,
    bundle: arguments.AnyBundle,
    folder: arguments.AnyPath,
    config: DeployConfig | Mapping[str, object] | None = None,
    identification: arguments.AnyIdentification | None = None,
) -> Deployment:
    """Run a policy on the robot, and compare with the simulation.

    Args:
        robot: The robot, or the name of its pipeline.
        bundle: The policy, or its folder.
        folder: Folder for the logs; a log is never overwritten.
        config: Settings; default: the robot's. A dict has the settings that differ from these. The field ``bundle`` is
            ignored.
        identification: Parameters of the simulation, or their folder; without them there is no comparison.

    Returns:
        The episodes on the robot, with the same episodes in simulation.

    Raises:
        Sim2RealError: The policy does not fit the robot, or the robot was stopped.
    """
    # Check all arguments before the robot moves.
    robot = robot_of(robot)
    bundle, folder = arguments.bundle_of(bundle), arguments.folder_of(folder)
    config = arguments.config_of(config, defaults_of(robot).deploy)
    if identification is not None:
        identification = arguments.identification_of(identification)
    robot = _commanded(moving(robot), config)
    require_fit(robot, bundle, config)
    if identification is not None:
        robot = in_world_of(identification, robot)
    return _deployed(robot, bundle, folder, config, identification)


def _deployed(
    robot: Robot,
    bundle: Bundle,
    folder: Path,
    config: DeployConfig,
    identification: Identification | None,
) -> Deployment:
    """Run the policy on the robot, and compare with the simulation; all arguments are checked.

    Args:
        robot: In the world of the identification.
    """
    # Run the episodes on the robot.
    logs = [log_of(folder, i) for i in range(config.episodes)]
    following = None if identification is None else _following(robot, identification)
    delay = run_episodes(robot, bundle, config, logs, following)
    recordings = tuple(Recording.load(log) for log in logs)
    if config.dry_run:
        # The robot did not move: there are no scores.
        return Deployment(tuple(EpisodeRow({}) for _ in recordings), dry_run=True, recordings=recordings)

    # Simulate the same. JAX programs are imported and compiled only now, when the robot is at rest.
    from sim2real.stages.deploy.simulation import compare
    from sim2real.stages.deploy.verdict import judge

    deployment = compare(robot, recordings, bundle, identification, config.duration_s, config.blend_s)
    probe = Recording.load(folder / PROBE) if (folder / PROBE).is_file() else None

    # Judge the model and the policy.
    deployment = replace(deployment, probe=probe, measured_delay=delay)
    return judge(deployment, robot, identification, folder)


def run(robot: RecordedRobot, config: DeployConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Deploy the policy; write logs, scores and the comparison into a stage folder. A dry run writes only logs.

    Args:
        run_dir: Run folder to add to; None: the bundle's.
    """
    # Check the bundle before a folder is made. A policy from a run is deployed in the same run.
    robot = _commanded(moving(robot), config)
    path = find_bundle(config.bundle or robot.name, root, run_dir)
    if path == shipped_policy(robot.folder):
        note(f"pipeline {robot.name!r} has no training here: its shipped policy is deployed")
    elif config.bundle is None:
        run_dir = run_dir or path.parent.parent
    bundle = Bundle.load(path)
    require_fit(robot, bundle, config)
    with open_stage(root, robot.name, "deploy", config, {"bundle": path}, run_dir, config.dry_run) as stage:
        # Name the logs first, so that the manifest of an interrupted deployment lists them.
        for i in range(config.episodes):
            stage.output(f"log_{i}", log_of(stage.folder, i).name)
        if config.port == "embedded":
            stage.output("truth", TRUTH)
        identified = finished(stage.run_dir, "identify")
        identification = None
        if identified is not None:
            identification = Identification.load(identified.output("parameters"))
            robot = in_world_of(identification, robot)
        deployment = _deployed(robot, bundle, stage.folder, config, identification)
        show_sessions(deployment.recordings, robot)
        if config.dry_run:
            note("dry run: the robot did not move, so there is no gap report")

        # Write the results, then the page about them.
        for name, file in deployment.save(stage.folder).items():
            stage.output(name, file)
        if deployment.probe is not None:
            stage.output("probe", PROBE)
        for i, recording in enumerate(deployment.recordings):
            for name, file in recording.timing.save(stage.folder, f"timing_{i}").items():
                stage.output(name, file)
        _show(deployment)
        stage.summary(_summary_lines(deployment))
        for recording in deployment.recordings if config.strict_timing else ():
            check_deadlines(recording.summary)
    return stage.result


def _commanded(robot: Robot, config: DeployConfig) -> Robot:
    """Return the robot with the configured command."""
    if config.command is not None:
        commanded = getattr(robot, "commanded", None)
        if commanded is None:
            raise UsageError(f"pipeline {robot.name!r} follows no velocity", hint="run it without --command")
        robot = commanded(config.command)
    robot.task.at_rest(0)  # raises an error before the robot moves if the task needs JAX
    return robot


def _following(robot: Robot, identification: Identification) -> Following | None:
    """Return how the robot follows its commands, by the identified model; None if this computer lacks JAX."""
    following = robot.model.following(identification.values) if has_jax() else None
    delays = [p.estimate for p in identification.parameters if p.name == ROUND_TRIP]
    if following is None or following.push is None:
        return following
    return replace(following, delay_s=delays[0]) if delays else None


def _show(deployment: Deployment) -> None:
    """Print the scores, the tests of the model and the verdict of a deployment."""
    tables = [deployment.rows(), compared_table(deployment.replay)]
    tables += [] if deployment.drift is None else [deployment.drift.rows()]
    for content in tables:
        if content.rows:
            print(artifact_table(content))
    if (verdict := deployment.verdict) is not None:
        note("\n  ".join([f"verdict: {verdict.status}", *deployment.reasons]))
        if verdict.next:
            note(f"next: {verdict.next}")


def _summary_lines(deployment: Deployment) -> dict[str, Json]:
    """Return the lines that the console prints at the end; the counts are those of the whole session."""
    last = deployment.recordings[-1].summary
    scores = {f"success, episode {i}": e.real.get("success") for i, e in enumerate(deployment.episodes)}
    counts = {name: last[name.replace(" ", "_")] for name in ("lost replies", "late replies", "command timeouts")}
    measured = {"measured delay": deployment.measured_delay} if deployment.measured_delay else {}
    return {**{name: round(v, 3) for name, v in scores.items() if v is not None}, **measured, **counts}


def require_fit(robot: Robot, bundle: Bundle, config: DeployConfig) -> None:
    """Refuse a bundle for another robot, or one that exceeds the limits of this robot.

    Raises:
        Sim2RealError: Names the difference.
    """
    contract, task = bundle.contract, robot.task
    where = f"in {bundle.path}" if bundle.path else "that was trained"
    if contract.robot and robot.folder is not None and contract.robot != robot.name:
        raise Sim2RealError(
            f"the policy {where} was trained for {contract.robot!r}, this is {robot.name!r}", hint=_TRAIN
        )
    if contract.port and (contract.port == _EMBEDDED) != (config.port == _EMBEDDED):
        _refuse_port(contract.port, config, where)
    if config.max_tilt_rad is not None and tilt_of(task.observation) is None:
        raise UsageError(
            "this robot does not measure its tilt",
            hint=f"run without --max-tilt-rad, or add the term {GRAVITY!r} to the observation",
        )

    def terms(of: PolicyContract | RobotTask) -> dict[str, object]:
        seen = [(t.name, tuple(t.units), t.history) for t in of.observation]
        return {"sees": seen, "sends": [(t.name, t.unit) for t in of.action]}

    # For each difference: what the policy has, and what the robot has.
    rows: list[tuple[str, str]] = []
    for (verb, trained), here in zip(terms(contract).items(), terms(task).values(), strict=True):
        rows += [(f"{verb} {trained}", f"has {here}")] if trained != here else []
    if contract.rate_hz != robot.drive.rate_hz:
        rows.append((f"runs at {contract.rate_hz:g} Hz", f"at {robot.drive.rate_hz:g} Hz"))
    for trained, term in zip(contract.observation, task.observation, strict=False):
        bounds = [trained.low, trained.high], [term.low, term.high]
        if not rows and trained.low and term.low and not np.allclose(*bounds, rtol=1e-6):
            trains = f"was trained with {trained.name!r} from {trained.low} to {trained.high}"
            rows.append((trains, f"has {term.low} to {term.high}"))
    for action, limit in zip(contract.action, task.action, strict=False):
        # Training rounds the limits to float32.
        if action.low < np.float32(limit.low) or action.high > np.float32(limit.high):
            sends = f"sends {action.name!r} from {action.low:g} to {action.high:g} {action.unit}"
            rows.append((sends, f"allows {limit.low:g} to {limit.high:g}"))
    for name, value in contract.limits.items():
        if name not in task.limits or not np.isclose(value, task.limits[name], rtol=1e-6):
            rows.append((f"was trained with {name!r} = {value:g}", f"has {task.limits.get(name, 'no such limit')}"))
    if rows:
        raise Sim2RealError(f"the policy {where} {rows[0][0]}, this robot {rows[0][1]}", hint=_TRAIN)


def _refuse_port(trained: str, config: DeployConfig, where: str) -> None:
    """Refuse a policy of the emulated robot on a port, and the reverse; with ``force`` warn."""
    names = {True: "the emulated robot", False: "a robot"}
    message = (
        f"the policy {where} was trained with parameters of {names[trained == _EMBEDDED]} (port {trained}), and port "
        f"{config.port} has {names[config.port == _EMBEDDED]}"
    )
    if not config.force:
        raise Sim2RealError(
            message, hint="record, identify and train with the robot on this port; to deploy all the same: --force"
        )
    note(f"warning: {message}")
