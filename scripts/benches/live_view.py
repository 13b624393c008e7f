"""The cost of ``--view`` for a control loop of twelve joints.

The yardstick is the same loop in the same seconds: the viewer's processes are stopped and continued in turn, by SIGSTOP
and SIGCONT, so that other programs of the machine disturb both alike. A viewer that continues first catches up on the
rows of the time before: these windows count apart. The cost for the loop is processor time of its process as a share of
the time, and lateness.

``other_log_share`` is the part of this cost that comes from the shared processor: the viewer has the same work, but
follows a log that the loop does not write. ``writes_added`` are calls of the loop's process that write.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from benches.figures import Report, Row, row
from benches.runner import BAUD, JOINTS, LIMIT_V, SUPPLY_V, nodes_of
from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode
from sim2real.hardware.dynamixel.bus import BusConfig
from sim2real.hardware.dynamixel.device import DynamixelServos
from sim2real.hardware.dynamixel.drive import VoltageDrive
from sim2real.hardware.dynamixel.emulation import EmulatorConfig
from sim2real.hardware.emulation.embedded import EmbeddedRobot
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig
from sim2real.log.reader import read_log
from sim2real.log.writer import McapRecorder
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import realtime
from sim2real.stages.live.viewer import live_view

QUICK = {"seconds": 3.0, "window": 0.5, "targets": ["file"]}
OFF, CATCHING_UP, ON = range(3)
_GROW = """
import sys, time
data, begin, sent = open(sys.argv[1], "rb").read(), time.monotonic(), 0
with open(sys.argv[2], "wb", 0) as stream:
    while sent < len(data):
        due = min(len(data), int(len(data) * (time.monotonic() - begin) / float(sys.argv[3])))
        sent += stream.write(data[sent:due])
        time.sleep(0.2)
"""
"""Writes a log a second time, as fast as it grew, every 0.2 s as the writer of a log."""


@dataclass(frozen=True)
class Loop:
    """One run of the loop, cut into windows with and without a viewer, in turn.

    Attributes:
        state: ``OFF``, ``CATCHING_UP`` or ``ON`` in each window ``(W,)``.
        cores: Processor time of the loop's process in each window ``(W,)`` [s per s].
        viewer_cores: Processor time of the viewer's processes ``(W,)`` [s per s].
        writes: Writing calls of the loop's process ``(W,)`` [1/s].
        late_ms: Lateness of each step of all nodes ``(S,)`` [ms].
        of_window: Window of each step ``(S,)``.
    """

    state: np.ndarray
    cores: np.ndarray
    viewer_cores: np.ndarray
    writes: np.ndarray
    late_ms: np.ndarray
    of_window: np.ndarray


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--rate", type=float, default=200.0, help="rate of sensor, policy and actuator [Hz]")
    parser.add_argument("--seconds", type=float, default=120.0, help="length of the loop beside each viewer")
    parser.add_argument("--window", type=float, default=2.0, help="time with a viewer, then without it [s]")
    parser.add_argument(
        "--targets", nargs="+", default=["web", "window"], choices=["file", "web", "window"], help="viewers"
    )


def run(options: argparse.Namespace) -> Report:
    """Run the loop beside each viewer: on its own log, and on another one."""
    rows: list[Row] = []
    for target in options.targets:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "session.mcap"
            rows += _rows(target, _loop(target, options, log))
            other = _loop(target, options, Path(folder) / "again.mcap", other=log)
            rows.append(_share(f"view/{target}/other_log_share", other, ON))
    return {"rows": rows}


def _share(name: str, loop: Loop, state: int, goal: str = "") -> Row:
    """Return the processor time of the loop's process in windows of a state, more than without a viewer."""
    share, error = _difference(100.0 * loop.cores[loop.state == state], 100.0 * loop.cores[loop.state == OFF])
    return row(name, round(share, 2), "% of the time", f"stopped viewer, +-{error:.2f}", goal)


