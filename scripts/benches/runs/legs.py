"""The Go2's shipped policy over DDS with the emulator beside it: its computation, and how late the loop is at 50 Hz."""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace

import numpy as np
from benches.figures import Report, Row, row

QUICK = {"seconds": 1.0}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the episode")


def run(options: argparse.Namespace) -> Report:
    """Let the policy walk; return its computation time, and the lateness of each node."""
    from sim2real.graph.node import TICKS_PER_S
    from sim2real.stages.deploy.stage import deploy
    from sim2real.stages.pipeline.pipeline import load_pipeline

    pipeline = load_pipeline("go2")
    with tempfile.TemporaryDirectory() as folder:
        config = replace(pipeline.deploy, episodes=1, duration_s=max(1.0, options.seconds))
        steps = deploy(pipeline, pipeline.shipped, folder, config).recordings[0].episode.steps
    agent = steps["agent"]
    about = f"{len(agent.start)} steps at 50 Hz"
    rows = [_quantiles("legs/policy", (agent.end - agent.woken) / TICKS_PER_S, about, "3")]
    for node in ("sensor", "agent", "actuator"):
        late = (steps[node].woken - steps[node].start) / TICKS_PER_S
        rows.append(_quantiles(f"legs/lateness/{node}", late, about, "1"))
    return {"rows": rows}


def _quantiles(name: str, seconds: np.ndarray, about: str, goal: str) -> Row:
    """Return the row of the 99 % quantile of times [ms], with median and maximum."""
    p50, p99, most = (round(1e3 * float(q), 3) for q in np.quantile(seconds, [0.5, 0.99, 1.0]))
    return row(f"{name}_p99", p99, "ms", f"{about}; median {p50}, maximum {most}", goal)
