"""One episode on the robot: the graph on the wall clock, its log, and how well it kept its times."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax

from sim2real.errors import ERROR, OK, DeadlineExceeded, Sim2RealError
from sim2real.graph.base import GraphState
from sim2real.graph.episode import MessageRecord, Recorder, StepRecord
from sim2real.graph.node import BaseNode
from sim2real.log.writer import McapRecorder
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.stages.console import progress
from sim2real.stages.manifest import git_state, plain, versions
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.robot import Robot, Session

LATE_SHARE = 0.01
"""Share of late steps above which ``--strict-timing`` ends with code 5."""
_POLL_S = 0.25
_INTERRUPTED = 130


class _Origin:
    """A recorder that passes everything on, and keeps when the episode started."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self.monotonic_ns = 0

    def start(self, epoch_ns: int, monotonic_ns: int) -> None:
        self.monotonic_ns = monotonic_ns
        self._recorder.start(epoch_ns, monotonic_ns)

    def step(self, record: StepRecord, output: Any) -> None:
        self._recorder.step(record, output)

    def message(self, record: MessageRecord) -> None:
        self._recorder.message(record)


def run_episode(
    pipeline: Pipeline,
    robot: Robot,
    session: Session,
    nodes: Mapping[str, BaseNode],
    params: Mapping[str, Any],
    log: Path,
    duration_s: float,
    config: Any,
    strict: bool,
    label: str,
) -> dict[str, Any]:
    """Run the graph for a while and log it; whatever happens, the motors end without torque and the log readable.

    Returns:
        The summary that also stands in the log's ``session_end``: timing by node, losses, the gate's counts.

    Raises:
        DeadlineExceeded: With ``strict``, when too many steps were late; the log is complete then.
        Sim2RealError: What stopped the robot.
    """
    graph = AsyncGraph(nodes, nodes[robot.SUPERVISOR])
    state = graph.init(jax.random.key(0), params)
    graph.warmup(state)  # every program is compiled before torque goes on
    recorder = _recorder(pipeline, robot, graph, state, log, config)
    origin = _Origin(recorder)
    graph.recorder = origin
    status, code = "finished", OK
    try:
        _drive(graph, state, duration_s, label)
    except BaseException as error:
        session.rig.stop_quietly()
        status, code = f"{type(error).__name__}: {error}", _exit_code(error)
        recorder.write_event("stop", status)
        raise
    finally:
        try:
            graph.stop()
        finally:
            summary = {**_summary(graph, session), "monotonic_ns": origin.monotonic_ns}
            recorder.close(status, code, summary)
    late = _late_nodes(summary["timing"])
    if strict and late:
        raise DeadlineExceeded(
            f"more than {LATE_SHARE:.0%} of the steps missed their deadline: {', '.join(late)}",
            hint="close what else runs on this machine, or lower the rate; the log is complete",
        )
    return summary


def timing_rows(summary: Mapping[str, Any]) -> tuple[list[list[Any]], list[str]]:
    """Return the timing table of a summary: rows and headers, times in ms."""
    headers = ["node", "steps", "period p50", "p99", "max [ms]", "late p50", "p99", "max [ms]", "overruns"]
    rows = []
    for name, node in summary["timing"].items():
        times = [1e3 * q for kind in ("period_s", "lateness_s") for q in node[kind]]
        rows.append([name, node["steps"], *[round(t, 2) for t in times], node["overruns"]])
    return rows, headers


def _drive(graph: AsyncGraph, state: GraphState, duration_s: float, label: str) -> None:
    graph.start(state)
    with progress(None, label) as bar:
        bar.total = round(duration_s, 1)
        begin = time.monotonic()
        while (left := duration_s - (time.monotonic() - begin)) > 0:
            graph.run_for(min(_POLL_S, left))
            bar.n = round(min(duration_s, time.monotonic() - begin), 1)
            bar.refresh()


def _recorder(
    pipeline: Pipeline, robot: Robot, graph: AsyncGraph, state: GraphState, log: Path, config: Any
) -> McapRecorder:
    topology = {
        name: {
            "rate_hz": node.rate,
            "delay_s": node.delay,
            "inputs": {
                i: {"from": c.output_node.name, "blocking": c.blocking, "window": c.window, "skip": c.skip}
                for i, c in node.inputs.items()
            },
        }
        for name, node in graph.nodes.items()
    }
    metadata = {
        "pipeline": pipeline.name,
        "config": plain(asdict(config)),
        "graph": topology,
        "versions": plain(versions()),
        "git": plain(git_state()),
        "seed": config.seed,
        "port": config.port,
    }
    inputs = [(n, i) for n, node in graph.nodes.items() for i in node.inputs]
    return McapRecorder(log, metadata, {}, state.aux["outputs"], inputs, robot.JOINTS)


def _summary(graph: AsyncGraph, session: Session) -> dict[str, Any]:
    rig = session.rig
    timing = {
        n: {"steps": s.steps, "period_s": list(s.period_s), "lateness_s": list(s.lateness_s), "overruns": s.overruns}
        for n, s in graph.statistics().items()
    }
    return {
        "timing": timing,
        "transactions": rig.bus.transactions,
        "lost_replies": rig.bus.lost_replies,
        "retries": rig.bus.retries,
        "command_timeouts": rig.timeouts,
        "gate": asdict(rig.gate.counts),
    }


def _late_nodes(timing: Mapping[str, Any]) -> list[str]:
    return [
        f"{name} {node['overruns']} of {node['steps']}"
        for name, node in timing.items()
        if node["overruns"] > LATE_SHARE * node["steps"]
    ]


def _exit_code(error: BaseException) -> int:
    if isinstance(error, Sim2RealError):
        return error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return _INTERRUPTED
    return error.code if isinstance(error, SystemExit) and isinstance(error.code, int) else ERROR
