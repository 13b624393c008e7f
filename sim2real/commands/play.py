"""``sim2real play``: lets a policy walk on a twin in C MuJoCo, in a window or as an animation."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from sim2real.commands import flags
from sim2real.errors import UsageError
from sim2real.stages.flag import WINDOW, Flag
from sim2real.stages.load import available, load_robot
from sim2real.stages.shared.find_run import find_bundle

if TYPE_CHECKING:
    import numpy as np

    from sim2real.robots.walking.twin import Twin, Walked

_FRAMES_PER_S = 12.5
_KEYS = {265: (0, 0.1), 264: (0, -0.1), 44: (1, 0.1), 46: (1, -0.1), 263: (2, 0.1), 262: (2, -0.1)}
"""Key of GLFW (arrows, comma, full stop) -> entry of the command, and its change."""
_SPACE = 32


@dataclass(frozen=True)
class PlayConfig:
    """Let a policy walk on a twin in C MuJoCo, with delays and noise."""

    source: Annotated[str, Flag("RUN|PIPELINE|BUNDLE", positional=True, needed=True)] = ""
    """A bundle's folder, a run folder, or a pipeline (its newest training, or its shipped bundle)."""
    command: tuple[float, float, float] = (0.6, 0.0, 0.0)
    """Commanded velocity: forwards, to the left [m/s], yaw rate [rad/s]."""
    duration_s: float = 10.0
    """Length of the episode [s]."""
    push: float = 0.0
    """Size of a push every 5 s [m/s]."""
    seed: int | None = None
    """Seed of a twin with other friction, load, motors and delays; default: the nominal twin."""
    view: Annotated[str | None, Flag("[FILE.gif]", alone=WINDOW)] = None
    """Show the walk in MuJoCo's window: arrow keys change forward velocity and yaw rate, comma and full stop the
    sideways velocity, the space bar stops. With FILE.gif: write an animation from the side, which needs no display.
    """
    runs: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        """Check the flags."""
        if not (0.0 < self.duration_s <= 3600.0 and 0.0 <= self.push <= 10.0):
            raise UsageError(
                f"play takes up to 3600 s and pushes of 0 to 10 m/s, got {self.duration_s} and {self.push}"
            )
        if self.view not in (None, WINDOW) and not str(self.view).endswith(".gif"):
            raise UsageError(f"--view alone opens a window, and writes a .gif, got {self.view}", hint="--view walk.gif")


def play(command: str, arguments: list[str]) -> None:
    """``sim2real play RUN|PIPELINE|BUNDLE [FLAGS]``."""
    examples = ("play go2", "play go2 --command 0.5 0 0.4 --view walk.gif", "play go2 --view")
    run(flags.parse(PlayConfig(), arguments, f"sim2real {command}", *examples))


def run(config: PlayConfig) -> "Walked":
    """Walk, print the errors of the velocity, and return the walk.

    Raises:
        UsageError: There is no policy, or the robot does not walk.
    """
    import numpy as np

    from sim2real.emulation.body import HiddenTwin
    from sim2real.policy.bundle import load_bundle
    from sim2real.robots.walking.robot import ComposedRobot
    from sim2real.robots.walking.twin import Twin, walk
    from sim2real.stages.terminal.console import note, progress, wrote

    # Find the policy and its robot.
    folder, pipelines = find_bundle(config.source, config.runs), available()
    names = (config.source, *(p.name for p in folder.resolve().parents))
    if (name := next((n for n in names if n in pipelines), None)) is None:
        raise UsageError(f"{folder} is not in the folder of a pipeline", hint="sim2real play go2")
    robot: Any = load_robot(name)
    if not isinstance(robot, ComposedRobot):
        raise UsageError(f"pipeline {name!r} does not walk", hint="sim2real play go2")
    # Walk on its twin.
    hidden = None if config.seed is None else HiddenTwin.draw(np.random.default_rng(config.seed), len(robot.joints))
    twin, wanted = Twin(robot, hidden, config.seed or 0), np.array(config.command)
    shown: Any = _window(twin, wanted) if config.view == WINDOW else None
    with progress(None, f"play: {config.duration_s:g} s on the twin"):
        walked = walk(
            twin, load_bundle(folder), lambda _: wanted.copy(), config.duration_s, push_m_s=config.push, shown=shown
        )
    if config.view not in (None, WINDOW):
        with progress(None, "play: picture"):
            _write_picture(twin, walked.qpos, Path(str(config.view)))
        wrote(str(config.view))
    end = f"fell after {walked.fell_s:.1f} s" if walked.fell_s is not None else f"walked for {config.duration_s:g} s"
    off = f"off the command by {walked.error_m_s:.3f} m/s and {walked.error_rad_s:.3f} rad/s"
    note(f"{end}; {'too short to measure its error' if np.isnan(walked.error_m_s) else off}")
    return walked


def _window(twin: "Twin", wanted: "np.ndarray") -> Any:
    """Open a window whose keys steer; return a function that shows a policy step at its time."""
    from mujoco import viewer

    def steer(key: int) -> None:
        if key == _SPACE:
            wanted[:] = 0.0
        elif key in _KEYS:
            entry, change = _KEYS[key]
            wanted[entry] = min(1.0, max(-1.0, wanted[entry] + change))

    window: Any = viewer.launch_passive(twin.model, twin.data, key_callback=steer)
    begin = time.monotonic()

    def shown(_: "Twin", t_s: float) -> None:
        window.sync()
        time.sleep(max(0.0, begin + t_s - time.monotonic()))

    return shown


def _write_picture(twin: "Twin", qpos: "np.ndarray", out: Path) -> None:
    """Write an animation of the robot's links, seen from the side."""
    from matplotlib.animation import PillowWriter
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.8, 2.7), dpi=80, layout="constrained")
    axes = figure.subplots()
    every = max(1, round(twin.robot.drive.rate_hz / _FRAMES_PER_S))
    writer = PillowWriter(fps=round(twin.robot.drive.rate_hz / every))
    with writer.saving(figure, str(out), 80):
        for row in qpos[::every]:
            axes.clear()
            for start, end in twin.links(row):
                color = "#0b62b0" if start[1] + end[1] >= 2.0 * row[1] else "#8fb8dd"  # the far side is lighter
                axes.plot([start[0], end[0]], [start[2], end[2]], color=color, lw=3, solid_capstyle="round")
            axes.axhline(0.0, color="#1c2530", lw=1)
            axes.set(xlim=(row[0] - 0.7, row[0] + 0.7), ylim=(-0.05, 0.6), aspect="equal", xlabel="forwards [m]")
            writer.grab_frame()
