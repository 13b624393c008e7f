"""README's moving picture: a recorded deployment of the pendulum beside its simulation.

make demo
python scripts/moving_picture.py runs/pendulum/TIME/deploy --out docs/images/swing_up.gif
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("agg")
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure

from sim2real.artifacts.deployment import Deployment

FRAMES_PER_S, SECONDS = 15, 5.0
ROBOT, MODEL, INK = "#0b62b0", "#b8540c", "#1c2530"


def main() -> None:
    """Draw the first episode: both pendulums from the front, and their angles from upright up to the frame's time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("deployment", type=Path, help="folder of the stage deploy of a run of the pendulum")
    parser.add_argument("--out", type=Path, default=Path("docs/images/swing_up.gif"), help="GIF to write")
    options = parser.parse_args()
    deployment, t_s = Deployment.load(options.deployment), np.arange(0.0, SECONDS, 1 / FRAMES_PER_S)
    episode, columns = deployment.recordings[0].episode, deployment.simulated[0]
    measured = np.unwrap(np.asarray(episode.outputs["sensor"]["th"], np.float64).ravel())
    robot = np.interp(t_s, episode.steps["sensor"].end / 1e6, measured)
    model = np.interp(t_s, columns["t"], np.unwrap(columns["th"].astype(np.float64)))
    # Both start hanging: at -pi or pi, whichever the first measurement shows.
    model = model + 2 * np.pi * np.round((robot[0] - model[0]) / (2 * np.pi))
    figure = Figure(figsize=(8.0, 2.7), dpi=90, layout="constrained")
    *fronts, right = figure.subplots(1, 3, width_ratios=[1.3, 1.3, 2.2])
    rods, curves = [], []
    for axes, title, colour in zip(fronts, ("on the robot", "in simulation"), (ROBOT, MODEL), strict=True):
        axes.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25), aspect="equal", title=title)
        axes.axis("off")
        rods += axes.plot([], [], color=colour, lw=4, marker="o", ms=14, markevery=[1], solid_capstyle="round")
        curves += right.plot([], [], color=colour, lw=2)
    right.axhline(0, color=INK, lw=0.8, ls=":")
    right.set(xlim=(0, SECONDS), xlabel="time [s]", ylabel="angle from upright [rad]")
    right.set_ylim(min(robot.min(), model.min()) - 0.3, max(robot.max(), model.max()) + 0.3)

    def draw(frame: int) -> list[Any]:
        for angles, rod, curve in zip((robot, model), rods, curves, strict=True):
            rod.set_data([0, np.sin(angles[frame])], [0, np.cos(angles[frame])])
            curve.set_data(t_s[: frame + 1], angles[: frame + 1])
        return [*rods, *curves]

    options.out.parent.mkdir(parents=True, exist_ok=True)
    FuncAnimation(figure, draw, frames=len(t_s)).save(options.out, writer=PillowWriter(fps=FRAMES_PER_S))
    print(f"wrote {options.out} ({options.out.stat().st_size / 1e6:.2f} MB)")


if __name__ == "__main__":
    main()
