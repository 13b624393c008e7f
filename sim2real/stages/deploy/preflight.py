"""Checks before a deployment: the bundle fits the robot; the robot's delay is one of those in training."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.run.manifest import sha256
from sim2real.artifacts.run.run_folder import StageFolder, newest
from sim2real.errors import DelayChanged, Sim2RealError
from sim2real.policy.contract import ActionTerm, ObservationTerm, PolicyContract
from sim2real.robots.probe import StepAnswers, Witness, measure_delay
from sim2real.robots.robot import Robot
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.pipeline.find_run import warn_of_stale
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.terminal.console import note

_TRAIN = "train a policy for this pipeline"


def find_bundle(pipeline: Pipeline, config: DeployConfig, root: Path, run_dir: Path | None) -> tuple[Path, Path | None]:
    """Return the bundle's folder and the run folder to add to.

    The bundle is that of the flag, of the newest training, or the one that the pipeline ships.
    """
    if config.bundle is not None:
        return Path(config.bundle), run_dir
    try:
        training = newest(root, pipeline.name, "train", run_dir)
    except Sim2RealError:
        if not pipeline.shipped.is_dir():
            raise
        note(f"pipeline {pipeline.name!r} has no training here: its shipped policy is deployed")
        return pipeline.shipped, run_dir
    training = warn_of_stale(training)
    require_untouched(training)
    return training.output("bundle"), run_dir or training.run_dir


def require_untouched(training: StageFolder) -> None:
    """Refuse a bundle whose hash differs from the one in the manifest of its training.

    Raises:
        Sim2RealError: The hashes differ.
    """
    path, written = training.output("bundle"), training.manifest["outputs"]["bundle"].get("sha256")
    if sha256(path) != written:
        raise Sim2RealError(
            f"{path} is not the bundle that its training wrote: its hash is not the one in the manifest",
            hint="train again; --bundle FOLDER deploys it without this check",
        )


def require_fit(robot: Robot, bundle: Bundle) -> None:
    """Refuse a bundle for another robot, or one that exceeds the limits of this robot.

    Raises:
        Sim2RealError: Names the difference.
    """
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


def check_delay(robot: Robot, witness: Witness, contract: PolicyContract, config: DeployConfig) -> dict[str, str]:
    """Measure the robot's delay with small steps, and refuse a policy that was not trained with it.

    Args:
        witness: Holds the open robot, at rest and without torque; records the commands and the measurements.

    Returns:
        Lines of the summary.

    Raises:
        DelayChanged: The delay, or its variation, lies outside of the range in training.
        Sim2RealError: The robot does not answer.
    """
    if not config.measure_delay or config.dry_run or robot.drive.probe is None:
        return {}
    if (trained := contract.trained_s.get(ROUND_TRIP)) is None:
        note("warning: the bundle does not list the delays of its training, so the robot's delay is not measured")
        return {}
    # A busy machine may delay single steps, so a misfit is measured a second time.
    answers = measure_delay(witness, robot.drive.probe)
    if misfit(answers, trained, config.delay_tolerance_s):
        witness.rig.wait_until_still(config.settle_s)
        answers = StepAnswers(np.append(answers.delays_s, measure_delay(witness, robot.drive.probe).delays_s))
    measured = f"{1e3 * answers.delay_s:.0f} ms, the middle half within {1e3 * answers.jitter_s:.0f} ms"
    if reason := misfit(answers, trained, config.delay_tolerance_s):
        message = f"the delay is {measured}: {reason}"
        if not config.force:
            raise DelayChanged(
                message,
                hint="record, identify and train again, or see where the delay is in the report of a recording; to "
                "deploy all the same: --force",
            )
        note(f"warning: {message}")
    return {"measured delay": measured}


def misfit(answers: StepAnswers, trained: tuple[float, float], tolerance_s: float) -> str | None:
    """Return why a measured delay is none of the delays in training; None if it is one of them.

    Args:
        trained: Shortest and longest delay of the training [s].
        tolerance_s: Allowed distance from these, and allowed additional variation [s].
    """
    low, high = trained
    if not low - tolerance_s <= answers.delay_s <= high + tolerance_s:
        return f"the policy was trained with {1e3 * low:.0f} to {1e3 * high:.0f} ms"
    if answers.jitter_s > high - low + tolerance_s:
        return f"the policy was trained with delays that vary by {1e3 * (high - low):.0f} ms"
    return None


def _observations(terms: Sequence[ObservationTerm]) -> list[tuple[str, tuple[str, ...], int]]:
    return [(t.name, tuple(t.units), t.history) for t in terms]


def _actions(terms: Sequence[ActionTerm]) -> list[tuple[str, str]]:
    return [(t.name, t.unit) for t in terms]
