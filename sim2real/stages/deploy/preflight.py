"""What deploy asks of a policy bundle before anything moves, and of the robot's delay before the policy moves it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.run.manifest import sha256
from sim2real.artifacts.run.run_folder import StageFolder
from sim2real.errors import DelayChanged, Sim2RealError
from sim2real.policy.contract import ActionTerm, ObservationTerm, PolicyContract
from sim2real.robots.contract import Robot
from sim2real.robots.probe import StepAnswers, Witness, measure_delay
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.terminal.console import note

_TRAIN = "train a policy for this pipeline"


def require_untouched(trained: StageFolder) -> None:
    """Refuse a bundle that is not the one that its training wrote.

    Raises:
        Sim2RealError: Its hash is not that of the manifest.
    """
    path, written = trained.output("bundle"), trained.manifest["outputs"]["bundle"].get("sha256")
    if sha256(path) != written:
        raise Sim2RealError(
            f"{path} is not the bundle that its training wrote: its hash is not the one in the manifest",
            hint="train again; to deploy it all the same, name it with --bundle",
        )


def require_fit(robot: Robot, bundle: Bundle) -> None:
    """Refuse a bundle that is for another robot, or asks for what this one does not bear.

    Raises:
        Sim2RealError: Naming what is different, or the policy is a teacher.
    """
    bundle.spec.refuse_teacher()
    contract, where = bundle.contract, f"in {bundle.path}" if bundle.path else "that was trained"
    for kind, found, expected in (
        ("sees", _seen(contract.observation), _seen(robot.observation)),
        ("sends", _sent(contract.action), _sent(robot.action)),
    ):
        if found != expected:
            raise Sim2RealError(f"the policy {where} {kind} {found}, this robot has {expected}", hint=_TRAIN)
    if contract.rate_hz != robot.rate_hz:
        raise Sim2RealError(
            f"the policy {where} runs at {contract.rate_hz:g} Hz, this robot at {robot.rate_hz:g} Hz", hint=_TRAIN
        )
    for own, other in zip(contract.observation, robot.observation, strict=True):
        if own.low and other.low and not np.allclose([own.low, own.high], [other.low, other.high], rtol=1e-6):
            raise Sim2RealError(
                f"the policy {where} was trained with {own.name!r} from {own.low} to {own.high}, "
                f"this robot says {other.low} to {other.high}",
                hint=_TRAIN,
            )
    for action, most in zip(contract.action, robot.action, strict=True):
        if action.low < np.float32(most.low) or action.high > np.float32(most.high):  # training rounds them so
            raise Sim2RealError(
                f"the policy {where} sends {action.name!r} from {action.low:g} to {action.high:g} {action.unit}, "
                f"this robot bears {most.low:g} to {most.high:g}",
                hint=_TRAIN,
            )
    for name, limit in contract.limits.items():
        if name not in robot.limits or not np.isclose(limit, robot.limits[name], rtol=1e-6):
            raise Sim2RealError(
                f"the policy {where} was trained with {name!r} = {limit:g}, "
                f"this robot has {robot.limits.get(name, 'no such limit')}",
                hint=_TRAIN,
            )


def check_delay(robot: Robot, witness: Witness, contract: PolicyContract, config: DeployConfig) -> dict[str, Any]:
    """Measure the robot's delay with small steps, and stop where the policy was not trained with it.

    Args:
        robot: The robot, whose steps they are.
        witness: Has the robot, open and at rest, without torque, and leaves it so; keeps what is measured and sent.

    Returns:
        Lines for the summary.

    Raises:
        DelayChanged: The delay, or by how much it varies, lies outside of what the policy was trained with.
        Sim2RealError: The robot does not answer.
    """
    if not config.measure_delay or config.dry_run or robot.probe is None:
        return {}
    if (trained := contract.trained_s.get(ROUND_TRIP)) is None:
        note("warning: the policy does not say with which delays it was trained, so the robot's is not measured")
        return {}
    found = measure_delay(witness, robot.probe)
    if misfit(found, trained, config.delay_tolerance_s):  # a busy machine delays one step or another: look once more
        witness.rig.wait_until_still(config.settle_s)
        found = StepAnswers(np.append(found.delays_s, measure_delay(witness, robot.probe).delays_s))
    said = f"{1e3 * found.delay_s:.0f} ms, the middle half within {1e3 * found.jitter_s:.0f} ms"
    if reason := misfit(found, trained, config.delay_tolerance_s):
        what = f"the delay is {said}: {reason}"
        if not config.force:
            raise DelayChanged(
                what,
                hint="record, identify and train again, or see where the delay is: sim2real latency; to deploy all "
                "the same: --force",
            )
        note(f"warning: {what}")
    return {"measured delay": said}


def misfit(found: StepAnswers, trained: tuple[float, float], tolerance_s: float) -> str | None:
    """Return in words why a measured delay is not one that a policy was trained with; None: it is.

    Args:
        trained: Shortest and longest of the training [s].
        tolerance_s: How far it may lie outside, and how much more it may vary [s].
    """
    low, high = trained
    if not low - tolerance_s <= found.delay_s <= high + tolerance_s:
        return f"the policy was trained with {1e3 * low:.0f} to {1e3 * high:.0f} ms"
    if found.jitter_s > high - low + tolerance_s:
        return f"the policy was trained with delays that vary by {1e3 * (high - low):.0f} ms"
    return None


def _seen(terms: Sequence[ObservationTerm]) -> list[tuple[str, tuple[str, ...], int]]:
    return [(t.name, tuple(t.units), t.history) for t in terms]


def _sent(terms: Sequence[ActionTerm]) -> list[tuple[str, str]]:
    return [(t.name, t.unit) for t in terms]
