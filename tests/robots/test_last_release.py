"""Robots written for the last release still work, with a warning: ``ServoRobot`` and ``LoopRobot`` make their parts."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_robot import SERVOS, PairRobot, PairTask

from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots import testing
from sim2real.robots.control_loop.hardware import Embedded
from sim2real.robots.control_loop.loop import DelayParams
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.control_loop.messages import Goals, JointReading
from sim2real.robots.loading import checked
from sim2real.robots.servo.agent import AgentParams, GoalAgent
from sim2real.robots.servo.servo_robot import ServoRobot

PLUGIN = Path(__file__).parents[1] / "plugin"


@pytest.fixture(scope="module")
def old_pair():
    with pytest.warns(FutureWarning, match="Pair inherits from ServoRobot, which goes with the next release"):

        class Pair(ServoRobot):
            servos = SERVOS
            aim = (("angle", "rad"),)
            history = 2

            def make_task(self):
                return PairTask()

            def draw_aim(self, key):
                return jax.random.uniform(key, (1,), minval=-0.4, maxval=0.8)

            def success(self, state):
                return jnp.all(jnp.abs(state.data.qpos) < 0.1)

            def score(self, t_s, states):
                return {"success": float(abs(states["position[0]"][-1]) < 0.1)}

    return Pair()


@pytest.fixture(scope="module")
def old_turntable():
    """The robot of the tutorial of devices, as the last release had it."""
    patch = pytest.MonkeyPatch()
    patch.syspath_prepend(PLUGIN)
    from turntable.robot import Table, TableParams

    patch.undo()
    with pytest.warns(FutureWarning, match="Turntable inherits from LoopRobot, which goes with the next release"):

        class Turntable(LoopRobot):
            rate_hz, tick_s = 50.0, 0.01
            units = {"position": "rad", "velocity": "rad/s", "goal": "rad/s", "aim": "rad/s"}  # noqa: RUF012
            command, message = "goal", Goals
            joints = {"table": {"position": "position", "velocity": "velocity"}}  # noqa: RUF012
            channels = (Channel("position", "velocity", 0.002, 0.05, index=0, label="table"),)
            at_rest = JointReading(np.zeros(1), np.zeros(1))
            observation = (ObservationTerm("velocity, goal, aim", ("rad/s",) * 3),)
            action = (ActionTerm("change of the goal", "rad/s^2", -60.0, 60.0),)
            embedded = Embedded("turntable.plant:Turntable", None)

            def dynamics(self):
                return [
                    Parameter("loop", "1/s", 25.0, 5.0, 100.0, leaf="world.loop"),
                    Parameter("friction", "rad/s^2", 8.0, 1.0, 50.0, leaf="world.friction"),
                ]

            def make_world(self, resumed=False):
                return Table("world", 100.0)

            def make_agent(self, **options):
                def features(reading, goal, aim):
                    return jnp.concatenate([reading.velocity, goal, aim])

                return GoalAgent("agent", 50.0, (-10.0,), (10.0,), features, history=0, aims=1, **options)

            def random_params(self, key, draw):
                return self.node_params(draw(key), jnp.zeros(2), jnp.ones(1))

            def judged(self, graph_state):
                return graph_state.state["world"].velocity - graph_state.params["agent"].aim

            def reward(self, error, action):
                return -jnp.abs(error).sum() - 1e-4 * jnp.abs(action).sum()

            def success(self, error):
                return jnp.all(jnp.abs(error) < 0.5)

            def node_params(self, values, start, aim, policy=None):
                return {
                    "world": TableParams(values["loop"], values["friction"], jnp.asarray(start)),
                    "sensor": DelayParams(values.get("sensor_delay")),
                    "actuator": DelayParams(values.get("actuator_delay")),
                    "agent": AgentParams(policy, aim, jnp.zeros(1)),
                }

            def resumed_params(self, values, start):
                params = self.node_params(values, start, jnp.zeros(1))
                return {name: params[name] for name in ("world", "sensor", "actuator")}

            def rest_params(self, values, policy, trial):
                return self.node_params(values, jnp.zeros(2), jnp.array([4.0]), policy)

            def agent_params(self, session, policy, trial):
                return AgentParams(policy, jnp.array([4.0 + trial]), jnp.zeros(1))

            def score(self, t_s, states):
                error = np.abs(states["velocity"] - states["aim"][-1])[t_s >= t_s[-1] - 1.0]
                return {"success": float((error < 0.5).mean())}

    return Turntable()


def test_a_robot_of_servos_has_the_same_parts_as_before(old_pair, pair):
    assert isinstance(pair, PairRobot)
    checked(old_pair, "here")
    assert (old_pair.units, old_pair.nominal()) == (pair.units, pair.nominal())
    assert old_pair.agent.observation == pair.agent.observation
    assert old_pair.sensor.channels == pair.sensor.channels
    one, other = (r.simulation_params(r.nominal(), None, 3) for r in (old_pair, pair))
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_a_robot_of_a_loop_keeps_the_contract(old_turntable):
    checked(old_turntable, "here")
    testing.check_identification(old_turntable)
    testing.check_simulation(old_turntable)


def test_a_robot_of_a_loop_starts_where_it_is_moved_to_and_has_its_own_aim(old_turntable):
    nodes, task = old_turntable.training(old_turntable.nominal(), {}, {}, False)
    assert set(nodes) == {"sensor", "agent", "actuator", "world"}
    task.start = (0.3, 0.0)
    starts = np.array([task.params(jax.random.key(i))["world"].start for i in range(8)])
    assert 0.1 < np.abs(starts[:, 0]).max() <= 0.3
    assert not starts[:, 1].any()
    start = old_turntable.drive.measured_start(None, old_turntable.task.at_rest(2))
    assert float(old_turntable.agent.params(start, None).aim[0]) == 6.0
