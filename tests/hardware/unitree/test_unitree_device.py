"""The legs of a robot that behaves, what is refused, and other programs on its topics; over DDS."""

import math

import numpy as np
import pytest

pytest.importorskip("cyclonedds")
from unitree_bench import CONTROLS, DAMPS, OFF, ways

from pipelines.go2.plant import LYING, Go2Body
from sim2real.emulation.legs import UnitreeEmulation, VirtualLegs
from sim2real.errors import HardwareLost, SafetyStop, UsageError
from sim2real.hardware.registry import load_device
from sim2real.hardware.unitree import legs
from sim2real.hardware.unitree.dds import Address, connect
from sim2real.hardware.unitree.device import UnitreeLegs
from sim2real.hardware.unitree.legs import LegDrive

MIXED = (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)


@pytest.fixture
def robot(tmp_path, request):
    body = Go2Body(getattr(request, "param", "floor"))
    served = VirtualLegs(body, UnitreeEmulation(), tmp_path / "truth.bin")
    yield served
    served.stop()


@pytest.fixture
def device(robot):
    """The device, not opened."""
    made = UnitreeLegs(robot.port, MIXED, LegDrive(lie_s=1.0), silence_s=0.6, max_silence_s=0.5)
    yield made
    made.close()


@pytest.fixture
def other(robot):
    """Another program on the robot's topics."""
    link = connect(Address.parse(robot.port), "another program")
    yield link
    link.close()


def run(device, command, seconds, each=lambda: None):
    """Command and measure."""
    end_ns = device.clock.now_ns() + round(1e9 * seconds)
    while device.clock.now_ns() < end_ns:
        device.command(command)
        each()
        device.measure()


@pytest.mark.parametrize("robot", ["stand"], indirect=True)
def test_joints_in_another_order_move_and_are_measured(robot, device):
    device.open()
    facts = device.facts()
    assert (facts["firmware"], facts["voltage"]) == ({"battery": "1.4"}, {"battery": "29.6 V"})
    assert facts["temperature"] == dict.fromkeys(device.motors, "35 °C")
    device.enable()
    goal = np.tile([0.0, 0.0, 60.0, 3.0, 0.0], (12, 1))
    goal[:, 0] = LYING
    run(device, goal, 0.6)
    start, begin_ns = device.measure().position_rad, device.clock.now_ns()
    goal[1, 0] -= 0.5
    run(device, goal, 0.6)
    end_ns = device.clock.now_ns()
    reading = device.measure()
    moved = np.flatnonzero(np.abs(reading.position_rad - start) > 0.25)
    assert moved.tolist() == [1]
    assert device.motors[1] == "FL_thigh"
    assert reading.parts["battery_voltage"] == pytest.approx(29.6)
    assert reading.parts["temperature"].tolist() == [35.0] * 12
    np.testing.assert_allclose(reading.parts["accelerometer"], [0, 0, 9.81], atol=0.5)
    assert device.without_host()[0].endswith("goes on as commanded last (no other reaction is documented)")
    device.disable()
    with pytest.raises(SafetyStop, match="the torque is off"):
        device.command(goal)
    assert ways(robot)[0] == [DAMPS, CONTROLS, DAMPS, OFF]
    # It is the fifth motor of the messages.
    t_ns, states = robot.truth().states()
    meanwhile = (t_ns > begin_ns) & (t_ns < end_ns)
    assert max(range(12), key=lambda i: np.ptp(states[f"position[{i}]"][meanwhile])) == 4


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [(0, 2.0, r"FL_hip: q = 2 is outside \[-1.0472"), (2, -1.0, "kp = -1"), (4, math.nan, "tau = nan")],
)
def test_a_command_beyond_the_reach_is_not_sent(column, value, words):
    device = UnitreeLegs("lo:0", MIXED)
    values = np.zeros((12, 5))
    values[:, 0] = LYING
    values[0, column] = value
    with pytest.raises(SafetyStop, match=words):
        device.command(values)


def stand(link):
    """Let a link command the motors until they are on."""
    standing = legs.command(np.stack([LYING, *np.tile([[0.0], [20.0], [1.0], [0.0]], 12)], axis=1))
    while not link.next_state(1.0).record["motor_state"]["mode"][0]:
        link.write(standing)


def test_another_program_is_refused_and_its_robot_stands_on(robot, device, other, monkeypatch):
    monkeypatch.setattr("sim2real.hardware.unitree.device.LEASE_S", -0.5)
    stand(other)
    with pytest.raises(HardwareLost, match="another program publishes rt/lowcmd: another program"):
        device.open()
    assert ways(robot)[0] == [CONTROLS]


def test_another_program_that_comes_later_stops_the_robot(robot, device):
    device.open()
    rest = device.enable()
    device.check()
    link = connect(Address.parse(robot.port), "")
    with pytest.raises(SafetyStop, match=r"publishes rt/lowcmd: .*follow both"):
        run(device, rest, 5.0, device.check)
    link.close()


def test_motors_that_switch_off_stop_the_robot(robot, device):
    device.open()
    rest = device.enable()
    link = connect(Address.parse(robot.port), "")
    with pytest.raises(SafetyStop, match=r"FL_calf.* took the torque off"):
        run(device, rest, 5.0, lambda: link.write(legs.off()))
    link.close()


def test_a_robot_that_was_left_on_is_laid_down_first(robot, device, other):
    stand(other)
    other.close()
    device.open()
    device.close()
    assert ways(robot)[0] == [CONTROLS, DAMPS, OFF]


def test_an_address_is_an_interface_and_a_domain():
    assert Address.parse("eth0") == Address("eth0", 0)
    assert 'address="192.168.123.99"' in Address.parse("192.168.123.99:3").config
    assert Address.parse(":4").config is None
    for domain in ("233", "x"):
        with pytest.raises(UsageError, match=f"'{domain}' is not a DDS domain"):
            UnitreeLegs(f"eth0:{domain}")
    with pytest.raises(UsageError, match="0 to 11, each once"):
        load_device("unitree")("lo:1", (1, 2), LegDrive(), baud_rate=0, silence_s=0.1)
    with pytest.raises(UsageError, match="at most kd_max = 2"):
        LegDrive(damping=5.0, kd_max=2.0)
