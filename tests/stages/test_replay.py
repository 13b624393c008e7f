"""A deployment's log tests the identified parameters: a robot that has not changed, and one with twice the friction."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.artifacts.identification import ComparedError, Estimate, Identification, Internal, Judgement
from sim2real.artifacts.posterior import Posterior
from sim2real.errors import Sim2RealError
from sim2real.stages.deploy import replay
from sim2real.stages.load import load_robot
from sim2real.stages.session.excitation import excitation
from sim2real.stages.session.simulated_log import simulate

ROBOT = load_robot("pendulum")
MODEL = ROBOT.identifiable(0.06)
VALUES = MODEL.parameters.decode(MODEL.parameters.start())
ERROR = ComparedError("", "hinge", "rad", 0.1, 0.02, baselines={"standing still": 0.3})


@pytest.fixture(scope="module")
def identified():
    """The pendulum at the values of its data sheet, as sure as a good recording makes it."""
    free = [p for p in MODEL.parameters if p.free]
    rows = tuple(
        Estimate(p.name, p.unit, p.kind, "", p.nominal, float(VALUES[p.name]), "ok" if p.free else "fixed",
                 lower=p.low, upper=p.high)
        for p in MODEL.parameters
    )  # fmt: skip
    mean, low, high = np.array([[p.to_scale(v) for v in (float(VALUES[p.name]), p.low, p.high)] for p in free]).T
    spread = np.diag(np.square(0.002 * (high - low)))
    posterior = Posterior(tuple(p.name for p in free), tuple(p.transform for p in free), mean, spread, low, high)
    document = Identification("pendulum", (), Judgement("accepted", ()), rows, posterior=posterior, errors=(ERROR,))
    return replace(document, internal=Internal(settle_s=0.3))


def log(duration_s=8.0, **factors):
    """Return a log of a robot with other parameters, which reads its angle with noise."""
    config = replace(ROBOT.defaults.record, duration_s=duration_s)
    values = {name: value * factors.get(name, 1.0) for name, value in VALUES.items()}
    episode = simulate(MODEL, ROBOT, excitation(config, 50.0)[:, None], values, ROBOT.defaults.identify)
    read = episode.outputs["sensor"]
    read["th"] = read["th"] + 1e-3 * np.random.default_rng(0).standard_normal(read["th"].shape)
    return episode


def test_twice_the_friction_is_named_and_fitted_and_an_unchanged_robot_is_not(identified):
    (row,), drift = replay.tested(ROBOT, identified, [log()])
    assert (row.joint, row.log, row.seconds) == ("hinge", "this deployment", 0.1)
    assert row.ratio < 1.0
    assert drift.named is None
    (row,), drift = replay.tested(ROBOT, identified, [log(friction=2.0)])
    assert row.exceeded
    assert row.baselines["as in this log"] < 0.5 * row.error
    assert drift.named.name == "friction"
    assert drift.named.now == pytest.approx(2.0 * float(VALUES["friction"]), rel=0.05)


def test_a_short_log_and_one_without_motion_test_nothing(identified):
    episode = log(4.0)
    with pytest.raises(Sim2RealError, match=r"4\.0 s of deployment, 3\.. s of them in motion, are too little"):
        replay.tested(ROBOT, identified, [episode])
    still = replace(episode, outputs=dict(episode.outputs))
    still.outputs["sensor"] = {n: np.zeros_like(v) for n, v in episode.outputs["sensor"].items()}
    with pytest.raises(Sim2RealError, match=r"8\.0 s of deployment, 0\.0 s of them in motion"):
        replay.tested(ROBOT, identified, [still, still])
