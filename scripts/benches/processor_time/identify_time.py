"""How long an identification takes with programs in the compilation cache: processor time beside the yardstick `cold`.

A first identification fills a fresh cache folder; the second, of another log of the same length, is measured, with the
programs that it does not find there. The yardstick is one cold identification of the pendulum at commit 51f54b7.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

from benches.figures import Report, row
from benches.processor_time import yardstick
from benches.provenance import ROOT
from sim2real.errors import Sim2RealError

QUICK = {"robots": ["pendulum"], "cold_s": 1.0, "flags": ["--generations", "10", "--folds", "0", "--refine-steps", "2"]}
_GOALS = {"pendulum": 0.3, "go2": 1.5, "so101": 1.0, "arm": 1.0}
_COUNTED = """\
import json, sys
import jax
counts = {}
jax.monitoring.register_event_listener(lambda event, **_: counts.__setitem__(event, counts.get(event, 0) + 1))
from sim2real.cli import main
code = main(sys.argv[2:])
json.dump(counts, open(sys.argv[1], "w"))
sys.exit(code)
"""
"""A command of sim2real that writes the counts of JAX's events."""
_MISSES = "/jax/compilation_cache/cache_misses"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robots", nargs="*", default=list(_GOALS), choices=list(_GOALS), help="which robots")
    parser.add_argument("--data", type=Path, help="folder of public recordings, with go2/; without it go2 is skipped")
    parser.add_argument("--cold-s", type=float, help="the yardstick on this machine [s]; default: it is measured")
    parser.add_argument("--flags", nargs=argparse.REMAINDER, default=[], help="further flags of identify")


def run(options: argparse.Namespace) -> Report:
    """Measure the yardstick, then each robot.

    Raises:
        Sim2RealError: When a command fails.
    """
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        cold_s = options.cold_s or yardstick.cold_identification(Path(scratch) / "cold")
        rows.append(row("identify-time/cold_s", round(cold_s, 1), "s"))
        for robot in options.robots:
            if robot == "go2" and options.data is None:
                print("go2 is skipped: --data names no folder of recordings", file=sys.stderr)
                continue
            folder = Path(scratch) / robot
            folder.mkdir()
            first, second = _logs(robot, folder, options.data)
            _identify(robot, first, folder, options)
            spent_s, misses = _identify(robot, second, folder, options)
            name, goal = f"identify-time/{robot}/second_log", f"<= {_GOALS[robot]:g}"
            rows.append(row(f"{name}/over_cold", round(spent_s / cold_s, 3), "cold", "cold", goal))
            rows.append(row(f"{name}/misses", misses, "programs", "", "0"))
    return {"rows": rows}


def _logs(robot: str, folder: Path, data: Path | None) -> tuple[list[str], list[str]]:
    """Return the flags that name two logs of one length; for the Go2 twice the same."""
    if robot == "pendulum":
        logs = [ROOT / "datasets" / "pendulum" / f"{name}.mcap" for name in ("chirp", "multisine")]
    elif robot == "go2" and data is not None:
        return (flags := ["--mjcf", str(data / "go2" / "go2.xml"), "--log", str(data / "go2" / "chirp_fit.npz")]), flags
    else:
        logs = [_recorded(robot, folder / str(seed), seed) for seed in (0, 1)]
    first, second = (["--log", str(log)] for log in logs)
    return first, second


def _recorded(robot: str, folder: Path, seed: int) -> Path:
    """Return a log of an emulated robot."""
    command = [sys.executable, "-m", "sim2real.cli", "record", robot, "--seed", str(seed), "--runs", str(folder)]
    done = yardstick.measure(command, ROOT, os.environ)
    if done.code:
        raise Sim2RealError(f"`sim2real record {robot}` ended with exit code {done.code}")
    return next(folder.rglob("session.mcap"))


def _identify(robot: str, log: list[str], folder: Path, options: argparse.Namespace) -> tuple[float, int]:
    """Identify from a log; return the processor time [s], and the number of programs that were not in the cache."""
    environment = yardstick.plain_environment(os.environ) | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    counts = folder / "counts.json"
    named = [] if "--mjcf" in log else [robot]
    words = ["identify", *named, *log, "--runs", str(folder / "runs"), *options.flags]
    done = yardstick.measure([sys.executable, "-c", _COUNTED, str(counts), *words], ROOT, environment)
    if done.code:
        raise Sim2RealError(f"`sim2real {' '.join(words)}` ended with exit code {done.code}")
    return done.processor_s, json.loads(counts.read_text()).get(_MISSES, 0)
