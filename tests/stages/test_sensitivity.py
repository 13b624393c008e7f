"""Which parameter breaks a policy, where it is known: a pendulum that a constant voltage must hold at an angle.

It comes to rest where gravity * sin(angle) = gain * voltage; so only these two decide, whatever damping and delays are.
"""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.artifacts.identification import Estimate
from sim2real.artifacts.posterior import Posterior
from sim2real.artifacts.sensitivity import Moved, Sensitivity
from sim2real.errors import Sim2RealError
from sim2real.graph.schedule import draw
from sim2real.policy.contract import observation_size
from sim2real.robots.training import training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import load_robot
from sim2real.stages.train.sensitivity import fitted_to_graph, models_of, moves_of, room_s, sensitivity
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.networks.architectures import MLP
from sim2real.training.networks.policy import Policy

VALUES = {
    "gain": 20.0, "gravity": 100.0, "damping": 20.0, "friction": 0.1, "sensor_delay": 0.02, "actuator_delay": 0.025,
}  # fmt: skip
VOLTS, NEAR_RAD = 2.0, 0.05
ANGLE_RAD = np.arcsin(VALUES["gain"] * VOLTS / VALUES["gravity"])


def found_with(errors, names=tuple(n for n in VALUES if n != "sensor_delay")):
    """An identification with relative standard errors."""
    sigma = np.array([errors[n] for n in names])  # of logarithms, and of delays in seconds
    matrix = np.eye(len(names))
    kinds = tuple("linear" if n.endswith("delay") else "log" for n in names)
    mean = np.array([v if k == "linear" else np.log(v) for v, k in zip((VALUES[n] for n in names), kinds, strict=True)])
    low = np.where([k == "linear" for k in kinds], 0.0, mean - 2.0)
    posterior = Posterior(
        names, kinds, mean, matrix * np.outer(sigma, sigma), low, np.where(low == 0.0, 0.06, mean + 2)
    )
    estimates = []
    for n, s in zip(names, sigma, strict=True):
        half = 1.96 * s * (1.0 if n.endswith("delay") else VALUES[n])
        ends = {"low95": VALUES[n] - half, "high95": VALUES[n] + half}
        kind = "delay" if n.endswith("delay") else "dynamics"
        estimates.append(Estimate(n, "s" if kind == "delay" else "u", kind, "", None, VALUES[n], "accepted", **ends))
    return SimpleNamespace(parameters=estimates, values=VALUES, posterior=posterior)


SURE = dict.fromkeys(VALUES, 1e-3) | {"sensor_delay": 1e-3, "actuator_delay": 1e-3}


class Holding(type(load_robot("pendulum").task)):
    """Succeeds near the angle; all episodes start hanging at rest."""

    def random(self, key, draw):
        return draw(key), self.at_rest(0)

    def judge(self, graph_state, action):
        near = jnp.abs(jnp.abs(graph_state.state["world"].th - jnp.pi) - ANGLE_RAD) < NEAR_RAD
        return super().judge(graph_state, action)._replace(success=near)


def holding():
    robot = type(load_robot("pendulum"))()
    robot.task = Holding()
    return robot


@pytest.fixture(scope="module")
def judged():
    """The policy on all models; the gain is uncertain by 2 %."""
    found = found_with({**SURE, "gain": 0.02})
    moves = moves_of(found)
    models = models_of(found.values, moves)
    robot, spread_s = holding(), room_s(models)
    nodes, task = training_loop(robot, found.values, {}, {}, True, spread_s)
    env = GraphEnvironment(CompiledGraph(nodes, "agent", draw(nodes, 1.5)), task)
    layer = (jnp.zeros((observation_size(robot.task.observation), 1)), jnp.full(1, VOLTS / 2.0))
    zero, one = jnp.zeros(observation_size(robot.task.observation)), jnp.ones(1)
    policy = Policy((layer,), one, zero, zero + 1.0, -2.0 * one, 2.0 * one, MLP((1,)))
    return sensitivity(env, policy, moves, fitted_to_graph(models, robot.model.tick_s, spread_s), seed=0)


@pytest.mark.night
def test_the_parameter_that_breaks_it_is_found_and_no_other(judged):
    assert judged.success == 1.0
    assert judged.parameters[0].name == "gain"
    assert {p.name for p in judged.parameters} == {"gain", "gravity", "damping", "friction", "round_trip_delay"}
    assert [judged.breaks_at(p) for p in judged.parameters[1:]] == [None] * 4
    assert judged.advice.startswith("Measure 'gain' better: 4 half-widths of its 95 % interval ")


def test_what_is_not_known_to_be_uncertain_is_not_moved():
    found = found_with(SURE)
    found.parameters[0] = Estimate("gain", "u", "dynamics", "", None, 20.0, "fixed")
    assert "gain" not in {m.name for m in moves_of(found)}
    found.posterior = None
    assert moves_of(found) == []


def curve(name, *success):
    return Moved(name, "u", 1.0, 0.1, 1.0 + 0.1 * np.array([-2.0, -1.0, 1.0, 2.0]), np.array(success))


def test_the_worst_comes_first_and_the_file_says_the_same(tmp_path):
    multiples = np.array([-2.0, -1.0, 1.0, 2.0])
    parameters = [curve("mild", 0.9, 0.9, 0.9, 0.7), curve("none", 1, 1, 1, 0.9), curve("first", 1, 0.5, 1, 1)]
    made = Sensitivity.of(multiples, 1.0, 16, parameters)
    assert [(p.name, made.breaks_at(p)) for p in made.parameters] == [("first", -1.0), ("mild", 2.0), ("none", None)]
    assert made.advice == (
        "Measure 'first' better: 1 half-width of its 95 % interval below the estimate, at 0.9 u, success falls from "
        "1.00 to 0.50."
    )
    unmoved = Sensitivity.of(multiples, 1.0, 16, [curve("none", 1, 1, 1, 1)])
    assert unmoved.advice.endswith("95 % interval: success stays 1.00, whichever is moved.")
    made.save(tmp_path / "sensitivity.json")
    again = Sensitivity.load(tmp_path)
    assert again.advice == made.advice
    np.testing.assert_array_equal(again.parameters[0].success, made.parameters[0].success)
    (tmp_path / "sensitivity.json").write_text('{"format": 1, "multiples": []}')
    with pytest.raises(Sim2RealError, match=r"sensitivity\.json is malformed"):
        Sensitivity.load(tmp_path)
