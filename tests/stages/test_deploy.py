"""What deploy refuses to run."""

import numpy as np
import pytest

from sim2real.artifacts.bundle import Bundle
from sim2real.errors import Sim2RealError
from sim2real.policy import ActionTerm, ObservationTerm, PolicyContract, save_bundle
from sim2real.stages import deploy
from sim2real.stages.pipeline import load_pipeline


@pytest.mark.parametrize("name", ["pendulum", "arm"])
def test_a_policy_may_not_ask_for_more_than_the_robot_bears(tmp_path, name):
    robot = load_pipeline(name).load()
    size = sum(len(units) * history for _, units, history in robot.OBSERVATION)

    def bundle(factor):
        low, high = (factor * np.array(side, np.float32) for side in zip(*robot.ACTION_BOUNDS, strict=True))
        terms = zip(robot.ACTION, low.tolist(), high.tolist(), strict=True)
        contract = PolicyContract(
            tuple(ObservationTerm(*term) for term in robot.OBSERVATION),
            tuple(ActionTerm(*action, a, b) for action, a, b in terms),
            robot.RATE_HZ,
        )
        zeros, actions = np.zeros(size, np.float32), len(low)
        weights = {"mean": zeros, "std": zeros + 1, "low": low, "high": high, "log_std": np.zeros(actions)}
        weights |= {"layers.0.kernel": np.zeros((size, actions)), "layers.0.bias": np.zeros(actions)}
        return Bundle.load(save_bundle(tmp_path / str(factor), weights, contract, np.zeros((1, size))))

    deploy._load_policy(robot, bundle(1))
    with pytest.raises(Sim2RealError, match=r"(?s)this robot bears -.*hint: train a policy"):
        deploy._load_policy(robot, bundle(50))
