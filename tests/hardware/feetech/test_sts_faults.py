"""What goes wrong on the bus, or with the process that controls it: the torque ends off, and the error says why."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.errors import SafetyStop, Sim2RealError
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.calibration import CalibratedJoint as Joint


def drive(device, for_s=0.15):
    """Move a little, as a stage does; return the error that ended it, or None."""
    end_ns = device.clock.now_ns() + 1e9 * for_s
    rest = device.rest()
    try:
        while (now_ns := device.clock.now_ns()) < end_ns:
            device.measure()
            device.command(rest + 0.4 * np.sin(20e-9 * now_ns))
            device.clock.sleep(0.005)
    except Sim2RealError as error:
        return error
    return None


def test_a_cable_that_comes_back(serve, connect):
    """Nothing arrives while it is out, and the servos go on by themselves; the guardian goes on trying."""
    robot = serve()
    device = connect(robot, silence_s=0.1)
    device.enable()
    drive(device)
    robot.strike(silent_after_s=0.0)
    robot.kill_host()
    assert [servo.get(reg.TORQUE_ENABLE) for servo in robot.bus.servos.values()] == [1, 1, 1]
    assert "could NOT be confirmed" in robot.reports[0]


def test_a_cable_that_comes_back_in_time(serve, connect, monkeypatch):
    robot = serve()
    device = connect(robot, silence_s=0.1)
    device.enable()
    drive(device)
    robot.strike(silent_after_s=0.0)
    back_ns, run_until = robot.now_ns() + 3_000_000_000, robot.bus.run_until

    def plug_in(t_ns):
        if t_ns > back_ns:
            robot.bus._config = replace(robot.bus._config, silent_after_s=None)
        run_until(t_ns)

    monkeypatch.setattr(robot.bus, "run_until", plug_in)
    robot.kill_host()
    assert [servo.get(reg.TORQUE_ENABLE) for servo in robot.bus.servos.values()] == [0, 0, 0]
    assert "is gone: torque is off, confirmed after 30" in robot.reports[0]


ALARMS = {"input voltage": 1, "encoder": 2, "overheating": 4, "overcurrent": 8, "overload": 32}


@pytest.mark.parametrize("bits", ALARMS.values(), ids=ALARMS)
def test_an_alarm_is_named(serve, connect, bits):
    robot = serve()
    device = connect(robot)
    device.enable()
    drive(device)
    robot.bus.servos[2].put(reg.STATUS, bits)
    error = drive(device)
    assert isinstance(error, SafetyStop)
    (name,) = (name for name, mask in ALARMS.items() if mask == bits)
    assert f"servo 2 reports an alarm: {name}" in str(error)
    device.close()
    assert [servo.get(reg.TORQUE_ENABLE) for servo in robot.bus.servos.values()] == [0, 0, 0]


def test_a_gear_and_a_direction(serve, connect):
    robot = serve("Joints", ids=[1, 2, 3], start_rad=[0.5, -0.8, 0.3])
    joints = [
        Joint("a", 1, direction=-1),
        Joint("b", 2, gear=0.5),
        Joint("c", 3, zero_count=2148),
    ]
    device = connect(robot, joints=joints)
    expected = [-0.5, -0.4, 0.3 - 100 * reg.RAD_PER_COUNT]
    assert device.measure().position_rad == pytest.approx(expected, abs=reg.RAD_PER_COUNT)
    device.enable()
    assert device.rest() == pytest.approx(expected, abs=reg.RAD_PER_COUNT)
