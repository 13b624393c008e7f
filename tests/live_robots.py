"""What the tests of the stages ask of runs, logs, bundles and the emulator's truth."""

import json

import numpy as np

from sim2real.emulation.truth import Kind
from sim2real.hardware.device import OperatingMode
from sim2real.policy import PolicyContract, save_bundle
from sim2real.policy.contract import observation_size
from sim2real.stages.load import load_robot

TINY = [
    "--identify.folds=0",
    *("--train.episode-s=2", "--train.timelines=4", "--train.force", "--train.no-sensitivity"),
    *("--train.ppo.total-steps=512", "--train.ppo.num-envs=16", "--train.ppo.minibatches=2"),
    *("--train.ppo.evaluations=1", "--deploy.episodes=1", "--deploy.duration-s=2"),
    "--deploy.no-measure-delay",
]
"""Small budgets."""


def manifest_of(folder):
    return json.loads((folder / "manifest.json").read_text())


def make_bundle(name, folder, bias=0.0, slope=0.0):
    """Write a bundle whose policy gives the same action always, or one that grows with the third observation."""
    robot = load_robot(name)
    trained = {"round_trip_delay": (0.043, 0.047)} if name == "pendulum" else {}
    terms = robot.task.observation, robot.task.action, robot.drive.rate_hz
    contract = PolicyContract(*terms, trained_s=trained, limits=dict(robot.task.limits))
    return save_bundle(folder / "bundle", linear(contract, bias, slope), contract)


def linear(contract, bias=0.0, slope=0.0):
    """Return the weights of such a policy."""
    size, low, high = observation_size(contract.observation), *np.array([(a.low, a.high) for a in contract.action]).T
    weights = {"mean": np.zeros(size), "std": np.ones(size), "low": low, "high": high, "log_std": np.zeros(len(low))}
    kernel = np.zeros((size, len(low)))
    kernel[2] = slope
    return weights | {"layers.0.kernel": kernel, "layers.0.bias": np.full(len(low), bias)}


def assert_torque_ends_off(truth):
    """The motor turned, and the last thing it was told is to let go."""
    modes, goals = truth.of(Kind.EFFECT)["values"][:, :2].T
    assert np.any(modes == OperatingMode.PWM)
    assert np.any(goals != 0.0)
    assert modes[-1] == OperatingMode.OFF
