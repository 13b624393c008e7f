"""The log of the small steps that measure the delay; the model is tested on it as on an episode."""

from pathlib import Path

import numpy as np

from sim2real.artifacts.deployment import PROBE
from sim2real.graph.episode import StepRecord
from sim2real.log.writer import McapRecorder
from sim2real.robots.loop import ACTUATOR, SENSOR
from sim2real.robots.probe import Witness
from sim2real.robots.robot import Robot
from sim2real.stages.pipeline.pipeline import Pipeline


def write_probe(folder: Path, pipeline: Pipeline, robot: Robot, witness: Witness) -> Path | None:
    """Write the commands and measurements of the steps at the robot's rate; return the log.

    The steps ran faster than that. The log omits the measurements in between, so that a second of it weighs as much as
    a second of any other log, and it omits repeated commands.

    Returns:
        None if no step was made.
    """
    if not witness.measured or not witness.sent:
        return None
    # Select the measurements and commands at the robot's rate; a command that changes is always selected.
    sensor, actuator = SENSOR, ACTUATOR
    period_ns, start_ns = round(1e9 / robot.rate_hz), min(witness.measured[0][0], witness.sent[0][0])
    measured = _apart([begin_ns for begin_ns, *_ in witness.measured], period_ns)
    changed = [i == 0 or not np.array_equal(goal, witness.sent[i - 1][2]) for i, (*_, goal) in enumerate(witness.sent)]
    sent = _apart([begin_ns for begin_ns, *_ in witness.sent], period_ns, changed)
    # Write them as steps of the sensor and the actuator.
    outputs = {sensor: robot.sensor.at_rest, actuator: robot.drive.message(np.zeros(len(robot.agent.action)))}
    graph = {n: {"rate_hz": robot.rate_hz, "delay_s": 0.0, "inputs": {}} for n in outputs}
    metadata = {"pipeline": pipeline.name, "dry_run": False, "graph": graph, "probe": True}
    joints, units = {sensor: robot.sensor.joints}, dict.fromkeys(outputs, robot.units)
    recorder = McapRecorder(folder / PROBE, metadata, {}, outputs, [], joints, units)
    recorder.start(0, start_ns)
    rows = [
        (sensor, k, *witness.measured[i][:2], robot.sensor.read(witness.measured[i][2])) for k, i in enumerate(measured)
    ]
    rows += [(actuator, k, *witness.sent[i][:2], robot.drive.message(witness.sent[i][2])) for k, i in enumerate(sent)]
    for node, seq, *times_ns, output in rows:
        begin, end = ((t_ns - start_ns) // 1000 for t_ns in times_ns)
        recorder.step(StepRecord(node, seq, begin, begin, begin, -1, end, 0), output)
    recorder.close("finished", 0, {})
    return folder / PROBE


def _apart(times_ns: list[int], period_ns: int, always: list[bool] | None = None) -> list[int]:
    """Return the indices of times that are at least a period apart, and of those that ``always`` marks."""
    selected: list[int] = []
    for i, t_ns in enumerate(times_ns):
        if not selected or t_ns - times_ns[selected[-1]] >= period_ns or (always is not None and always[i]):
            selected.append(i)
    return selected
