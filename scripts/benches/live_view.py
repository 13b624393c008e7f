"""The cost of ``--view`` for a control loop of twelve joints.

The yardstick is the same loop in the same seconds: the viewer's processes are stopped and continued in turn, by SIGSTOP
and SIGCONT, so that other programs of the machine disturb both alike. When they are continued they also catch up on the
rows of the time before. The cost for the loop is processor time of its process as a share of the time, and lateness.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
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

QUICK = {"seconds": 2.0, "window": 0.5, "targets": ["file"]}


@dataclass(frozen=True)
class Loop:
    """One run of the loop, cut into windows with and without a viewer, in turn.

    Attributes:
        on: Whether the viewer ran ``(W,)``.
        cores: Processor time of the loop's process in each window ``(W,)`` [s per s].
        viewer_cores: Processor time of the viewer's processes ``(W,)`` [s per s].
        late_ms: Lateness of each step of all nodes ``(S,)`` [ms].
        of_window: Window of each step ``(S,)``.
    """

    on: np.ndarray
    cores: np.ndarray
    viewer_cores: np.ndarray
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
    """Run the loop beside each viewer."""
    rows: list[Row] = []
    for target in options.targets:
        rows += _rows(target, _loop(target, options.rate, options.seconds, options.window))
    return {"rows": rows}


def _rows(target: str, loop: Loop) -> list[Row]:
    """Return the figures of a viewer: with it, without it, and the difference."""
    what, on = f"view/{target}", loop.on
    share, share_error = _difference(100.0 * loop.cores[on], 100.0 * loop.cores[~on])
    late, without = (
        float(np.quantile(loop.late_ms[np.isin(loop.of_window, np.flatnonzero(windows))], 0.99))
        for windows in (on, ~on)
    )
    added = late - without
    return [
        row(f"{what}/loop_share", round(share, 2), "% of the time", f"stopped viewer, +-{share_error:.2f}", "< 1"),
        row(f"{what}/lateness_p99_ms", round(late, 3), "ms", f"stopped viewer: {without:.3f}"),
        row(f"{what}/lateness_p99_added_ms", round(added, 3), "ms", f"stopped viewer, +-{_spread(loop):.3f}", "< 0.1"),
        row(f"{what}/viewer_cores", round(float(loop.viewer_cores[on].mean()), 3), "cores, at low priority"),
    ]


def _spread(loop: Loop, draws: int = 200) -> float:
    """Return the standard error of the difference of the lateness' quantiles, by drawing pairs of windows again."""
    rng, pairs = np.random.default_rng(0), len(loop.on) // 2
    late = [loop.late_ms[loop.of_window == i] for i in range(2 * pairs)]
    differences = []
    for _ in range(draws):
        drawn = 2 * rng.integers(0, pairs, pairs)
        with_viewer, without = (np.concatenate([late[i + side] for i in drawn]) for side in (0, 1))
        differences.append(np.quantile(with_viewer, 0.99) - np.quantile(without, 0.99))
    return float(np.std(differences))


def _difference(on: np.ndarray, off: np.ndarray) -> tuple[float, float]:
    """Return the mean difference of windows side by side, and its standard error."""
    pairs = on[: len(off)] - off[: len(on)]
    return float(pairs.mean()), float(pairs.std() / np.sqrt(len(pairs)))


def _loop(target: str, rate_hz: float, seconds: float, window_s: float) -> Loop:
    """Run the loop beside an emulated bus, with its log and a viewer."""
    plant = f"{Path(__file__).with_name('twelve_joints.py')}:TwelveJoints"
    config = EmulatorConfig(baud_rate=BAUD, return_delay_us=0, plant_step_s=0.001)
    with (
        tempfile.TemporaryDirectory() as folder,
        _viewed(target, Path(folder)) as port,
        EmbeddedRobot(plant, config, None, Path(folder) / "truth.bin") as robot,
    ):
        bus = BusConfig(robot.port, baud_rate=BAUD, silence_s=1.0, max_silence_s=1.0)
        device = DynamixelServos(bus, list(range(1, JOINTS + 1)), VoltageDrive(SUPPLY_V))
        with Rig(device, GateConfig(LIMIT_V, stuck_effort=2.0, max_sample_age_s=2.0)) as rig, realtime():
            nodes = nodes_of(rig, rate_hz)
            graph = AsyncGraph(nodes, nodes["agent"])
            state = graph.init(jax.random.key(0))
            graph.warmup(state)
            graph.recorder = recorder = _recorder(Path(folder) / "session.mcap", nodes, rate_hz, state.aux["outputs"])
            on, cores, viewer_cores = [], [], []
            with graph:
                graph.start(state)
                for i in range(round(seconds / window_s)):
                    on.append(i % 2 == 0)
                    processes = _processes(port)
                    for process in processes:
                        os.kill(process, signal.SIGCONT if on[-1] else signal.SIGSTOP)
                    before = time.process_time(), sum(processes.values())
                    graph.run_for(window_s)
                    cores.append((time.process_time() - before[0]) / window_s)
                    viewer_cores.append((sum(_processes(port).values()) - before[1]) / window_s)
            for process in _processes(port):
                os.kill(process, signal.SIGCONT)
            recorder.close()
        steps = read_log(Path(folder) / "session.mcap").steps.values()
    woken_s = np.concatenate([s.woken for s in steps]) / 1e6
    late_ms = np.concatenate([s.woken - s.start for s in steps]) / 1e3
    return Loop(np.array(on), np.array(cores), np.array(viewer_cores), late_ms, (woken_s / window_s).astype(int))


@contextmanager
def _viewed(target: str, folder: Path) -> Iterator[str]:
    """Open a viewer on the logs of a folder; yield the port of a viewer of its own."""
    port = str(random.randint(20_000, 30_000))
    address = {
        "file": str(folder / "live.rrd"),
        "web": "web",
        "window": f"rerun+http://127.0.0.1:{port}/proxy",
    }[target]
    columns = {f"joint_{i}": f"position[{i}]" for i in range(JOINTS)}
    with ExitStack() as stack:
        if target == "window":
            from rerun.experimental import ViewerClient

            path = str(Path(sysconfig.get_path("scripts")) / "rerun")
            stack.enter_context(ViewerClient.spawn(headless=True, port=int(port), executable_path=path))
            for viewer in _processes(port):  # a viewer that `--view` opens inherits this from its process
                os.sched_setscheduler(viewer, os.SCHED_IDLE, os.sched_param(0))
        stack.enter_context(live_view(address, folder, "bench", lambda: {"mjcf": _chain(), "columns": columns}))
        yield port


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
