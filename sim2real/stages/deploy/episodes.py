"""The episodes of a deployment on the robot: open it, measure its delay, run the policy."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.recording import TRUTH
from sim2real.errors import UsageError
from sim2real.hardware.safety.following import Following
from sim2real.policy.runner import BlendedRunner, UprightRunner
from sim2real.robots.probe import Witness
from sim2real.robots.robot import Robot, Session
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.deploy.preflight import check_delay
from sim2real.stages.deploy.probe_log import write_probe
from sim2real.stages.live.scene import scene_of
from sim2real.stages.live.viewer import live_view
from sim2real.stages.on_robot.episode import check_deadlines, run_episode
from sim2real.stages.on_robot.open_robot import announce_following, opened
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import note
from sim2real.types import Json

PolicyRunner = BlendedRunner | UprightRunner


def run_episodes(
    pipeline: Pipeline,
    robot: Robot,
    bundle: Bundle,
    config: DeployConfig,
    logs: Sequence[Path],
    following: Following | None = None,
) -> list[dict[str, Json]]:
    """Run the policy for one episode a log; return the summary of each session.

    Args:
        logs: The files to write, all in the folder of the deployment.
        following: How the joints follow their commands, by the identified model; None: as the device says.

    Raises:
        Sim2RealError: The cause that stopped the robot.
    """
    policy, folder = _policy_runner(bundle, robot, config), logs[0].parent
    scene = partial(scene_of, pipeline, robot)
    with live_view(config.view, folder, pipeline.name, scene), opened(robot, config, folder / TRUTH) as session:
        if config.hold and session.rig.gate.config.stale != "hold":
            raise UsageError("this robot's motors hold no position", hint="run without --hold")
        if following is not None:
            session.rig.follow(following)
        announce_following(session.rig)
        # Measure the delay before the policy moves the robot: a policy trained for another delay may oscillate.
        delay = _measure_delay(pipeline, robot, session, bundle, config, folder)
        summaries = [_run_one(pipeline, robot, session, policy, i, log, config) for i, log in enumerate(logs)]
    return [{**summary, **delay} for summary in summaries]


def check_timing(summaries: Sequence[Mapping[str, Json]], config: DeployConfig) -> None:
    """Raise the error of ``--strict-timing`` if a session has too many late steps."""
    if config.strict_timing:
        for summary in summaries:
            check_deadlines(summary)


def require_tilt(robot: Robot, config: DeployConfig) -> None:
    """Refuse a limit of the tilt for a robot that does not measure its tilt."""
    if config.max_tilt_rad is not None and robot.agent.tilt_rad is None:
        raise UsageError("this robot does not measure its tilt", hint="run without --max-tilt-rad, or set tilt_rad")


def _policy_runner(bundle: Bundle, robot: Robot, config: DeployConfig) -> PolicyRunner:
    """Return the policy's runner. Its actions grow during ``blend_s``, and a limit of the tilt stops the robot."""
    blended = BlendedRunner(bundle.runner(config.backend), config.blend_s)
    tilt_rad, limit_rad = robot.agent.tilt_rad, config.max_tilt_rad
    return blended if limit_rad is None or tilt_rad is None else UprightRunner(blended, tilt_rad, limit_rad)


def _measure_delay(
    pipeline: Pipeline, robot: Robot, session: Session, bundle: Bundle, config: DeployConfig, folder: Path
) -> dict[str, str]:
    """Bring the robot to rest, measure its delay with small steps and log them; return a line of the summary."""
    if config.dry_run or not config.measure_delay or robot.drive.probe is None:
        return {}
    note("waiting for the robot to come to rest, then a few small steps to measure its delay")
    robot.drive.prepare(session, config.settle_s)
    witness = Witness(session.rig)
    try:
        return check_delay(robot, witness, bundle.contract, config)
    finally:
        write_probe(folder, pipeline, robot, witness)


def _run_one(
    pipeline: Pipeline,
    robot: Robot,
    session: Session,
    policy: PolicyRunner,
    trial: int,
    log: Path,
    config: DeployConfig,
) -> dict[str, Json]:
    """Run one episode; return the summary of its session."""
    length = f"{config.duration_s:g} s on {config.port}"
    if config.dry_run:
        note(f"dry run: the robot is not moved to its start; {length}")
    else:
        note(f"waiting for the robot to come to rest, then {length}")
        robot.drive.prepare(session, config.settle_s)
    nodes, params = robot.deployment_nodes(session, policy, trial)
    return run_episode(pipeline, robot, session, nodes, params, log, config.duration_s, config, "deploy", config.hold)
