"""A rig of two legs in memory, with columns and parts: soft stops, repeated samples, and parts."""

import math

import numpy as np
import pytest
from virtual_bus import IdleDevice

from sim2real.errors import SafetyStop
from sim2real.hardware.device import (
    CommandColumn,
    CommandKind,
    Counters,
    Reading,
    ReadingPart,
    Transaction,
)
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

N, DAMPING = 2, 3.0
COLUMNS = (
    CommandColumn("q", "rad", "hold"),
    CommandColumn("dq", "rad/s", "zero"),
    CommandColumn("kp", "N m/rad", "zero"),
    CommandColumn("kd", "N m s/rad", DAMPING),
    CommandColumn("tau", "N m", "zero"),
)
LOW, HIGH = np.tile([-1.5, -20.0, 0.0, 0.0, -20.0], (N, 1)), np.tile([1.5, 20.0, 100.0, 5.0, 20.0], (N, 1))


class Legs(IdleDevice):
    """Two joints of inertia 0.1 kg m2 without gravity, whose motors are controllers; a sample each 2 ms."""

    motors = ("FR_hip", "FL_hip")
    commanded = CommandKind.of_columns("controllers", *COLUMNS)
    silence_s, counters = 0.0, Counters()
    load_unit = "N m"
    parts = {"quaternion": ReadingPart("1", (4,), norm=(0.9, 1.1)), "gyro": ReadingPart("rad/s", (3,), -50.0, 50.0)}  # noqa: RUF012

    def __init__(self, period_s=0.002):
        self.period_s, self.begin_s, self.heard = period_s, 1e-9 * self.clock.now_ns(), []
        self.position, self.speed, self.quaternion = np.array([0.2, -0.1]), np.zeros(N), np.array([1.0, 0, 0, 0])

    def without_host(self):
        return ()

    def reach(self):
        return LOW, HIGH

    def enable(self):
        return np.stack([self.position, *np.zeros((4, N))], axis=-1)

    def command(self, values):
        self.heard.append(np.array(values))
        return Transaction(self.clock.now_ns(), 0, 0, 0)

    def measure(self):
        tick = int((1e-9 * self.clock.now_ns() - self.begin_s) / self.period_s)
        q, dq, kp, kd, tau = self.heard[-1].T if self.heard else np.zeros((5, N))
        torque = kp * (q - self.position) + kd * (dq - self.speed) + tau
        self.speed = self.speed + 0.002 * torque / 0.1
        self.position = self.position + 0.002 * self.speed
        stamp = Transaction(round(1e9 * (self.begin_s + tick * self.period_s)), 0, 0, 0)
        parts = {"quaternion": self.quaternion, "gyro": np.array([0.1, 0.2, 0.3])}
        return Reading(self.position, self.speed, torque, stamp, parts, tick)


def gate(**limits):
    slew = (2.0, math.inf, math.inf, math.inf, math.inf)
    given = {"slew_per_s": slew, "command_timeout_s": 5.0, "max_speed_rad_s": 30.0, "stop_s": 0.4, **limits}
    return GateConfig((LOW.tolist(), HIGH.tolist()), stale=Legs.commanded.stale, **given)


def standing(kp=40.0):
    return np.tile([0.0, 0.0, kp, 1.0, 0.0], (N, 1))


def test_a_soft_stop_fades_each_column_to_what_replaces_a_stale_one():
    device = Legs()
    with Rig(device, gate()) as rig:
        rig.start()
        rig.command(standing(), 0.0, 1e-9 * rig.clock.now_ns())
        rig.ease()
        end = 1e-9 * rig.clock.now_ns() + 5.0
        while not rig.eased and 1e-9 * rig.clock.now_ns() < end:
            rig.command(standing(), 0.0, 1e-9 * rig.clock.now_ns())
            rig.measure()
            rig.clock.sleep(0.005)
        assert rig.eased
    heard = np.array([sent for sent in device.heard if sent[0, 2] > 0.0])
    assert len({*heard[:, 0, 2].tolist()}) > 3
    assert np.all(np.diff(heard[:, :, 2], axis=0) <= 0.0)
    assert np.all(np.diff(heard[:, :, 3], axis=0) >= 0.0)
    np.testing.assert_allclose(device.heard[-1][:, 1:], np.tile([0.0, 0.0, DAMPING, 0.0], (N, 1)), atol=1e-9)


def test_a_sample_that_was_read_before_keeps_its_stamp_and_is_not_checked_again():
    device = Legs(period_s=1e6)
    with Rig(device, gate(max_sample_age_s=0.05)) as rig:
        rig.start()
        first = rig.measure()
        device.quaternion = np.zeros(4)
        assert rig.measure().transaction.t_sent_ns == first.transaction.t_sent_ns
        # A device that repeats one sample for ever has stopped measuring.
        rig.clock.sleep(0.1)
        with pytest.raises(SafetyStop, match="newest measurement"):
            rig.require_fresh()


def test_a_part_that_is_not_possible_stops_the_rig():
    device = Legs()
    with Rig(device, gate()) as rig:
        device.quaternion = np.zeros(4)
        with pytest.raises(SafetyStop, match="'quaternion' of the reading has the norm 0"):
            rig.measure()
