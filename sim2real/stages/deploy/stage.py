"""Run a policy on the robot, behind the safety gate, and compare with the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import PROBE, Deployment, Scores, log_of
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.recording import TRUTH, Recording
from sim2real.artifacts.run import StageFolder, finished, open_stage
from sim2real.errors import UsageError
from sim2real.hardware.safety.following import Following
from sim2real.installation import has_jax
from sim2real.robots.robot import RecordedRobot, Robot, in_world
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.deploy.episodes import run_episodes
from sim2real.stages.deploy.preflight import find_bundle, require_fit
from sim2real.stages.load import AnyRobot, defaults_of, moving, robot_of
from sim2real.stages.session.episode import check_deadlines, show_sessions
from sim2real.stages.shared import arguments
from sim2real.stages.shared.arguments import check_parameters, open_identification
from sim2real.stages.terminal.console import artifact_table, note
from sim2real.types import Json


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
        config: Default: that of the robot. A dict holds the fields that differ from it. The
            field ``bundle`` is ignored.
        identification: Parameters of the simulation, or their folder; without them there is no gap report.

    Returns:
        The episodes on the robot beside the same in simulation; ``summary`` has the summary of each session.

    Raises:
        Sim2RealError: The policy does not fit the robot, or the cause that stopped the robot.
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
        check_parameters(identification, robot)
    return _deployed(robot, bundle, folder, config, identification)


def _deployed(
    robot: Robot,
    bundle: Bundle,
    folder: Path,
    config: DeployConfig,
    identification: Identification | None,
) -> Deployment:
    """Run the policy on the robot, and compare with the simulation; all arguments are checked."""
    # Run the episodes on the robot.
    logs = [log_of(folder, i) for i in range(config.episodes)]
    following = None if identification is None else _following(robot, identification)
    summaries = run_episodes(robot, bundle, config, logs, following)
    recordings = [Recording.load(log, folder / TRUTH) for log in logs]
    if config.dry_run:
        # The robot did not move: there are no scores and no gap.
        scores, simulated = tuple(Scores({}) for _ in recordings), tuple({} for _ in recordings)
        units, sessions = dict(robot.units), tuple(summaries)
        return Deployment(scores, (), units, simulated, tuple(recordings), dry_run=True, summary=sessions)

    # Simulate the same. JAX programs are imported and compiled only now, when the robot is at rest.
    from sim2real.stages.deploy.simulation_gap import compare
    from sim2real.stages.deploy.verdict import judge

    world = None if identification is None else identification.world
    deployment = compare(in_world(robot, world), recordings, bundle, identification, config.duration_s)
    probe = folder / PROBE
    deployment = replace(deployment, probe=Recording.load(probe, folder / TRUTH) if probe.is_file() else None)

    # Judge the model and the policy.
    return replace(judge(deployment, robot, bundle, identification, folder), summary=tuple(summaries))


def run(robot: RecordedRobot, config: DeployConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Deploy the policy; write logs, scores and the gap to simulation into a stage folder. A dry run writes logs alone.

    Args:
        run_dir: Run folder to add to; None takes that of the bundle.
    """
    # Check the bundle before a folder is made.
    robot = _commanded(moving(robot), config)
    path, run_dir = find_bundle(robot, config, root, run_dir)
    bundle = Bundle.load(path)
    require_fit(robot, bundle, config)
    with open_stage(root, robot.name, "deploy", config, {"bundle": path}, run_dir, config.dry_run) as stage:
        # Name the logs first, so that the manifest of an interrupted deployment lists them.
        for i in range(config.episodes):
            stage.output(f"log_{i}", log_of(stage.folder, i).name)
        if config.port == "embedded":
            stage.output("truth", TRUTH)
        identification = _identification(robot, stage.run_dir)
        deployment = _deployed(robot, bundle, stage.folder, config, identification)
        summaries = deployment.summary
        show_sessions(summaries, config.dry_run, config.port == "embedded")
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
        stage.summary(_summary_lines(deployment, summaries))
        for summary in summaries if config.strict_timing else ():
            check_deadlines(summary)
    return stage.result


def _commanded(robot: Robot, config: DeployConfig) -> Robot:
    """Return the robot with the configured command."""
    if config.command is not None:
        commanded = getattr(robot, "commanded", None)
        if commanded is None:
            raise UsageError(f"pipeline {robot.name!r} follows no velocity", hint="run it without --command")
        robot = commanded(config.command)
    robot.task.at_rest(0)  # a task that needs JAX is refused before the robot moves
    return robot


def _following(robot: Robot, identification: Identification) -> Following | None:
    """Return how the robot follows its commands, by the identified model; None: the robot's computer has no model."""
    following = robot.model.following(identification.values) if has_jax() else None
    delays = [p.estimate for p in identification.parameters if p.name == ROUND_TRIP]
    if following is None or following.push is None:
        return following
    return replace(following, delay_s=delays[0]) if delays else None


def _identification(robot: RecordedRobot, run_dir: Path) -> Identification | None:
    """Return the run's newest identification; None if the run has none."""
    folder = finished(run_dir, "identify")
    return None if folder is None else open_identification(folder.output("parameters"), robot)


def _show(deployment: Deployment) -> None:
    """Print the gap to simulation, the tests of the model and the verdict of a deployment."""
    if deployment.gap:
        print(artifact_table(deployment.rows()))
    if deployment.trained:
        print(artifact_table(deployment.times_table()))
    if deployment.replay:
        print(artifact_table(deployment.replay_table()))
    if deployment.drift is not None:
        print(artifact_table(deployment.drift.rows()))
    if deployment.advice is not None:
        note(f"verdict: {deployment.advice.status}")
        for reason in deployment.advice.reasons:
            note(f"  {reason}")
        if deployment.advice.next:
            note(f"next: {deployment.advice.next}")


def _summary_lines(deployment: Deployment, summaries: Sequence[Mapping[str, Json]]) -> dict[str, Json]:
    """Return the lines that the console prints at the end."""
    scores = {f"success, deployment {i}": e.real.get("success") for i, e in enumerate(deployment.episodes)}
    last = summaries[-1]
    return {
        **{name: round(value, 3) for name, value in scores.items() if value is not None},
        **{name: value for name, value in last.items() if name == "measured delay"},
        "lost replies": last["lost_replies"],
        "late replies": last["late_replies"],
        "command timeouts": last["command_timeouts"],
    }
