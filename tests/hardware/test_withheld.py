"""A dry run: the rig does all that it does, and the device is measured only."""

import numpy as np
import pytest
from families import ANGLES, VOLTS

from sim2real.emulation.truth import Kind
from sim2real.errors import UsageError
from sim2real.hardware import dynamixel as reg

START_RAD = np.array([0.5, -0.8, 0.3])


def test_positions_start_where_the_joints_are_and_pass_the_gate():
    robot = ANGLES.robot("Joints")
    with ANGLES.rig(robot, {"limit": 1.0, "slew_per_s": 2.0, "first_step_rad": np.inf}) as rig:
        rig.withhold_torque()
        rig.start()
        assert rig.gate.fallback == pytest.approx(START_RAD, abs=reg.RAD_PER_COUNT)
        rig.clock.sleep(0.6)  # the looks for servos that have lost their settings must find them as they should be
        rig.measure()
        begin = 1e-9 * rig.clock.now_ns()
        sent = [rig.command(np.array([0.5, -3.0, 0.3]), 0.0, begin + 0.02 * k) for k in range(20)]
        rig.measure()
        np.testing.assert_allclose(sent[-1], [0.5, -1.0, 0.3], atol=1e-2)
        assert (rig.gate.counts.passed, rig.gate.counts.clamped) == (20, 20)
        rig.stop()
    robot.stop()
    assert robot.truth().of(Kind.EFFECT).size == 0


def test_torque_that_is_on_cannot_be_withheld():
    robot = VOLTS.robot()
    with VOLTS.rig(robot) as rig:
        rig.start()
        with pytest.raises(UsageError):
            rig.withhold_torque()
    robot.stop()