def _rows(target: str, loop: Loop) -> list[Row]:
    """Return the figures of a viewer: with it, without it, and the difference."""
    what, on, off = f"view/{target}", loop.state == ON, loop.state == OFF
    late, without = (
        float(np.quantile(loop.late_ms[np.isin(loop.of_window, np.flatnonzero(windows))], 0.99))
        for windows in (on, off)
    )
    added = late - without
    writes, writes_error = _difference(loop.writes[on], loop.writes[off])
    return [
        _share(f"{what}/loop_share", loop, ON, "< 1"),
        _share(f"{what}/loop_share_catching_up", loop, CATCHING_UP),
        row(f"{what}/writes_added", round(writes, 2), "1/s", f"{loop.writes[off].mean():.0f}, +-{writes_error:.2f}"),
        row(f"{what}/lateness_p99_ms", round(late, 3), "ms", f"stopped viewer: {without:.3f}"),
        row(f"{what}/lateness_p99_added_ms", round(added, 3), "ms", f"stopped viewer, +-{_spread(loop):.3f}", "< 0.1"),
        row(f"{what}/viewer_cores", round(float(loop.viewer_cores[on].mean()), 3), "cores, at low priority"),
    ]


def _spread(loop: Loop, draws: int = 200) -> float:
    """Return the standard error of the difference of the lateness' quantiles, by drawing pairs of windows again."""
    rng = np.random.default_rng(0)
    sides = [[loop.late_ms[loop.of_window == i] for i in np.flatnonzero(loop.state == s)] for s in (ON, OFF)]
    pairs = min(map(len, sides))
    differences = []
    for _ in range(draws):
        drawn = rng.integers(0, pairs, pairs)
        with_viewer, without = (np.concatenate([late[i] for i in drawn]) for late in sides)
        differences.append(np.quantile(with_viewer, 0.99) - np.quantile(without, 0.99))
    return float(np.std(differences))


def _difference(on: np.ndarray, off: np.ndarray) -> tuple[float, float]:
    """Return the mean difference of windows side by side, and its standard error."""
    pairs = on[: len(off)] - off[: len(on)]
    return float(pairs.mean()), float(pairs.std() / np.sqrt(len(pairs)))


def _loop(target: str, options: argparse.Namespace, log: Path, other: Path | None = None) -> Loop:
    """Run the loop beside an emulated bus, with its log and a viewer of this log, or of another log that grows."""
    rate_hz, window_s = options.rate, options.window
    windows = round(options.seconds / window_s)
    plant = f"{Path(__file__).with_name('twelve_joints.py')}:TwelveJoints"
    config = EmulatorConfig(baud_rate=BAUD, return_delay_us=0, plant_step_s=0.001)
    with (
        tempfile.TemporaryDirectory() as folder,
        _viewed(target, Path(folder) if other else log.parent) as port,
        EmbeddedRobot(plant, config, None, Path(folder) / "truth.bin") as robot,
    ):
        bus = BusConfig(robot.port, baud_rate=BAUD, silence_s=1.0, max_silence_s=1.0)
        device = DynamixelServos(bus, list(range(1, JOINTS + 1)), VoltageDrive(SUPPLY_V))
        with Rig(device, GateConfig(LIMIT_V, stuck_effort=2.0, max_sample_age_s=2.0)) as rig, realtime():
            nodes = nodes_of(rig, rate_hz)
            graph = AsyncGraph(nodes, nodes["agent"])
            state = graph.init(jax.random.key(0))
            graph.warmup(state)
            graph.recorder = recorder = _recorder(log, nodes, rate_hz, state.aux["outputs"])
            counted = []
            with graph, _grown(other, Path(folder) / "session.mcap", windows * window_s):
                graph.start(state)
                for i in range(windows):
                    processes = _processes(port)
                    for process in processes:
                        os.kill(process, signal.SIGSTOP if _state(i) == OFF else signal.SIGCONT)
                    before = time.process_time(), sum(processes.values()), _writes()
                    graph.run_for(window_s)
                    after = time.process_time(), sum(_processes(port).values()), _writes()
                    counted.append((np.array(after) - before) / window_s)
            for process in _processes(port):
                os.kill(process, signal.SIGCONT)
            recorder.close()
        steps = read_log(log).steps.values()
    woken_s = np.concatenate([s.woken for s in steps]) / 1e6
    late_ms = np.concatenate([s.woken - s.start for s in steps]) / 1e3
    states = np.array([_state(i) for i in range(windows)])
    return Loop(states, *np.array(counted).T, late_ms, (woken_s / window_s).astype(int))


