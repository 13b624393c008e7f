"""Runs episodes on an open robot, writes their logs, and reports how well they kept time."""

import math
import select
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.files import plain
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import git_state, versions
from sim2real.errors import ERROR, OK, DeadlineExceeded, SafetyStop, Sim2RealError
from sim2real.graph.base import GraphState
from sim2real.graph.episode import MessageRecord, Recorder, StepRecord, named_leaves
from sim2real.graph.node import BaseNode
from sim2real.hardware.clock import SYSTEM_CLOCK, Clock
from sim2real.hardware.safety.rig import Rig
from sim2real.installation import has_jax
from sim2real.later import jax
from sim2real.log.writer import McapRecorder
from sim2real.robots.loop import ACTUATOR, AGENT, ROLES, SENSOR
from sim2real.robots.messages import as_columns
from sim2real.robots.nodes import connected
from sim2real.robots.robot import Robot, joint_columns
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import MonotonicClock, realtime
from sim2real.runtime.failure import noted
from sim2real.runtime.virtual import VirtualClock
from sim2real.stages.session.config import SessionConfig
from sim2real.stages.terminal.console import artifact_table, note, progress, table
from sim2real.stages.terminal.interruption import interruptible

LATE_SHARE = 0.01
"""Share of late steps above which ``--strict-timing`` ends with code 5; share of late answers that is reported."""
_POLL_S, _REST_POLL_S = 0.25, 0.02
WARN_WAITING = 5_000
"""A warning names the slow disk if the record that is being written is older than this [s]."""
_INTERRUPTED = 130


class Watch:
    """A recorder that passes records on, and stops the graph on a NaN.

    Attributes:
        monotonic_ns: Start of the episode on the monotonic clock [ns].
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder, self.monotonic_ns = recorder, 0

    def start(self, epoch_ns: int, monotonic_ns: int) -> None:
        """Keep the episode's start."""
        self.monotonic_ns = monotonic_ns
        self._recorder.start(epoch_ns, monotonic_ns)

    def step(self, record: StepRecord, output: Any) -> None:
        """Pass a step on."""
        self._recorder.step(record, output)
        for name, leaf in named_leaves(output).items():
            values = np.asarray(leaf)
            if values.dtype.kind == "f" and np.isnan(values).any():
                raise SafetyStop(f"node {record.node!r} stopped: its output {name!r} is NaN in step {record.seq}")

    def message(self, record: MessageRecord) -> None:
        """Pass a message on."""
        self._recorder.message(record)


@contextmanager
def opened(robot: Robot, config: SessionConfig, truth_path: Path, hanging: bool = False) -> "Iterator[Bench]":
    """Open the robot for a stage, with torque off; in a dry run, torque stays off until it is closed.

    Args:
        hanging: Whether emulated legs hang in a stand, for a recording.
    """
    if config.dry_run:
        note("dry run: torque stays off and no goal is sent; what would have been sent is logged")
    with connected(robot.drive, config.port, config.gate, truth_path, config.seed, hanging) as rig, realtime():
        if config.dry_run:
            rig.withhold_torque()
        for line in rig.device.without_host() if config.port != "embedded" else ():
            note(f"if this process dies: {line}; the guardian takes the torque off", urgent=True)
        yield Bench(robot, rig, config)


