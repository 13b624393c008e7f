"""A pendulum that friction holds upright is pushed over, under the gate's limits, in virtual time."""

import pytest
from plants import FirstOrder

from sim2real.emulation.bus import VirtualRobot
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.errors import SafetyStop
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import VoltageDrive
from sim2real.hardware.dynamixel import DynamixelServos
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig
from sim2real.stages.load import load_robot

"""It turns at 1.8 rad/s under the push, and stays where it is without torque."""


@pytest.mark.parametrize(
    ("gate", "noun"),
    [
        ({"max_speed_rad_s": 1.0}, "limit of 1 rad/s"),
        ({"envelope_rad": (-0.1, 0.1)}, "envelope"),
        ({}, "does not hang down after 5 pushes"),
    ],
)
def test_a_push_is_measured_and_its_reason_is_kept(gate, noun):
    robot = VirtualRobot(FirstOrder(), EmulatorConfig())
    device = DynamixelServos(BusConfig(robot.port, silence_s=1.0), [1], VoltageDrive(5.0))
    with Rig(device, GateConfig(2.0, **gate)) as rig:
        with pytest.raises(SafetyStop, match=noun):
            load_robot("pendulum").drive.prepare(rig, 2.0)
        assert robot.bus.servos[1].get(reg.TORQUE_ENABLE) == 0