def _state(window: int) -> int:
    return (CATCHING_UP, ON, OFF)[window % 3]


def _writes() -> int:
    """Return the number of writing calls of this process."""
    return int(Path("/proc/self/io").read_text().partition("syscw:")[2].split()[0])


@contextmanager
def _grown(source: Path | None, target: Path, seconds: float) -> Iterator[None]:
    """Let a copy of a log grow, in a process of its own, while the block runs."""
    if source is None:
        yield
        return
    with subprocess.Popen([sys.executable, "-c", _GROW, str(source), str(target), str(seconds)]) as process:
        try:
            yield
        finally:
            process.kill()


@contextmanager
def _viewed(target: str, folder: Path) -> Iterator[str]:
    """Open a viewer on the logs of a folder; yield the port of a viewer of its own."""
    port = str(random.randint(20_000, 30_000))
    address = {"file": str(folder / "live.rrd"), "web": "web", "window": f"rerun+http://127.0.0.1:{port}/proxy"}[target]
    columns = {f"joint_{i}": f"position[{i}]" for i in range(JOINTS)}
    viewers: dict[int, float] = {}
    with ExitStack() as stack:
        if target == "window":
            from rerun.experimental import ViewerClient

            path = str(Path(sysconfig.get_path("scripts")) / "rerun")
            stack.enter_context(ViewerClient.spawn(headless=True, port=int(port), executable_path=path))
            viewers = _processes(port)
            for viewer in viewers:  # a viewer that `--view` opens inherits this from its process
                os.sched_setscheduler(viewer, os.SCHED_IDLE, os.sched_param(0))
        stack.enter_context(live_view(address, folder, "bench", lambda: {"mjcf": _chain(), "columns": columns}))
        yield port
        if viewers.keys() - _processes(port).keys():  # a viewer that has ended costs nothing
            raise UsageError("the viewer ended early", hint="it needs a renderer: apt-get install mesa-vulkan-drivers")


def _chain() -> str:
    """Return a model of twelve links, one after the other."""
    body = ""
    for i in reversed(range(JOINTS)):
        shape = f'<joint name="joint_{i}" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .05" size=".01"/>'
        body = f'<body pos="0 0 .05">{shape}{body}</body>'
    return f"<mujoco><worldbody>{body}</worldbody></mujoco>"


def _processes(port: str) -> dict[int, float]:
    """Return the process that feeds the viewer, and the viewer at a port, with their processor time [s]."""
    times_s = {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError, ValueError):
            arguments = (process / "cmdline").read_text().split("\0")
            fields = (process / "stat").read_text().rpartition(")")[2].split()
            feeds = "sim2real.stages.live.viewer_process" in arguments and int(fields[1]) == os.getpid()
            if feeds or ("rerun" in arguments[0] and any(port in argument for argument in arguments)):
                times_s[int(process.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return times_s


def _recorder(path: Path, nodes: Mapping[str, BaseNode], rate_hz: float, outputs: Mapping[str, object]) -> McapRecorder:
    graph = {
        name: {"rate_hz": rate_hz, "inputs": {i: {"from": c.output_node.name} for i, c in node.inputs.items()}}
        for name, node in nodes.items()
    }
    inputs = [(name, i) for name, node in nodes.items() for i in node.inputs]
    return McapRecorder(path, {"pipeline": "bench", "graph": graph}, {}, outputs, inputs)
