"""``sim2real play``: a policy walks on a twin in C MuJoCo."""

import importlib
import shutil
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.run.run_folder import newest
from sim2real.commands.config import PlayConfig, ShipConfig
from sim2real.commands.export.policy import find_bundle
from sim2real.errors import Sim2RealError, UsageError
from sim2real.policy.bundle import load_bundle
from sim2real.robots.walking.robot import ComposedRobot
from sim2real.robots.walking.twin import HiddenTwin, Twin, Walked, walk
from sim2real.stages.live.steering import gamepad, steer, terminal_keys
from sim2real.stages.pipeline.pipeline import available, load_pipeline
from sim2real.stages.terminal.console import note, wrote
from sim2real.view.model_scene import ModelScene
from sim2real.view.rerun_viewer import open_viewer, rerun_module

FRAMES_PER_S = 12.5
_VIEWED_EVERY = 5
"""Policy steps in an update of the Rerun viewer."""


def run(config: PlayConfig) -> Walked:
    """Walk, print how it went, and return it.

    Raises:
        UsageError: There is no policy or no gamepad, or the robot does not walk.
    """
    if config.video and config.video.suffix == ".mp4":
        _ffmpeg()  # an error before the walk
    robot, folder = _chosen(config)
    hidden = None if config.seed is None else HiddenTwin.draw(np.random.default_rng(config.seed), len(robot.joints))
    twin, wanted = Twin(robot, hidden, config.seed or 0), np.array(config.command)
    sources = [gamepad(config.gamepad, robot.commands.most)] if config.gamepad else []
    shown: Any = _window(twin, wanted) if config.window else None

    def command(_: float) -> np.ndarray:
        for follow in sources:
            follow(wanted)
        return wanted.copy()

    with ExitStack() as stack:
        if config.view:
            shown = stack.enter_context(closing(_View(twin, config.view)))
            sources.append(stack.enter_context(terminal_keys()))
        walked = walk(twin, load_bundle(folder), command, config.seconds, config.push, shown=shown)
    if config.video:
        write_picture(twin, walked.qpos, config.video)
        wrote(config.video)
    end = f"fell after {walked.fell_s:.1f} s" if walked.fell_s is not None else f"walked for {config.seconds:g} s"
    note(f"{end}; off the command by {walked.error_m_s:.3f} m/s and {walked.error_rad_s:.3f} rad/s")
    return walked


def write_picture(twin: Twin, qpos: np.ndarray, out: Path) -> None:
    """Write the robot from the side, as a moving picture of its links."""
    from matplotlib import rc_context
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.8, 2.7), dpi=80, layout="constrained")
    axes = figure.subplots()
    every = max(1, round(twin.robot.rate_hz / FRAMES_PER_S))
    path: Any = {} if out.suffix == ".gif" else {"animation.ffmpeg_path": _ffmpeg()}
    writer = (FFMpegWriter if path else PillowWriter)(fps=round(twin.robot.rate_hz / every))
    with rc_context(path), writer.saving(figure, str(out), 80):
        for row in qpos[::every]:
            axes.clear()
            for start, end in twin.links(row):
                color = "#0b62b0" if start[1] + end[1] >= 2.0 * row[1] else "#8fb8dd"  # the far side is lighter
                axes.plot([start[0], end[0]], [start[2], end[2]], color=color, lw=3, solid_capstyle="round")
            axes.axhline(0.0, color="#1c2530", lw=1)
            axes.set(xlim=(row[0] - 0.7, row[0] + 0.7), ylim=(-0.05, 0.6), aspect="equal", xlabel="forwards [m]")
            writer.grab_frame()


def _ffmpeg() -> str:
    """Return the path of FFmpeg: the system's, or that of the package imageio-ffmpeg."""
    if system := shutil.which("ffmpeg"):
        return system
    try:
        return importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        hint = "pip install imageio-ffmpeg, or write a .gif"
        raise UsageError("a .mp4 needs FFmpeg, which is not installed", hint=hint) from None


def _chosen(config: PlayConfig) -> tuple[ComposedRobot, Path]:
    """Return the robot and the folder of its policy: of the newest training, or the one that the pipeline ships."""
    source = config.source
    pipelines = available()
    if source is None:
        raise UsageError("play needs a pipeline, a run or a bundle", hint="sim2real play go2")
    if source in pipelines:
        pipeline = load_pipeline(source)
        try:
            folder = newest(config.runs, source, "train").output("bundle")
        except Sim2RealError:
            if not pipeline.shipped.is_dir():
                raise
            folder = pipeline.shipped
    else:
        folder = find_bundle(ShipConfig(source, runs=config.runs))
        named = next((p.name for p in folder.resolve().parents if p.name in pipelines), None)
        if named is None:
            raise UsageError(f"{folder} lies in no folder of a pipeline", hint="sim2real play go2")
        pipeline = load_pipeline(named)
    robot: Any = pipeline.load()
    if not isinstance(robot, ComposedRobot):
        raise UsageError(f"pipeline {pipeline.name!r} does not walk", hint="sim2real play go2")
    return robot, folder


def _window(twin: Twin, wanted: np.ndarray) -> Any:
    """Open a window whose keys steer; return what shows a policy step at its time."""
    from mujoco import viewer

    window: Any = viewer.launch_passive(twin.model, twin.data, key_callback=lambda key: steer(wanted, key))
    begin = time.monotonic()

    def shown(_: Twin, t_s: float) -> None:
        window.sync()
        time.sleep(max(0.0, begin + t_s - time.monotonic()))

    return shown


class _View:
    """Shows policy steps in the Rerun viewer, each at its time; a file gets them at once.

    Args:
        target: Value of the flag ``--view``.
    """

    def __init__(self, twin: Twin, target: str) -> None:
        rr, joints = rerun_module(), {name: f"position[{i}]" for i, name in enumerate(twin.robot.joints)}
        self._recording, self._paced = rr.RecordingStream("sim2real play"), not target.endswith(".rrd")
        note(open_viewer(self._recording, target), urgent=True)
        self._recording.send_blueprint(rr.blueprint.Blueprint(rr.blueprint.Spatial3DView(origin="/robot")))
        self._scene, self._rows, self._begin = ModelScene(str(twin.robot.mjcf), joints), list[np.ndarray](), 0.0
        self._names = [f"base[{i}]" for i in range(3)] + [f"quaternion[{i}]" for i in range(4)] + list(joints.values())

    def __call__(self, twin: Twin, t_s: float) -> None:
        """Show a step."""
        self._begin = self._begin or time.monotonic() - t_s
        self._rows.append(np.append(twin.data.qpos, t_s))
        if len(self._rows) == _VIEWED_EVERY:
            self._send()
        if self._paced:
            time.sleep(max(0.0, self._begin + t_s - time.monotonic()))

    def close(self) -> None:
        """Send what remains."""
        if self._rows:
            self._send()
        self._recording.flush()
        self._recording.disconnect()

    def _send(self) -> None:
        *columns, times = np.array(self._rows).T
        self._scene(self._recording, times, dict(zip(self._names, columns, strict=True)), "robot")
        self._rows.clear()