@dataclass(frozen=True)
class Bench:
    """An open robot with the settings of the stage that opened it."""

    robot: Robot
    rig: Rig
    config: SessionConfig

    def run_episode(
        self,
        nodes: Mapping[str, BaseNode],
        params: Mapping[str, Any],
        log: Path,
        duration_s: float,
        label: str,
        hold: bool = False,
    ) -> None:
        """Run the graph and write its log; after any failure the motors have no torque and the log is readable.

        Args:
            duration_s: How long to run [s].
            hold: Whether to hold the robot at the end until Enter is pressed.

        Raises:
            Sim2RealError: The robot was stopped.
        """
        # Without an agent, as in a recording by hand, the sensor is the only node.
        clock = MonotonicClock() if self.rig.clock is SYSTEM_CLOCK else VirtualClock(self.rig.clock)
        graph = AsyncGraph(nodes, nodes.get(AGENT) or nodes[SENSOR], clock)
        state = graph.init(jax.random.key(0) if has_jax() else None, params)
        graph.warmup(state)  # compile every program before torque goes on
        # Start the log, and run; an interrupted episode comes to rest before torque goes off.
        recorder = self._recorder(graph, state, log)
        watch = Watch(recorder)
        graph.recorder = watch
        try:
            try:
                _drive(graph, state, duration_s, label, recorder, self.rig.clock)
            except (KeyboardInterrupt, SystemExit):
                with interruptible():  # a second signal stops at once
                    come_to_rest(graph, self.rig, hold)
                raise
            if hold:
                come_to_rest(graph, self.rig, hold)
            graph.stop()
        except BaseException as error:
            self.rig.stop_quietly()
            _end(error, graph, recorder, lambda: self._summary(graph, watch))
            raise
        # A failure ends with torque off, and the log has the failure.
        recorder.close("finished", OK, self._summary(graph, watch), note)

    def _recorder(self, graph: AsyncGraph, state: GraphState, log: Path) -> McapRecorder:
        """Return the log's writer, whose metadata describe the session."""
        # Describe the graph for the log's metadata.
        topology = {
            name: {
                "rate_hz": node.rate,
                "delay_s": node.delay,
                "scheduling": node.scheduling.value,
                **{k: v for k, v in (("color", node.color), ("order", node.order)) if v is not None},
                "inputs": {
                    i: {"from": c.output_node.name, "blocking": c.blocking, "window": c.window, "skip": c.skip}
                    for i, c in node.inputs.items()
                },
            }
            for name, node in graph.nodes.items()
        }
        metadata = {
            "pipeline": self.robot.name,
            "dry_run": self.rig.torque_withheld,
            "config": plain(asdict(self.config)),
            "graph": topology,
            "roles": ROLES,
            "versions": plain(versions()),
            "git": plain(git_state()),
            "seed": self.config.seed,
            "port": self.config.port,
            "hardware": self.rig.device.facts(),
        }
        inputs = [(n, i) for n, node in graph.nodes.items() for i in node.inputs]
        joints, units = (
            {SENSOR: joint_columns(self.robot.drive.channels)},
            dict.fromkeys(graph.nodes, self.robot.units),
        )
        return McapRecorder(log, metadata, {}, state.aux["outputs"], inputs, joints, units)

    def _summary(self, graph: AsyncGraph, watch: Watch) -> dict[str, Any]:
        """Return the counters of nodes, bus and gate, which steps and messages do not have.

        ``bus``: how long the transactions of each node took, see ``BusUse`` [us]; ``late_replies``: answers whose
        sample's time is uncertain, or that came after the request was repeated.
        """
        rig, counters = self.rig, self.rig.device.counters
        nodes = sorted(graph.statistics().items(), key=lambda item: _place(graph.nodes[item[0]]))
        uses = {SENSOR: rig.measuring, ACTUATOR: rig.commanding}
        return {
            "monotonic_ns": watch.monotonic_ns,
            "timing": {n: {"steps": s.steps, "overruns": s.overruns} for n, s in nodes},
            "bus": {
                name: {kind: values.tolist() for kind, values in asdict(use).items()} for name, use in uses.items()
            },
            "transactions": counters.transactions,
            "lost_replies": counters.lost_replies,
            "retries": counters.retries,
            "command_timeouts": rig.timeouts,
            "late_replies": counters.late_replies,
            "gate": asdict(rig.gate.counts),
        }


def _drive(
    graph: AsyncGraph, state: GraphState, duration_s: float, label: str, recorder: McapRecorder, clock: Clock
) -> None:
    """Run the graph; print one warning if the log's writer falls behind."""
    graph.start(state)
    with progress(round(duration_s, 1), label) as bar:
        begin_ns, warned = clock.now_ns(), False
        while (left := duration_s - 1e-9 * (clock.now_ns() - begin_ns)) > 0:
            graph.run_for(min(_POLL_S, left))
            bar.n = round(min(duration_s, 1e-9 * (clock.now_ns() - begin_ns)), 1)
            bar.refresh()
            if recorder.waiting > WARN_WAITING and not warned:
                note(f"warning: the disk is slow: {recorder.waiting:,} records of the log wait in memory")
                warned = True


