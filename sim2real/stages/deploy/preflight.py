"""Checks before a deployment: the bundle is of this robot, and fits it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.run import StageFolder, newest, sha256
from sim2real.errors import Sim2RealError, UsageError
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.robot import RecordedRobot, Robot
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.load import shipped_policy
from sim2real.stages.shared.find_run import warn_of_stale
from sim2real.stages.terminal.console import note

_TRAIN, EMBEDDED = "train a policy for this pipeline", "embedded"


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
    if not port or (port == EMBEDDED) == (config.port == EMBEDDED):
        return
    names = {True: "the emulated robot", False: "a robot"}
    message = (
        f"the policy{where} was trained with parameters of {names[port == EMBEDDED]} (port {port}), and port "
        f"{config.port} has {names[config.port == EMBEDDED]}"
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
