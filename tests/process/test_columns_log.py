"""A robot with columns and parts, in a graph on the wall clock: the log has each of them."""

import jax
import numpy as np
import pytest
from flax import struct
from test_columns_rig import COLUMNS, Legs, N, gate

from sim2real.graph.base import Base
from sim2real.hardware.clock import SYSTEM_CLOCK
from sim2real.hardware.safety.rig import Rig
from sim2real.log.reader import read_log
from sim2real.log.writer import McapRecorder
from sim2real.robots.loop import ACTUATOR, AGENT, SENSOR, control_nodes
from sim2real.robots.messages import Goals
from sim2real.robots.nodes import Excitation, ServoActuator, ServoSensor
from sim2real.robots.walking.drive import BodySensor
from sim2real.runtime.asynchronous import AsyncGraph

pytestmark = pytest.mark.process
UNITS = {column.name: column.unit for column in COLUMNS}


@struct.dataclass
class JointCommands(Base):
    """A command for motors that add a controller's torque and a torque: ``kp (q - position) + kd (dq - speed) + tau``.

    Attributes:
        q: Shape ``(joints,)`` [rad].
        dq: Shape ``(joints,)`` [rad/s].
        kp: Shape ``(joints,)`` [N m/rad].
        kd: Shape ``(joints,)`` [N m s/rad].
        tau: Shape ``(joints,)`` [N m].
    """

    q: jax.Array
    dq: jax.Array
    kp: jax.Array
    kd: jax.Array
    tau: jax.Array


class RealLegs(Legs):
    """They live in real time."""

    clock = SYSTEM_CLOCK


def test_the_log_has_every_part_and_every_column_with_its_unit(tmp_path):
    """The nodes of a robot on hardware, in a graph on the wall clock: what they send is in the log by name."""
    device, log = RealLegs(), tmp_path / "log.mcap"
    body = BodySensor(device.motors, np.zeros(N))

    def controllers(goal):
        return JointCommands(goal, np.zeros(N), np.full(N, 200.0), np.full(N, 1.0), np.zeros(N))

    with Rig(device, gate()) as rig:
        sensor = ServoSensor(SENSOR, 50.0, rig, body.read, body.at_rest, delay=0.002)
        player = Excitation(AGENT, 50.0, np.zeros((20, N)), Goals, delay=0.002)
        actuator = ServoActuator(ACTUATOR, 50.0, rig, "goal", controllers, delay=0.002)
        graph = AsyncGraph(control_nodes(sensor, player, actuator), player)
        state = graph.init(jax.random.key(0), {})
        graph.warmup(state)
        inputs = [(name, i) for name, node in graph.nodes.items() for i in node.inputs]
        units = {name: {**body.units, **UNITS} for name in graph.nodes}
        graph.recorder = McapRecorder(log, {}, {}, state.aux["outputs"], inputs, {}, units)
        graph.start(state)
        graph.run_for(0.4)
        graph.stop()
        graph.recorder.close("finished", 0, {})
    outputs = read_log(log).outputs
    found = read_log(log).units
    assert found[SENSOR]["gyro"] == "rad/s"
    assert UNITS.items() <= found[ACTUATOR].items()
    np.testing.assert_allclose(outputs[SENSOR]["gyro"][-1], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(outputs[SENSOR]["quaternion"][-1], [1.0, 0.0, 0.0, 0.0])
    # The gate's limit of 100 N m/rad is in the log, and on the motors.
    np.testing.assert_allclose(outputs[ACTUATOR]["kp"][-1], [100.0, 100.0])
    assert any(np.all(sent[:, 2] == 100.0) for sent in device.heard)