def _end(error: BaseException, graph: AsyncGraph, recorder: McapRecorder, summary: Callable[[], Any]) -> None:
    """Stop the graph and complete the log; a further error must not hide the first one."""
    status = f"{type(error).__name__}: {error}"
    with noted(error):
        graph.stop()
    with noted(error):
        recorder.close(status, _exit_code(error), summary(), note)


def come_to_rest(graph: AsyncGraph, rig: Rig, hold: bool) -> None:
    """Let commands fade, or goals stay, until the robot is at rest; graph and log go on.

    Args:
        hold: Whether to hold the robot then until Enter is pressed; without a terminal, until a signal comes.

    Raises:
        Sim2RealError: The robot was stopped meanwhile.
    """
    if rig.torque_withheld or not graph.running:
        return
    note("coming to rest; Ctrl-C stops at once", urgent=True)
    rig.ease()
    while graph.running and not rig.eased:
        graph.run_for(_REST_POLL_S)
    if hold:
        note("holding: support the robot, then press Enter to take the torque off", urgent=True)
        while graph.running and not _enter_pressed():
            graph.run_for(_REST_POLL_S)


def _enter_pressed() -> bool:
    """Wait a moment in real time, also with an emulated robot, and return whether Enter was pressed."""
    if not sys.stdin.isatty():  # a closed input would release the robot at once
        time.sleep(_REST_POLL_S)
        return False
    ready = bool(select.select([sys.stdin], [], [], _REST_POLL_S)[0])
    return ready and bool(sys.stdin.readline())


def check_deadlines(summary: Mapping[str, Any]) -> None:
    """Raise an error for ``--strict-timing`` if too many steps were late; called when everything is written."""
    late = [
        f"{name} {node['overruns']} of {node['steps']}"
        for name, node in summary["timing"].items()
        if node["overruns"] > LATE_SHARE * node["steps"]
    ]
    if late:
        raise DeadlineExceeded(
            f"more than {LATE_SHARE:.0%} of the steps missed their deadline: {', '.join(late)}",
            hint="close what else runs on this machine, or lower the rate; the log is complete",
        )


def show_sessions(recordings: Sequence[Recording], robot: Robot) -> None:
    """Print the timing of the last session, warnings of all sessions, and the withheld commands of a dry run."""
    print(artifact_table(recordings[-1].timing.rows()))
    for recording in recordings:
        share = recording.summary["late_replies"] / max(1, recording.summary["transactions"])
        if share > LATE_SHARE:
            embedded = recording.episode.metadata["port"] == "embedded"
            adapter = "" if embedded else ", and set the latency timer of a USB adapter to 1 ms"
            note(
                f"warning: {share:.1%} of the answers came late: when those samples were taken is not sure\n"
                f"hint: close what else runs on this computer{adapter}"
            )
    withheld = [recording for recording in recordings if recording.dry_run and ACTUATOR in recording.episode.outputs]
    if not withheld:
        return
    field, rows = robot.drive.command, []
    for number, recording in enumerate(withheld):
        commands = as_columns({field: recording.episode.outputs[ACTUATOR][field]})
        joints = [channel.name for channel in robot.drive.channels]
        names = joints if len(joints) == len(commands) else list(commands)
        for name, sent in zip(names, commands.values(), strict=True):
            ends = sent.min(), sent.mean(), sent.max()
            rows.append([number, name, robot.units.get(field, ""), len(sent), *map(float, ends)])
    print(table(rows, ["episode", "would have been sent to", "unit", "commands", "min", "mean", "max"]))
    note("dry run: no joint was moved; no later stage uses this as a recording")


def _place(node: BaseNode) -> float:
    """Return a node's place in tables: nodes with an ``order`` first, the others in the graph's order."""
    return math.inf if node.order is None else node.order


def _exit_code(error: BaseException) -> int:
    if isinstance(error, Sim2RealError):
        return error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return _INTERRUPTED
    return error.code if isinstance(error, SystemExit) and isinstance(error.code, int) else ERROR
