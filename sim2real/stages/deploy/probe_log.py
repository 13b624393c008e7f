"""The small steps by which deploy measured the delay, as a log: what the robot answered is tested like an episode."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim2real.artifacts.deployment import PROBE
from sim2real.graph.episode import StepRecord
from sim2real.log.writer import McapRecorder
from sim2real.robots.contract import Robot
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.probe import Witness
from sim2real.stages.pipeline.pipeline import Pipeline


def write_probe(folder: Path, pipeline: Pipeline, robot: Robot, seen: Witness) -> Path | None:
    """Write what was sent and measured during the steps, at the robot's rate.

    They were made faster than that: measurements in between are left out, so that a log says in a second as much as any
    other, and so are repeated commands, which change nothing.

    Returns:
        The log; None where there was no step, or where the robot does not say what its messages are.
    """
    if not seen.measured or not seen.sent or not isinstance(robot, LoopRobot):
        return None
    sensor, actuator = robot.roles.sensor, robot.roles.actuator
    period_ns, start_ns = round(1e9 / robot.rate_hz), min(seen.measured[0][0], seen.sent[0][0])
    measured = _apart([begin_ns for begin_ns, *_ in seen.measured], period_ns)
    changed = [i == 0 or not np.array_equal(goal, seen.sent[i - 1][2]) for i, (*_, goal) in enumerate(seen.sent)]
    sent = _apart([begin_ns for begin_ns, *_ in seen.sent], period_ns, changed)
    outputs = {sensor: robot.at_rest, actuator: robot.message(np.zeros(len(robot.action)))}
    graph = {n: {"rate_hz": robot.rate_hz, "delay_s": 0.0, "inputs": {}} for n in outputs}
    metadata = {"pipeline": pipeline.name, "dry_run": False, "graph": graph, "probe": True}
    joints, units = {sensor: robot.joints}, dict.fromkeys(outputs, robot.units)
    recorder = McapRecorder(folder / PROBE, metadata, {}, outputs, [], joints, units)
    recorder.start(0, start_ns)
    rows = [(sensor, k, *seen.measured[i][:2], robot.read(seen.measured[i][2])) for k, i in enumerate(measured)]
    rows += [(actuator, k, *seen.sent[i][:2], robot.message(seen.sent[i][2])) for k, i in enumerate(sent)]
    for node, seq, *times_ns, output in rows:
        begin, end = ((t_ns - start_ns) // 1000 for t_ns in times_ns)
        recorder.step(StepRecord(node, seq, begin, begin, begin, -1, end, 0), output)
    recorder.close("finished", 0, {})
    return folder / PROBE


def _apart(times_ns: list[int], period_ns: int, always: list[bool] | None = None) -> list[int]:
    """Return which of some times are a period apart at least, and those that count in any case."""
    kept: list[int] = []
    for i, t_ns in enumerate(times_ns):
        if not kept or t_ns - times_ns[kept[-1]] >= period_ns or (always is not None and always[i]):
            kept.append(i)
    return kept
