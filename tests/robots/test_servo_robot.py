"""What a servo robot tells the stages, of a small one and of the arm."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from small_robot import SERVOS, VALUES, PairRobot

from sim2real.graph.base import GraphState
from sim2real.robots.agent import AgentParams
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.nodes import recording_nodes
from sim2real.robots.servo.servos import DataSheet
from sim2real.robots.training import node_parameters, simulation_params


def slouching():
    """Return a pair that hangs askew, whose policy observes errors and no past."""
    return PairRobot(
        replace(SERVOS, rest=(0.1, -0.2)),
        features=(("error", ("rad", "rad")),),
        observe=lambda reading, goal, aim: goal - reading.position,
        history=0,
    )


def test_a_data_sheets_gain_is_the_torque_of_a_step_of_error():
    sheet = DataSheet(stall=1.4, damping=0.23, armature=0.0045, friction=0.03, p_gain=800)
    counts = 885 / (800 / 256)
    assert sheet.full_rad == pytest.approx(counts * 2 * np.pi / 4096, rel=1e-6)
    assert sheet.gain == pytest.approx(1.4 / sheet.full_rad)
    assert (sheet.drive.p_gain, sheet.drive.speed_rad_s, sheet.drive.d_gain) == (800, 5.0, 0)


def test_fast_goals_cost_a_hundredth_of_the_mean_square_of_their_share_of_the_largest_speed(pair):
    world = SimpleNamespace(position=jnp.array([0.1, 0.2]), velocity=jnp.zeros(2))
    now = GraphState(state={"world": world}, params={"agent": AgentParams(aim=jnp.zeros(1))})
    terms = pair.task.judge(now, jnp.array([2.0, -1.0])).reward  # of 2 rad/s
    assert {n: float(v) for n, v in terms.items()} == {"task": pytest.approx(-0.05), "speed": pytest.approx(-0.00625)}


def test_parameters_land_in_the_nodes_that_need_them(pair):
    values = {**VALUES, "sensor_delay": 0.012, "actuator_delay": 0.02}
    params = node_parameters(pair, values, EpisodeStart([0.1, 0.2], [1.0, 2.0], jnp.array([0.4])), policy="policy")
    world = params["world"]
    np.testing.assert_array_equal(world.qpos, np.float32([0.1, 0.2]))
    np.testing.assert_array_equal(world.qvel, [1.0, 2.0])
    assert (params["sensor"].delay, params["actuator"].delay) == (0.012, 0.02)
    agent = params["agent"]
    np.testing.assert_array_equal(agent.start, world.qpos)
    assert (agent.policy, float(agent.aim[0])) == ("policy", pytest.approx(0.4))
    for name in ("sensor", "actuator"):
        assert node_parameters(pair, VALUES, EpisodeStart([0, 0], [0, 0], jnp.zeros(1)))[name].delay is None


def test_a_simulation_starts_from_rest_and_each_trial_has_its_own_aim():
    robot = slouching()
    params = [simulation_params(robot, robot.nominal(), None, trial) for trial in (0, 1, 1)]
    np.testing.assert_array_equal(params[0]["world"].qpos, np.float32([0.1, -0.2]))
    np.testing.assert_array_equal(params[0]["world"].qvel, [0.0, 0.0])
    aims = [float(p["agent"].aim[0]) for p in params]
    assert aims[0] != aims[1] == aims[2]
    assert aims[1] == float(robot.task.aim.draw(1)[0])
    # A folded SO-101 lies on its stop: a start within the bounds of goals was 90 mrad away from it.
    beyond = np.asarray(robot.drive.servos.high) + 0.09
    params = simulation_params(robot, robot.nominal(), None, measured=beyond)
    np.testing.assert_allclose(params["world"].qpos, beyond, rtol=1e-6)
    assert params["world"].qpos.dtype == np.float32


def test_a_recording_begins_where_the_joints_are_and_plays_around_the_middle(pair):
    reading = SimpleNamespace(position_rad=np.array([1.0, -0.3]))
    rig = SimpleNamespace(wait_until_still=lambda *_: reading)
    signal = 0.2 * np.sin(np.arange(100))[:, None] * np.ones(2)
    agent = recording_nodes(pair, rig, signal)["agent"]
    played = np.array([agent.step(SimpleNamespace(seq=k))[1].command for k in range(100)])
    np.testing.assert_allclose(played[0], reading.position_rad)
    off = np.abs(played - signal)
    assert np.abs(np.diff(off, axis=0)).max() <= 1.0 / pair.drive.rate_hz + 1e-9
    np.testing.assert_array_equal(played[51:], signal[51:])
    np.testing.assert_array_equal(played[16:, 1], signal[16:, 1])
    middle = replace(SERVOS, middle=(1.0, -0.3))
    agent = recording_nodes(PairRobot(middle), rig, signal)["agent"]
    played = np.array([agent.step(SimpleNamespace(seq=k))[1].command for k in range(120)])
    np.testing.assert_allclose(played[:100], signal + np.array([1.0, -0.3]))
    np.testing.assert_allclose(played[100:], np.tile(played[99], (20, 1)))  # it waits where it ends
