"""What the tests of the stages ask of runs, logs and the emulator's truth."""

import json
import time
from pathlib import Path

import numpy as np

from sim2real.emulation.truth import Kind
from sim2real.hardware.device import OperatingMode

TINY = [
    *("--identify.generations=10", "--identify.population=8", "--identify.folds=0"),
    *("--train.episode-s=2", "--train.timelines=4", "--train.force", "--train.no-sensitivity"),
    *("--train.ppo.total-steps=512", "--train.ppo.num-envs=16", "--train.ppo.minibatches=2"),
    *("--train.ppo.evaluations=1", "--deploy.episodes=1", "--deploy.duration-s=2"),
    *("--deploy.gate.servo-watchdog-s=0.4", "--deploy.no-measure-delay"),
]
"""Budgets, and patience with a busy machine."""
PATIENT = ["--gate.servo-watchdog-s", "0.4"]
"""For a stage whose test is not about this limit: a busy machine is silent for longer than the default now and then."""


def wait_until_running(root, pattern, process, timeout_s=60.0):
    """Wait until a log has been flushed twice, which is when the motor turns; return the log."""
    end = time.monotonic() + timeout_s
    sizes = set()
    while time.monotonic() < end:
        assert process.poll() is None, process.communicate()
        for found in Path(root).glob(pattern):
            sizes.add(found.stat().st_size)
            if len(sizes) > 3:
                return found
        time.sleep(0.02)
    raise TimeoutError(f"nothing was recorded in {timeout_s} s: {process.stderr.read()}")


def manifest_of(folder):
    return json.loads((folder / "manifest.json").read_text())


def motor(truth):
    """Return when commands took effect [ns], the mode and the goal of each."""
    effects = truth.of(Kind.EFFECT)
    return effects["t_ns"], effects["values"][:, 0], effects["values"][:, 1]


def assert_torque_ends_off(truth):
    """The motor turned, and the last thing it was told is to let go."""
    _, modes, goals = motor(truth)
    assert np.any(modes == OperatingMode.PWM)
    assert np.any(goals != 0.0)
    assert modes[-1] == OperatingMode.OFF
