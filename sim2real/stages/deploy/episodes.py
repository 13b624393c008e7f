"""The episodes of a deployment on the robot: open it, measure its delay, run the policy."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.deployment import PROBE
from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.recording import TRUTH
from sim2real.errors import DelayChanged, UsageError
from sim2real.graph.episode import StepRecord
from sim2real.hardware.device import Following
from sim2real.log.writer import McapRecorder
from sim2real.policy.contract import PolicyContract
from sim2real.policy.runner import BlendedRunner, Runner, UprightRunner
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.robots.nodes import deployment_nodes
from sim2real.robots.probe import Probe, StepAnswers, Witness, measure_delay
from sim2real.robots.robot import Robot, joint_columns, tilt_of
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.live import live_view, scene_of
from sim2real.stages.session.episode import Bench, opened
from sim2real.stages.terminal.console import note


def run_episodes(
    robot: Robot,
    bundle: Bundle,
    config: DeployConfig,
    logs: Sequence[Path],
    following: Following | None = None,
) -> str:
    """Run the policy for one episode a log; return the measured delay as a text, "" if it is not measured.

    Args:
        logs: The files to write, all in the folder of the deployment.
        following: How the joints follow their commands, by the identified model; None: by the device's `following`.

    Raises:
        Sim2RealError: The cause that stopped the robot.
    """
    policy: Runner = BlendedRunner(bundle.runner(), config.blend_s)
    if config.max_tilt_rad is not None and (tilt_rad := tilt_of(robot.task.observation)) is not None:
        policy = UprightRunner(policy, tilt_rad, config.max_tilt_rad)
    folder = logs[0].parent
    scene = partial(scene_of, robot)
    with live_view(config.view, folder, robot.name, scene), opened(robot, config, folder / TRUTH) as bench:
        if config.hold and bench.rig.gate.config.stale != "hold":
            raise UsageError("this robot's motors hold no position", hint="run without --hold")
        if following is not None:
            bench.rig.follow(following)
        _announce_following(bench.rig.following)
        # Measure the delay before the policy moves the robot: a policy trained for another delay may oscillate.
        delay = _measure_delay(bench, bundle.contract, config, folder)
        for i, log in enumerate(logs):
            _run_one(bench, policy, config, i, log)
    return delay


def _announce_following(following: Following | None) -> None:
    """Print the limits by which joints count as not following their commands, or that none are checked."""
    if following is None:
        note("no motor is watched for letting go: how it follows its commands is not known, or following_rad is inf")
        return
    limit = np.max(following.limit)
    most = f"{limit:.0%} of its push" if following.unit == "1" else f"{limit:.2g} {following.unit}"
    note(f"a joint that is more than {most} off its commands stops the robot, by {following.source}")


def _measure_delay(bench: Bench, contract: PolicyContract, config: DeployConfig, folder: Path) -> str:
    """Bring the robot to rest, measure its delay with small steps and log them; return the delay as a text."""
    drive = bench.robot.drive
    if config.dry_run or not config.measure_delay or drive.probe is None:
        return ""
    note("waiting for the robot to come to rest, then a few small steps to measure its delay")
    drive.prepare(bench.rig, config.settle_s)
    witness = Witness(bench.rig)
    try:
        return check_delay(drive.probe, witness, contract, config)
    finally:
        _write_probe(folder / PROBE, bench.robot, witness)


def _run_one(bench: Bench, policy: Runner, config: DeployConfig, trial: int, log: Path) -> None:
    length = f"{config.duration_s:g} s on {config.port}"
    if config.dry_run:
        note(f"dry run: the robot is not moved to its start; {length}")
    else:
        note(f"waiting for the robot to come to rest, then {length}")
        bench.robot.drive.prepare(bench.rig, config.settle_s)
    nodes, params = deployment_nodes(bench.robot, bench.rig, policy, trial)
    bench.run_episode(nodes, params, log, config.duration_s, "deploy", config.hold)


# -- the test of the delay, and its log, on which the model is tested like on an episode


def check_delay(probe: Probe, witness: Witness, contract: PolicyContract, config: DeployConfig) -> str:
    """Return the delay as a text, measured with small steps; refuse a policy that was not trained with it.

    Args:
        witness: Has the open robot, at rest and without torque; records commands and measurements.

    Raises:
        DelayChanged: The delay, or its variation, lies outside of the range in training.
        Sim2RealError: The robot does not answer.
    """
    if (trained := contract.trained_s.get(ROUND_TRIP)) is None:
        note("warning: the bundle does not list the delays of its training, so the robot's delay is not measured")
        return ""
    # A busy machine may delay single steps, so measure a misfit a second time.
    answers = measure_delay(witness, probe)
    if misfit(answers, trained, config.delay_tolerance_s):
        witness.rig.wait_until_still(config.settle_s)
        more = measure_delay(witness, probe).delays_s
        answers = replace(answers, delays_s=np.append(answers.delays_s, more))
    measured = f"{1e3 * answers.delay_s:.0f} ms, the middle half within {1e3 * answers.jitter_s:.0f} ms"
    if reason := misfit(answers, trained, config.delay_tolerance_s):
        message = f"the delay is {measured}: {reason}"
        if not config.force:
            raise DelayChanged(
                message,
                hint="record, identify and train again, or look for the delay in the report of a recording; to "
                "deploy all the same: --force",
            )
        note(f"warning: {message}")
    return measured


def misfit(answers: StepAnswers, trained: tuple[float, float], tolerance_s: float) -> str | None:
    """Return why a measured delay lies outside of the delays in training; None if it lies among them.

    Args:
        trained: Shortest and longest delay of the training [s].
        tolerance_s: Allowed distance from these two, and allowed additional variation [s].
    """
    low, high = trained
    shortest, longest = answers.between_s
    if not (longest >= low - tolerance_s and shortest <= high + tolerance_s):
        return f"the policy was trained with {1e3 * low:.0f} to {1e3 * high:.0f} ms"
    if answers.jitter_s > high - low + tolerance_s:
        return f"the policy was trained with delays that vary by {1e3 * (high - low):.0f} ms"
    return None


def _write_probe(log: Path, robot: Robot, witness: Witness) -> None:
    """Write the commands and measurements of the steps at the robot's rate; write nothing if there was no step.

    The steps were measured at a higher rate. The log omits measurements in between, so that a second of it weighs as
    much as a second of another log, and it omits repeated commands.
    """
    if not witness.measured or not witness.sent:
        return
    # Select measurements and commands at the robot's rate, and every command that changes.
    period_ns, start_ns = round(1e9 / robot.drive.rate_hz), min(witness.measured[0][0], witness.sent[0][0])
    measured = _apart([begin_ns for begin_ns, *_ in witness.measured], period_ns)
    changed = [i == 0 or not np.array_equal(goal, witness.sent[i - 1][2]) for i, (*_, goal) in enumerate(witness.sent)]
    sent = _apart([begin_ns for begin_ns, *_ in witness.sent], period_ns, changed)
    # Write them as steps of the sensor and the actuator.
    outputs = {SENSOR: robot.drive.at_rest, ACTUATOR: robot.drive.message(np.zeros(len(robot.task.action)))}
    graph = {n: {"rate_hz": robot.drive.rate_hz, "delay_s": 0.0, "inputs": {}} for n in outputs}
    metadata = {"pipeline": robot.name, "dry_run": False, "graph": graph, "probe": True}
    joints, units = {SENSOR: joint_columns(robot.drive.channels)}, dict.fromkeys(outputs, robot.units)
    recorder = McapRecorder(log, metadata, {}, outputs, [], joints, units)
    recorder.start(0, start_ns)
    read, message = robot.drive.read, robot.drive.message
    rows = [(SENSOR, k, *witness.measured[i][:2], read(witness.measured[i][2])) for k, i in enumerate(measured)]
    rows += [(ACTUATOR, k, *witness.sent[i][:2], message(witness.sent[i][2])) for k, i in enumerate(sent)]
    for node, seq, *times_ns, output in rows:
        begin, end = ((t_ns - start_ns) // 1000 for t_ns in times_ns)
        recorder.step(StepRecord(node, seq, begin, begin, begin, -1, end, 0), output)
    recorder.close("finished", 0, {})


def _apart(times_ns: list[int], period_ns: int, always: list[bool] | None = None) -> list[int]:
    """Return the indices of times that are at least a period apart, and of times that ``always`` marks."""
    selected: list[int] = []
    for i, t_ns in enumerate(times_ns):
        if not selected or t_ns - times_ns[selected[-1]] >= period_ns or (always is not None and always[i]):
            selected.append(i)
    return selected
