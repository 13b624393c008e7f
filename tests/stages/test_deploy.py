"""What deploy refuses to run."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.artifacts.bundle import Bundle
from sim2real.errors import Sim2RealError
from sim2real.policy import PolicyContract, save_bundle
from sim2real.stages import deploy
from sim2real.stages.pipeline import load_pipeline


@pytest.mark.parametrize("name", ["pendulum", "arm"])
def test_a_policy_may_not_ask_for_more_than_the_robot_bears(tmp_path, name):
    robot = load_pipeline(name).load()

    def bundle(factor):
        low, high = (factor * np.array([getattr(a, s) for a in robot.action], np.float32) for s in ("low", "high"))
        bounds = zip(robot.action, low.tolist(), high.tolist(), strict=True)
        actions = tuple(replace(term, low=a, high=b) for term, a, b in bounds)
        contract = PolicyContract(robot.observation, actions, robot.rate_hz)
        size, n = robot.observation_size, len(low)
        zeros = np.zeros(size, np.float32)
        weights = {"mean": zeros, "std": zeros + 1, "low": low, "high": high, "log_std": np.zeros(n)}
        weights |= {"layers.0.kernel": np.zeros((size, n)), "layers.0.bias": np.zeros(n)}
        return Bundle.load(save_bundle(tmp_path / str(factor), weights, contract, np.zeros((1, size))))

    deploy._load_policy(robot, bundle(1))
    with pytest.raises(Sim2RealError, match=r"(?s)this robot bears -.*hint: train a policy"):
        deploy._load_policy(robot, bundle(50))
