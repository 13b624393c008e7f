"""README's moving picture: a recorded deployment of the pendulum beside its simulation.

make demo
python scripts/moving_picture.py runs/pendulum/TIME/deploy --out docs/images/swing_up.gif
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("agg")
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sim2real.artifacts.deployment import Deployment

FRAMES_PER_S, SECONDS = 15, 5.0
ROBOT, MODEL, INK = "#0b62b0", "#b8540c", "#1c2530"


def main() -> None:
    """Draw the first episode and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("deployment", type=Path, help="folder of the stage deploy of a run of the pendulum")
    parser.add_argument("--out", type=Path, default=Path("docs/images/swing_up.gif"), help="GIF to write")
    options = parser.parse_args()
    deployment = Deployment.load(options.deployment)
    t_s = np.arange(0.0, SECONDS, 1 / FRAMES_PER_S)
    animate(t_s, measured(deployment, t_s), simulated(deployment, t_s), options.out)
    print(f"wrote {options.out} ({options.out.stat().st_size / 1e6:.2f} MB)")


def measured(deployment: Deployment, t_s: np.ndarray) -> np.ndarray:
    """Return the angle that the sensor measured at times [s], without jumps of a turn [rad]; 0 is upright."""
    episode = deployment.recordings[0].episode
    sent_s = episode.steps["sensor"].end / 1e6
    return np.interp(t_s, sent_s, np.unwrap(np.asarray(episode.outputs["sensor"]["th"], np.float64).ravel()))


def simulated(deployment: Deployment, t_s: np.ndarray) -> np.ndarray:
    """Return the angle of the same policy in simulation at times [s] [rad]."""
    columns = deployment.simulated[0]
    return np.interp(t_s, columns["t"], np.unwrap(columns["th"].astype(np.float64)))


def animate(t_s: np.ndarray, robot: np.ndarray, model: np.ndarray, out: Path) -> None:
    """Write the picture: both pendulums from the front, and both angles over time up to the frame's time."""
    # Both start hanging: at -pi or pi, whichever the first measurement shows.
    model = model + 2 * np.pi * np.round((robot[0] - model[0]) / (2 * np.pi))
    figure = Figure(figsize=(8.0, 2.7), dpi=90, layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1.3, 1.3, 2.2])
    rods = [_pendulum(left, "on the robot", ROBOT), _pendulum(middle, "in simulation", MODEL)]
    curves = [right.plot([], [], color=colour, lw=2)[0] for colour in (ROBOT, MODEL)]
    right.axhline(0, color=INK, lw=0.8, ls=":")
    right.set(xlim=(0, SECONDS), xlabel="time [s]", ylabel="angle from upright [rad]")
    right.set_ylim(min(robot.min(), model.min()) - 0.3, max(robot.max(), model.max()) + 0.3)

    def draw(frame: int) -> list[Line2D]:
        for angles, rod, curve in zip((robot, model), rods, curves, strict=True):
            rod.set_data([0, np.sin(angles[frame])], [0, np.cos(angles[frame])])
            curve.set_data(t_s[: frame + 1], angles[: frame + 1])
        return [*rods, *curves]

    out.parent.mkdir(parents=True, exist_ok=True)
    FuncAnimation(figure, draw, frames=len(t_s)).save(out, writer=PillowWriter(fps=FRAMES_PER_S))


def _pendulum(axes: Axes, title: str, colour: str) -> Line2D:
    """Prepare a panel for a pendulum and return its rod."""
    axes.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25), aspect="equal", title=title)
    axes.axis("off")
    return axes.plot([], [], color=colour, lw=4, marker="o", ms=14, markevery=[1], solid_capstyle="round")[0]


if __name__ == "__main__":
    main()
