"""One run of the pendulum for all tests that need any finished run: made once a session, on a simulated clock.

The stages identify, train and deploy are the real ones with tiny budgets. The robot is the pendulum of the benches,
which is simulated by hand: a recording of 12 s takes milliseconds, and a busy machine does not disturb it.
"""

from __future__ import annotations

import fcntl
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "scripts"))
from benches.hidden import randomise
from benches.hidden import robots as hidden
from live_robots import TINY
from sketches import sketched

from sim2real import cli
from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.recording import LOG, TRUTH, Recording
from sim2real.artifacts.run import finished, open_stage
from sim2real.emulation.truth import Kind, TruthLog
from sim2real.stages.deploy import episodes
from sim2real.stages.load import load_robot

RECORD_S, VOLTS = 12.0, 2.0
ROBOT = replace(hidden.Hidden.draw(1), jitter=0.0, lost=0.0, play=0.0)
SUMMARY = {
    "transactions": 1200, "lost_replies": 0, "late_replies": 0,
    "command_timeouts": 0, "monotonic_ns": 0,
}  # fmt: skip


def make(root: Path) -> Path:
    """Make a run with all four stages below ``root``; return its folder."""
    pipeline = load_robot("pendulum")
    config = replace(pipeline.defaults.record, duration_s=RECORD_S, seed=1)
    with open_stage(root, pipeline.name, "record", config) as stage:
        played = hidden.play(ROBOT, hidden.excited(RECORD_S, 0), RECORD_S, 0)
        write(stage.output("log", LOG), stage.output("truth", TRUTH), played)
        recording = Recording.load(stage.folder / LOG, stage.folder / TRUTH)
        for name, path in recording.timing.save(stage.folder).items():
            stage.output(name, path)
    run_dir = stage.run_dir
    with pytest.MonkeyPatch.context() as patch, sketched(pictures=1):
        patch.setattr(episodes, "opened", lambda robot, config, _: nullcontext(Mock(config=config)))
        patch.setattr(episodes, "_announce_following", lambda following: None)
        patch.setattr(episodes, "_run_one", lambda *given: deployed(run_dir, *given))
        assert cli.main(["run", "pendulum", "--resume", str(run_dir), "--runs", str(root), *TINY]) == 0
    return run_dir


def deployed(run_dir: Path, *given: Any) -> dict[str, Any]:
    """Run the policy of a run on the simulated robot and write its log; takes what ``episodes._run_one`` takes."""
    bench, *_, log = given
    config = bench.config
    bundle = Bundle.load(finished(run_dir, "train").output("bundle"))
    played = hidden.play(ROBOT, randomise.controller(bundle, VOLTS), config.duration_s, 1)
    return write(log, log.parent / TRUTH, played)


def recorded(log: Path, seed: int) -> Path:
    """Record the simulated robot under another random excitation; return the log."""
    write(log, log.parent / TRUTH, hidden.play(ROBOT, hidden.excited(RECORD_S, seed), RECORD_S, seed))
    return log


def write(log: Path, truth: Path, played: hidden.Played) -> dict[str, Any]:
    """Write a session's log and the account of its true motion; return the summary that ends the log."""
    timing = {n: {"steps": len(played.volts), "overruns": 0} for n in ("sensor", "agent", "actuator")}
    summary = {**SUMMARY, "timing": timing}
    hidden.write(log, played, summary)
    # Write true parameters, states, and when samples were taken and commands took effect.
    values = {name: getattr(ROBOT, name) for name in ("gain", "gravity", "damping", "friction")}
    account = TruthLog(truth, {"state_names": ["th", "thdot"], "truth": values, "servo_ids": [1]})
    for i in range(0, len(played.t), round(0.005 / hidden.STEP_S)):  # 200 Hz, as an emulated robot does
        state = float(played.angle[i]), float(played.speed[i])
        account.write(Kind.STATE, 0, 0, round(1e9 * played.t[i]), 0, 0, state)
    sensing_ns, acting_ns = round(1e9 * ROBOT.sensing), round(1e9 * ROBOT.acting)
    at_ns = lambda of, node: (1000 * np.round(1e6 * of[node]).astype(int)).tolist()  # noqa: E731
    sampled, acted = at_ns(played.starts, "sensor"), (at_ns(of, "actuator") for of in (played.starts, played.ends))
    for read, begin, end, volts in zip(sampled, *acted, played.volts, strict=True):
        account.write(Kind.SAMPLE, 1, read, read - sensing_ns, read, 0, (0.0, 0.0, 0.0))
        account.write(Kind.EFFECT, 1, begin, end + acting_ns, 0, 0, (16.0, float(volts)))
    account.close()
    return summary


def shared(base: Path) -> Path:
    """Return the session's run folder, which the first process to come makes.

    Args:
        base: Folder that all processes of the session share.
    """
    root = base / "shared_run"
    with locked(base / "shared_run.lock"):
        if not (base / "shared_run.finished").is_file():
            make(root)
            (base / "shared_run.finished").touch()
    (run_dir,) = (root / "pendulum").iterdir()
    return run_dir


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock between processes for the block."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def state(folder: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of change [ns] of every file and folder below a folder: the fixture compares them."""
    about = {path: path.stat() for path in (folder, *folder.rglob("*"))}
    return {str(path): (found.st_size, found.st_mtime_ns) for path, found in about.items()}
