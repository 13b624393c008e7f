"""Run a policy on the robot, behind the safety gate, and compare with the simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import PROBE, Deployment, Scores, log_of
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import TRUTH, Recording
from sim2real.artifacts.run.run_folder import StageFolder, finished, newest, open_stage
from sim2real.errors import UsageError
from sim2real.policy.blended import BlendedRunner
from sim2real.policy.upright import UprightRunner
from sim2real.robots.contract import Robot, Session
from sim2real.robots.probe import Witness
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.deploy.preflight import check_delay, require_fit, require_untouched
from sim2real.stages.deploy.probe_log import write_probe
from sim2real.stages.on_robot.episode import check_deadlines, run_episode, timing_rows
from sim2real.stages.on_robot.open_robot import opened, show_withheld, warn
from sim2real.stages.pipeline.find_run import warn_of_stale
from sim2real.stages.pipeline.load_robot import moving_robot
from sim2real.stages.pipeline.open_parameters import check_parameters, open_identification
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.pipeline.python_arguments import (
    AnyBundle,
    AnyIdentification,
    AnyPath,
    bundle_of,
    config_of,
    folder_of,
    identification_of,
    robot_first,
)
from sim2real.stages.terminal.console import artifact_table, note, table


def deploy(
    robot: Robot | Pipeline | str,
    bundle: AnyBundle,
    folder: AnyPath,
    config: DeployConfig | Mapping[str, Any] | None = None,
    identification: AnyIdentification | None = None,
) -> Deployment:
    """Run a policy on the robot, and compare with the simulation.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        bundle: The policy, or its folder.
        folder: Takes the logs; a log is never overwritten.
        config: How; default: that of the pipeline that loaded the robot. A dict has what is different from it. The
            bundle that it may name is not read.
        identification: What to simulate with, or its folder; without one nothing is compared.

    Returns:
        What happened on the robot beside the same in simulation; its ``summary`` has that of each episode's session.

    Raises:
        Sim2RealError: When the policy does not fit the robot, or what stopped the robot.
    """
    pipeline, bundle = robot_first(robot, bundle)
    bundle, folder = bundle_of(bundle), folder_of(folder)
    config = config_of(config, pipeline.deploy)
    identification = None if identification is None else identification_of(identification)
    robot = moving_robot(pipeline)
    require_fit(robot, bundle)
    _require_tilt(robot, config)
    policy = _careful(bundle, robot, config)
    if identification is not None:
        check_parameters(identification, pipeline)
    logs = [log_of(folder, i) for i in range(config.episodes)]
    with opened(robot, config, folder / TRUTH) as session:
        if config.hold and session.rig.gate.config.stale != "hold":
            raise UsageError("this robot's motors hold no position", hint="leave out --hold")
        delay = _measured_delay(pipeline, robot, session, bundle, config, folder)
        sessions = [_episode(pipeline, robot, session, policy, i, log, config) for i, log in enumerate(logs)]
    recordings = [Recording.load(log, folder / TRUTH) for log in logs]
    if config.dry_run:  # nothing was moved: there is nothing to judge or to compare
        nothing = tuple(Scores({}) for _ in recordings)
        none: tuple[dict[str, np.ndarray], ...] = tuple({} for _ in recordings)
        units = dict(robot.units)
        return Deployment(nothing, (), units, none, tuple(recordings), dry_run=True, summary=tuple(sessions))
    sessions = [{**summary, **delay} for summary in sessions]
    from sim2real.stages.deploy.simulation_gap import (
        compare,  # what simulates is imported, and compiled, when the robot is at rest
    )
    from sim2real.stages.deploy.verdict import judged
    from sim2real.train.networks.policy import Policy

    world = None if identification is None else identification.world
    trained = Policy.from_weights(bundle.weights, bundle.spec)
    gap = compare(moving_robot(pipeline, world), recordings, trained, identification, config.duration_s)
    probe = folder / PROBE
    gap = replace(gap, probe=Recording.load(probe, folder / TRUTH) if probe.is_file() else None)
    return replace(judged(gap, pipeline, bundle, identification, folder), summary=tuple(sessions))


def run(pipeline: Pipeline, config: DeployConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Deploy the policy and write logs, scores and the gap to simulation into a stage folder; in a dry run logs alone.

    Args:
        run_dir: Run folder to add to; None takes the one of the bundle.
    """
    robot = moving_robot(pipeline)
    path, run_dir = _find_bundle(pipeline, config, root, run_dir)
    bundle = Bundle.load(path)
    require_fit(robot, bundle)  # one of another robot is refused before a folder is made
    _require_tilt(robot, config)
    with open_stage(root, pipeline.name, "deploy", config, {"bundle": path}, run_dir, config.dry_run) as stage:
        for i in range(config.episodes):
            stage.output(f"log_{i}", log_of(stage.folder, i).name)
        if config.port == "embedded":
            stage.output("truth", TRUTH)
        found = deploy(pipeline, bundle, stage.folder, config, _identified(pipeline, stage.run_dir))
        sessions = found.summary
        print(table(*timing_rows(sessions[-1])))
        for summary in sessions:
            warn(summary)
        if config.dry_run:
            show_withheld(sessions)
            note("dry run: there is no gap report, for nothing was moved that a simulation could be compared with")
        for name, file in found.save(stage.folder).items():
            stage.output(name, file)
        if found.probe is not None:
            stage.output("probe", PROBE)
        for i, recording in enumerate(found.recordings):
            for name, file in recording.timing.save(stage.folder, f"timing_{i}").items():
                stage.output(name, file)
        from sim2real.view.page.page import deploy_page  # matplotlib and jinja2 take 0.5 s to import

        stage.output("page", deploy_page(stage.folder).name)
        if found.gap:
            print(artifact_table(found.rows()))
        from sim2real.stages.deploy.verdict import show

        show(found)
        stage.summary(_summary(found, sessions))
        if config.strict_timing:
            for summary in sessions:
                check_deadlines(summary)
    return stage.result


