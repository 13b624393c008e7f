"""A control process that dies or hangs: the guardian lets the legs damp, then takes their torque off."""

import signal
import socket
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
from unitree_bench import CONTROLS, DAMPS, OFF, emulated, ways

from sim2real.emulation.truth import Kind
from sim2real.hardware.safety.guardian_process import BEAT, REST, Guard
from sim2real.log.reader import read_log

pytestmark = pytest.mark.process

HOST = """
import sys, jax, numpy as np
from sim2real.errors import Sim2RealError
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig
from sim2real.hardware.unitree.device import UnitreeLegs
from sim2real.hardware.unitree.legs import LegDrive
from sim2real.log.writer import McapRecorder
from sim2real.robots.nodes import Excitation, ServoActuator, ServoSensor
from sim2real.robots.loop import control_nodes
from sim2real.robots.messages import Goals
from sim2real.robots.walking.drive import BodySensor
from sim2real.robots.walking.messages import leg_command
from sim2real.runtime.asynchronous import AsyncGraph
from pipelines.go2.plant import LYING

device = UnitreeLegs({port!r}, drive=LegDrive(lie_s=3.0), silence_s=0.6, max_silence_s=1.0)
low, high = device.reach()
gate = GateConfig((low.tolist(), high.tolist()), stale=device.commanded.stale, command_timeout_s=2.0)
body = BodySensor(device.motors, np.array(LYING))

# It stands up within 0.6 s.
stood = np.clip(np.arange(3000) / 30.0, 0.0, 1.0)[:, None]
goals = LYING + stood * (np.array([0.0, 0.8, -1.5] * 4) - LYING)

with Rig(device, gate) as rig:
    sensor = ServoSensor(SENSOR, 50.0, rig, body.read, body.at_rest, delay=0.002)
    player = Excitation(AGENT, 50.0, goals, Goals, delay=0.002)
    actuator = ServoActuator(ACTUATOR, 50.0, rig, "goal", lambda q: leg_command(q, 60.0, 4.0), delay=0.002)
    graph = AsyncGraph(control_nodes(sensor, player, actuator), player)
    state = graph.init(jax.random.key(0), {{}})
    graph.warmup(state)
    inputs = [(name, i) for name, node in graph.nodes.items() for i in node.inputs]
    graph.recorder = McapRecorder({log!r}, {{}}, {{}}, state.aux["outputs"], inputs, {{}}, {{}})
    rig.start()
    graph.start(state)
    print("on", flush=True)
    try:
        graph.run_for(60.0)
    except Sim2RealError as error:
        rig.close()
        print(error, flush=True)
        sys.exit(error.exit_code)
"""


@pytest.mark.night
@pytest.mark.parametrize(
    "number",
    [
        pytest.param(signal.SIGKILL, id="killed"),
        # `make test` stops the control process of a servo in test_guardian.py.
        pytest.param(signal.SIGSTOP, id="stopped", marks=pytest.mark.night),
    ],
)
def test_a_robot_that_stands_sinks_before_its_motors_switch_off(tmp_path, number):
    robot, log = emulated(tmp_path / "truth.bin"), tmp_path / "log.mcap"
    code = HOST.format(port=robot.port, log=str(log))
    host = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert host.stdout.readline() == "on\n", host.stderr.read()
    time.sleep(1.2)
    end_ns = time.monotonic_ns()
    host.send_signal(number)
    if number == signal.SIGSTOP:
        time.sleep(1.0)
        host.send_signal(signal.SIGCONT)
    # The guardian holds the other end of stderr, until it ends.
    said, errors = host.communicate(timeout=20)
    # The motors were driven, damped, and switched off; in this order, once each.
    found, since_ns = ways(robot)
    assert found[-3:] == [CONTROLS, DAMPS, OFF]
    damped_s, off_s = (since_ns[-2:] - end_ns) * 1e-9
    assert 0.0 < damped_s < (0.3 if number == signal.SIGKILL else 1.0)
    assert off_s > damped_s + 0.3
    # It sinks more slowly than it falls, and lies when the torque goes off.
    t_ns, states = robot.truth().states()
    height, sinking = states["base[2]"], t_ns > end_ns
    assert height[~sinking][-1] > 0.25
    assert np.gradient(height, 1e-9 * t_ns)[sinking].min() > -1.0
    assert height[t_ns < since_ns[-1]][-1] < 0.12
    last = {int(row["servo_id"]): row["values"][0] for row in robot.truth().of(Kind.EFFECT)}
    assert last == dict.fromkeys(range(12), 0.0)
    reason = "the control process is gone" if number == signal.SIGKILL else "the control process was silent"
    assert f"sim2real guardian: {reason}" in errors
    assert "torque is off, confirmed after" in errors
    if number == signal.SIGSTOP:
        assert host.returncode == 3, (said, errors)
    # The log holds what was measured until then.
    with warnings.catch_warnings(action="ignore"):  # it has no end
        outputs = read_log(log).outputs
    assert len(outputs["sensor"]["quaternion"]) > 20
    np.testing.assert_allclose(outputs["actuator"]["kp"][-1], np.full(12, 60.0))


@pytest.mark.parametrize(("last", "acts"), [(BEAT, ["the control process is gone"]), (REST, [])])
def test_a_robot_whose_torque_was_off_may_have_another_master(last, acts):
    """The death of the control process counts for legs only while their torque is on."""

    class Watch(Guard):
        at_rest = False
        acted = ()

        def make_safe(self, reason):
            self.acted = [*self.acted, reason]
            return True

    link, other = socket.socketpair()
    with link, other:
        guard = Watch()
        other.send(BEAT)
        other.send(last)
        other.shutdown(socket.SHUT_WR)
        guard.watch(link.fileno(), 0.0)
        assert list(guard.acted) == acts
