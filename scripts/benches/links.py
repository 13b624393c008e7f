"""Links found from the motion: five emulated ones, and how often intervals hold the truth.

A log has the stamps of measurements but not how old they are; that is found together with the dynamics. The yardstick
is the emulation, which shares no code with the package.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from benches import emulated_links as emulated
from benches.figures import row
from sim2real.artifacts.estimation.links import Link
from sim2real.identify.delays.likelihood import Seen
from sim2real.identify.delays.links import describe, find

QUICK = {"seconds": 4.0, "logs": 5, "log_s": 4.0}
STEP_S, LONGEST_S = 0.001, 0.06
OFF = np.array([0.05, -0.1, 0.05])
"""How far the search begins from the true dynamics, in their logarithms."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the log of each link")
    parser.add_argument("--logs", type=int, default=400, help="logs on which intervals are checked, of all links")
    parser.add_argument("--log-s", type=float, default=10.0, help="length of each of those")


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Find each link once, then the same links in many logs."""
    rows, truths = [], {kind: emulated.truth(kind) for kind in emulated.KINDS}
    for kind, truth in truths.items():
        link = identified(emulated.log(kind, options.seconds, 0))
        rows += off(kind, link, truth)
    begin = time.perf_counter()
    held: dict[str, list[bool]] = {"mean": [], "p95": [], "deviation": [], "drift": []}
    lost, worst = [], {"mean": 0.0, "p95": 0.0}
    for i in range(options.logs):
        kind = emulated.KINDS[i % len(emulated.KINDS)]
        link, truth = identified(emulated.log(kind, options.log_s, 1 + i)), truths[kind]
        for name, hits in held.items():
            hits.append(holds(link, name, truth))
        for name in worst:
            worst[name] = max(worst[name], abs(value(link, name) - getattr(truth, name)))
        if kind == "bursts":
            lost.append(holds(link, "lost", truth))
    few, many = round(0.92 * options.logs), round(0.98 * options.logs)
    for name, hits in held.items():
        goal = f"{few} to {many} of {options.logs}"
        rows.append(row(f"links/intervals/{name}", sum(hits), "logs", "the emulation", goal))
    rows.append(row("links/intervals/lost", sum(lost), f"of {len(lost)} logs", "the emulation"))
    for name, most in worst.items():
        rows.append(row(f"links/worst/{name}_ms", 1e3 * most, "ms", "the emulation"))
    rows.append(row("links/log_s", (time.perf_counter() - begin) / max(options.logs, 1), "s"))
    return {"rows": rows}


def off(kind: str, link: Link, truth: emulated.Truth) -> list[dict[str, Any]]:
    """Return how far a link is off."""
    rows = [
        row(f"links/{kind}/mean_ms", 1e3 * abs(value(link, "mean") - truth.mean), "ms", "the emulation", "<= 0.5"),
        row(f"links/{kind}/p95_ms", 1e3 * abs(value(link, "p95") - truth.p95), "ms", "the emulation", "<= 1.5"),
        row(f"links/{kind}/deviation_ms", 1e3 * abs(value(link, "deviation") - truth.deviation), "ms", "the emulation"),
    ]
    if truth.lost:
        share = abs(value(link, "lost") / truth.lost - 1)
        rows.append(row(f"links/{kind}/lost", share, "relative", "the emulation", "<= 0.2"))
        rows.append(
            row(f"links/{kind}/burst", abs(value(link, "burst") / truth.burst - 1), "relative", "the emulation")
        )
    if truth.drift:
        rows.append(row(f"links/{kind}/drift", 1e6 * abs(value(link, "drift") - truth.drift), "us/s", "the emulation"))
    return rows


def value(link: Link, name: str) -> float:
    """Return a number of a link; NaN where it has none."""
    found = getattr(link, name).value
    return float("nan") if found is None else found


def holds(link: Link, name: str, truth: emulated.Truth) -> bool:
    """Return whether an interval holds the truth."""
    found = getattr(link, name)
    return bool(found.low95 <= getattr(truth, name) <= found.high95)


def identified(log: emulated.Log) -> Link:
    """Find the link of a log, and the dynamics, from a start that is some way off."""
    again = np.concatenate([[False], np.diff(log.angles) == 0.0])
    quantum = np.diff(np.unique(log.angles)).min() / emulated.NOISE_RAD
    start = np.concatenate([np.log(emulated.DYNAMICS) + OFF, [0.0, 0.0]])
    grid = np.arange(0.0, LONGEST_S + STEP_S / 2, STEP_S)
    volts = emulated.held(log.sent, log.commands, log.duration_s, STEP_S)
    t = np.arange(len(volts)) * STEP_S

    def angle(x: np.ndarray) -> np.ndarray:
        return emulated.motion(np.exp(x[:3]), volts, STEP_S, (x[3], x[4]))

    def linearise(x: np.ndarray, delay_s: float) -> Seen:
        own = angle(x)
        off = np.interp(log.stamps[:, None] - grid, t, own) - log.angles[:, None]
        steps = 1e-3 * np.eye(len(x))
        slopes = [np.interp(log.stamps - delay_s, t, (angle(x + s) - own) / 1e-3) for s in steps]
        sigma = emulated.NOISE_RAD
        jacobian = np.stack(slopes, axis=1)[:, None] / sigma
        return Seen(log.stamps - log.stamps.mean(), grid, off[:, None] / sigma, jacobian, 1e-2 * np.eye(len(x)))

    found = find(linearise, start, 0.01, again, np.array([quantum]))
    return describe("measurements", ("measurements", "commands"), found, emulated.COMMAND_DELAY_S)