def _careful(bundle: Bundle, robot: Robot, config: DeployConfig) -> BlendedRunner | UprightRunner:
    """Return what runs the policy: let in slowly, and stopped by a robot that leans too far, as far as asked for."""
    blended = BlendedRunner(bundle.runner(config.backend), config.blend_s)
    return blended if config.max_tilt_rad is None else UprightRunner(blended, robot.tilt_rad, config.max_tilt_rad)


def _require_tilt(robot: Robot, config: DeployConfig) -> None:
    if config.max_tilt_rad is not None and type(robot).tilt_rad is Robot.tilt_rad:
        raise UsageError("this robot does not see its tilt", hint="leave out --max-tilt-rad, or define tilt_rad")


def _measured_delay(
    pipeline: Pipeline, robot: Robot, session: Session, bundle: Bundle, config: DeployConfig, folder: Path
) -> dict[str, Any]:
    """Return what was found of the delay, for the summary; the robot is brought to rest before, its answers logged."""
    if config.dry_run or not config.measure_delay or robot.probe is None:
        return {}
    note("waiting for the robot to come to rest, then a few small steps to measure its delay")
    robot.prepare(session, config.settle_s)
    witness = Witness(session.rig)
    try:
        return check_delay(robot, witness, bundle.contract, config)
    finally:
        write_probe(folder, pipeline, robot, witness)


def _summary(found: Deployment, sessions: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the few lines that the console shows at the end."""
    scores = {f"success, deployment {i}": e.real.get("success") for i, e in enumerate(found.episodes)}
    success = {name: round(value, 3) for name, value in scores.items() if value is not None}
    return {
        **success,
        **{name: said for name, said in sessions[-1].items() if name == "measured delay"},
        "lost replies": sessions[-1]["lost_replies"],
        "late replies": sessions[-1]["late_replies"],
        "odd measurements": sum(len(summary["suspects"]) for summary in sessions),
        "command timeouts": sessions[-1]["command_timeouts"],
    }


def _episode(
    pipeline: Pipeline,
    robot: Robot,
    session: Session,
    policy: BlendedRunner | UprightRunner,
    trial: int,
    log: Path,
    config: DeployConfig,
) -> dict[str, Any]:
    """Run one episode; return its session's summary."""
    then = f"{config.duration_s:g} s on {config.port}"
    if config.dry_run:  # to bring it to its start would move it
        note(f"dry run: the robot stays where it is, not brought to its start; {then}")
    else:
        note(f"waiting for the robot to come to rest, then {then}")
        robot.prepare(session, config.settle_s)
    nodes, params = robot.deployment_nodes(session, policy, trial)
    return run_episode(pipeline, robot, session, nodes, params, log, config.duration_s, config, "deploy", config.hold)


def _find_bundle(
    pipeline: Pipeline, config: DeployConfig, root: Path, run_dir: Path | None
) -> tuple[Path, Path | None]:
    if config.bundle is not None:
        return Path(config.bundle), run_dir
    trained = warn_of_stale(newest(root, pipeline.name, "train", run_dir))
    require_untouched(trained)
    return trained.output("bundle"), run_dir or trained.run_dir


def _identified(pipeline: Pipeline, run_dir: Path) -> Identification | None:
    """Return what to simulate with, read before anything moves; None when the run holds none."""
    identified = finished(run_dir, "identify")
    return None if identified is None else open_identification(identified.output("parameters"), pipeline)
