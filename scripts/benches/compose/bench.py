"""Worlds from parts: control steps against dm_control's composer, and tasks on MuJoCo Warp against bare ``mjx.step``.

Without dm_control, or without Warp, the rows that need it are missing.
"""

from __future__ import annotations

import argparse

from benches.compose.step import step
from benches.compose.warp import warp
from benches.rows import Report

PARTS = ("step", "warp")
QUICK = {"repeats": 1, "control_steps": 2, "warp_copies": [2], "warp_steps": 2}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--control-steps", type=int, default=200, help="control steps in a row; fewer with a camera")
    parser.add_argument(
        "--warp-copies", type=int, nargs="+", help="of the quadruped; default: 8 on the CPU, three sizes on a GPU"
    )
    parser.add_argument("--warp-steps", type=int, default=100, help="control steps of the quadruped in a rollout")


def run(options: argparse.Namespace) -> Report:
    """Measure the selected parts on the device that JAX finds."""
    rows = []
    if "step" in options.parts:
        rows += step(options.repeats, options.control_steps)
    if "warp" in options.parts:
        rows += warp(options.warp_copies, options.repeats, options.warp_steps)
    return {"rows": rows}
