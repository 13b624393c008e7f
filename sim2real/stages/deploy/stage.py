"""Run a policy on the robot, behind the safety gate, and compare with the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import PROBE, Deployment, Scores, log_of
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.recording import TRUTH, Recording
from sim2real.artifacts.run import StageFolder, finished, newest, open_stage, sha256
from sim2real.errors import Sim2RealError, UsageError
from sim2real.hardware.safety.following import Following
from sim2real.installation import has_jax
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.robot import RecordedRobot, Robot, in_world
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.deploy.episodes import run_episodes
from sim2real.stages.load import AnyRobot, defaults_of, moving, robot_of, shipped_policy
from sim2real.stages.session.episode import check_deadlines, show_sessions
from sim2real.stages.shared import arguments
from sim2real.stages.shared.arguments import check_parameters, open_identification
from sim2real.stages.shared.find_run import warn_of_stale
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


def find_bundle(
    robot: RecordedRobot, config: DeployConfig, root: Path, run_dir: Path | None
) -> tuple[Path, Path | None]:
    """Return the bundle's folder and the run folder to add to.

    The bundle is that of the flag, of the newest training, or the one that the pipeline ships.
    """
    if config.bundle is not None:
        return Path(config.bundle), run_dir
    try:
        training = newest(root, robot.name, "train", run_dir)
    except Sim2RealError:
        if (shipped := shipped_policy(robot.folder)) is None:
            raise
        note(f"pipeline {robot.name!r} has no training here: its shipped policy is deployed")
        return shipped, run_dir
    training = warn_of_stale(training)
    require_untouched(training)
    return training.output("bundle"), run_dir or training.run_dir


def require_untouched(training: StageFolder) -> None:
    """Refuse a bundle whose hash differs from the one in the manifest of its training.

    Raises:
        Sim2RealError: The hashes differ.
    """
    path, written = training.output("bundle"), training.manifest.outputs["bundle"].sha256
    if sha256(path) != written:
        raise Sim2RealError(
            f"{path} is not the bundle that its training wrote: its hash is not the one in the manifest",
            hint="train again; --bundle FOLDER deploys it without this check",
        )


def require_fit(robot: Robot, bundle: Bundle, config: DeployConfig) -> None:
    """Refuse a bundle for another robot, or one that exceeds the limits of this robot.

    Raises:
        Sim2RealError: Names the difference.
    """
    _require_robot(robot, bundle, config)
    if config.max_tilt_rad is not None and robot.agent.tilt_rad is None:
        raise UsageError("this robot does not measure its tilt", hint="run without --max-tilt-rad, or set tilt_rad")
    contract, where = bundle.contract, f"in {bundle.path}" if bundle.path else "that was trained"
    for verb, in_bundle, of_robot in (
        ("sees", _observations(contract.observation), _observations(robot.agent.observation)),
        ("sends", _actions(contract.action), _actions(robot.agent.action)),
    ):
        if in_bundle != of_robot:
            raise Sim2RealError(f"the policy {where} {verb} {in_bundle}, this robot has {of_robot}", hint=_TRAIN)
    if contract.rate_hz != robot.rate_hz:
        raise Sim2RealError(
            f"the policy {where} runs at {contract.rate_hz:g} Hz, this robot at {robot.rate_hz:g} Hz", hint=_TRAIN
        )
    for trained, term in zip(contract.observation, robot.agent.observation, strict=True):
        bounds = [trained.low, trained.high], [term.low, term.high]
        if trained.low and term.low and not np.allclose(*bounds, rtol=1e-6):
            raise Sim2RealError(
                f"the policy {where} was trained with {trained.name!r} from {trained.low} to {trained.high}, "
                f"this robot has {term.low} to {term.high}",
                hint=_TRAIN,
            )
    for action, limit in zip(contract.action, robot.agent.action, strict=True):
        # Training rounds the limits to float32.
        if action.low < np.float32(limit.low) or action.high > np.float32(limit.high):
            raise Sim2RealError(
                f"the policy {where} sends {action.name!r} from {action.low:g} to {action.high:g} {action.unit}, "
                f"this robot allows {limit.low:g} to {limit.high:g}",
                hint=_TRAIN,
            )
    for name, value in contract.limits.items():
        if name not in robot.agent.limits or not np.isclose(value, robot.agent.limits[name], rtol=1e-6):
            raise Sim2RealError(
                f"the policy {where} was trained with {name!r} = {value:g}, "
                f"this robot has {robot.agent.limits.get(name, 'no such limit')}",
                hint=_TRAIN,
            )


def _require_robot(robot: RecordedRobot, bundle: Bundle, config: DeployConfig) -> None:
    """Refuse a policy of another robot: of another pipeline, or of the emulated one on a port, and the reverse."""
    trained, port = bundle.contract.robot, bundle.contract.port
    where = f" in {bundle.path}" if bundle.path else ""
    if trained and robot.folder is not None and trained != robot.name:
        raise Sim2RealError(f"the policy{where} was trained for {trained!r}, this is {robot.name!r}", hint=_TRAIN)
    if not port or (port == _EMBEDDED) == (config.port == _EMBEDDED):
        return
    names = {True: "the emulated robot", False: "a robot"}
    message = (
        f"the policy{where} was trained with parameters of {names[port == _EMBEDDED]} (port {port}), and port "
        f"{config.port} has {names[config.port == _EMBEDDED]}"
    )
    if not config.force:
        raise Sim2RealError(
            message, hint="record, identify and train with the robot on this port; to deploy all the same: --force"
        )
    note(f"warning: {message}")


def _observations(terms: Sequence[ObservationTerm]) -> list[tuple[str, tuple[str, ...], int]]:
    return [(t.name, tuple(t.units), t.history) for t in terms]


def _actions(terms: Sequence[ActionTerm]) -> list[tuple[str, str]]:
    return [(t.name, t.unit) for t in terms]
