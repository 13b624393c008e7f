"""Mountings of joints: whatever zero, direction and gear are between joint and motor, joints move and stop the same."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual_bus import IdleDevice

from sim2real.emulation.plant import MountedPlant
from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.device import POSITION, VOLTAGE, CommandKind, Counters, OperatingMode, Reading, Transaction
from sim2real.hardware.joint import Joint, Mounting
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

STEP_S, N = 0.02, 2
PLAIN = ((0.0, 1, 1.0),) * N
VELOCITY, TORQUE = CommandKind("velocities", "rad/s", "zero"), CommandKind("torques", "N m", "zero")
DUTY = CommandKind("duties", "1", "zero")
KINDS = (POSITION, VOLTAGE, DUTY, VELOCITY, TORQUE)

mounting = st.tuples(st.floats(-2.0, 2.0), st.sampled_from([1, -1]), st.sampled_from([0.5, 1.0, 2.0, 3.0, 7.3]))
mountings = st.tuples(*[mounting] * N)


class Bench(IdleDevice):
    """Two motors in memory; their joints are known to the test, which writes the mounting down once more.

    A command accelerates its joint, or pulls it to its angle. Everything on this side is the motors'.
    """

    motors = tuple(f"motor {i}" for i in range(N))
    commanded, silence_s, counters = POSITION, 0.0, Counters()

    def __init__(self, kind, rows, reach=(-50.0, 50.0), leap_at=None):
        self.commanded, self.zero, self.direction, self.gear = kind, *np.array(rows, float).T
        self.joint, self.speed = np.array([0.3, -0.2]), np.zeros(N)
        self.joint_reach, self.leap_at = reach, leap_at
        self.steps, self.heard = 0, []

    def to_motor(self, joint):
        if self.commanded is POSITION:
            return self.zero + self.direction * self.gear * joint
        if self.commanded is VELOCITY:
            return self.direction * self.gear * joint
        return self.direction * joint / (self.gear if self.commanded is TORQUE else 1.0)

    def to_joint(self, motor):
        if self.commanded is POSITION:
            return self.direction * (motor - self.zero) / self.gear
        if self.commanded is VELOCITY:
            return self.direction * motor / self.gear
        return self.direction * motor * (self.gear if self.commanded is TORQUE else 1.0)

    def without_host(self):
        return ()

    def reach(self):
        ends = [self.to_motor(np.full(N, end)) for end in self.joint_reach]
        return np.minimum(*ends), np.maximum(*ends)

    def enable(self):
        return self.to_motor(self.joint if self.commanded is POSITION else np.zeros(N))

    def command(self, values):
        self.heard.append(np.array(values))
        return Transaction(0, 0, 0, 0)

    def measure(self):
        told = self.to_joint(self.heard[-1]) if self.heard else np.zeros(N)
        pull = 20.0 * (told - self.joint) if self.commanded is POSITION else 3.0 * told
        self.steps += 1
        self.speed = self.speed + STEP_S * (pull - 4.0 * self.speed)
        self.joint = self.joint + STEP_S * self.speed
        shown = self.joint + (3.0 if self.steps == self.leap_at else 0.0)
        turns = self.direction * self.gear
        return Reading(
            self.zero + turns * shown,
            turns * self.speed,
            self.direction * (told - 0.1),
            Transaction(round(1e9 * STEP_S * self.steps), 0, 0, 0),
        )


def as_joints(rows):
    return [Joint(f"joint{i}", *row) for i, row in enumerate(rows)]


def gate_of(kind, **limits):
    given = {"limit": ((-0.9, -1.4), (1.1, 0.7)), "slew_per_s": 13.7, "max_speed_rad_s": (2.0, 1.5)}
    return GateConfig(**{**given, "command_timeout_s": 10.0, "first_step_rad": np.inf, "stale": kind.stale, **limits})


def timeline(device, rows, gate, wanted):
    """Play commands of the joints; return all that a robot and its log see of it, up to what stopped it."""
    seen, stopped = [], ""
    with Rig(device, gate, as_joints(rows)) as rig:
        rig.start()
        rig.clock.sleep(0.001)  # the watchdog sends what is safe, once
        try:
            for step, command in enumerate(wanted):
                reading = rig.measure()
                allowed = rig.command(command, 0.0, STEP_S * step)
                seen.append(np.concatenate([reading.position_rad, reading.velocity_rad_s, reading.load, allowed]))
        except SafetyStop as stop:
            stopped = str(stop)
        return np.array(seen), stopped, rig.gate.counts


def compare(kind, rows, wanted, gate=None, **device):
    gate = gate or gate_of(kind)
    plain, why, counts = timeline(Bench(kind, PLAIN, **device), PLAIN, gate, wanted)
    other, too, their_counts = timeline(Bench(kind, rows, **device), rows, gate, wanted)
    assert counts == their_counts
    np.testing.assert_allclose(other, plain, atol=1e-9)
    assert (why == "") == (too == "")
    return plain, why, counts


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
@settings(max_examples=12, deadline=None)
@given(rows=mountings, seed=st.integers(0, 2**31))
def test_a_mounting_changes_nothing_that_is_seen_of_the_joints(kind, rows, seed):
    """Slow and fast commands, some beyond the limits: angles, speeds, loads, what is sent, and what the gate cut."""
    random = np.random.default_rng(seed)
    wanted = np.cumsum(random.normal(0.0, 0.25, (40, N)), axis=0)
    plain, why, counts = compare(kind, rows, wanted, gate_of(kind, max_speed_rad_s=(30.0, 30.0)))
    assert not why
    assert counts.passed == 40
    sent = plain[:, -N:]
    assert np.all((sent >= [-0.9, -1.4]) & (sent <= [1.1, 0.7]))


@settings(max_examples=10, deadline=None)
@given(rows=mountings)
def test_a_joint_that_is_too_fast_is_stopped_whatever_its_gear(rows):
    seen, why, _ = compare(VOLTAGE, rows, np.full((60, N), [1.1, 0.0]), gate_of(VOLTAGE, max_speed_rad_s=0.5))
    assert "joint 'motor 0' is beyond the limit of 0.5 rad/s" in why
    assert 0.3 < seen[-1, N] < 0.5


@settings(max_examples=10, deadline=None)
@given(rows=mountings)
def test_a_leap_of_a_joint_is_one_whatever_its_gear(rows):
    seen, why, _ = compare(VOLTAGE, rows, np.zeros((20, N)), leap_at=8)
    assert "joint 'motor 1' reads 2.8 rad, 3 rad from the last reading" in why
    assert len(seen) == 7


@settings(max_examples=30, deadline=None)
@given(rows=mountings, kind=st.sampled_from(KINDS))
def test_a_gate_is_refused_for_the_joints_that_a_plain_one_would_be_refused_for(rows, kind):
    """What the motors take is turned round with them: the low end is the joint's."""
    joints = as_joints(rows)
    for low, high in ((-0.9, 1.0), (-1.0, 1.1)):
        with pytest.raises(UsageError, match=r"exceeds the reach of the motors, \[-0\.9.* to \[1\.0"):
            Rig(Bench(kind, rows, reach=(-0.9 - 1e-9, 1.0 + 1e-9)), gate_of(kind, limit=(low - 0.01, high)), joints)
    Rig(Bench(kind, rows, reach=(-0.9 - 1e-9, 1.0 + 1e-9)), gate_of(kind, limit=(-0.9, 1.0)), joints).close()


def test_a_stale_command_is_held_or_zero_at_the_joints():
    rows = ((0.4, -1, 3.0), (-0.2, 1, 0.5))
    for kind, expected in ((POSITION, [0.5, -0.4]), (VOLTAGE, [0.0, 0.0])):
        device = Bench(kind, rows)
        with Rig(device, gate_of(kind, slew_per_s=None), as_joints(rows)) as rig:
            rig.start()
            rig.command(np.array([0.5, -0.4]), 0.0, 0.0)
            np.testing.assert_allclose(rig.command(np.array([0.1, 0.1]), 99.0, 0.1), expected)
            np.testing.assert_allclose(device.heard[-1], device.to_motor(np.array(expected)))


def test_torques_and_loads_in_newton_metres_grow_by_the_gear():
    class Torques(Bench):
        load_unit = "N m"

    device = Torques(TORQUE, PLAIN)
    mounting = Mounting(as_joints([(0.5, -1, 4.0), (0.0, 1, 0.5)]), device)
    np.testing.assert_allclose(mounting.to_motors(np.array([2.0, 2.0])), [-0.5, 4.0])
    np.testing.assert_allclose(mounting.to_joints(np.array([-0.5, 4.0])), [2.0, 2.0])
    reading = Reading(np.array([0.5, 1.0]), np.array([4.0, 1.0]), np.array([-0.5, 4.0]), Transaction(0, 0, 0, 0))
    joint = mounting.reading(reading)
    np.testing.assert_allclose(
        [joint.position_rad, joint.velocity_rad_s, joint.load], [[0.0, 2.0], [-1.0, 2.0], [2.0, 2.0]]
    )


def test_a_plain_joint_changes_no_bit():
    device = Bench(POSITION, PLAIN)
    values = np.random.default_rng(0).normal(size=N)
    for joints in ((), as_joints(PLAIN)):
        mounting = Mounting(joints, device)
        assert np.array_equal(mounting.to_motors(values), values)
        assert np.array_equal(mounting.to_joints(values), values)
        reading = mounting.reading(Reading(values, values, np.array([np.nan, 1.0]), Transaction(0, 0, 0, 0)))
        assert np.array_equal(reading.position_rad, values)
        assert np.array_equal(reading.load, [np.nan, 1.0], equal_nan=True)


def test_joints_that_do_not_fit_the_device_are_refused_before_it_is_opened():
    class Unopened(Bench):
        def open(self):
            raise AssertionError("it was opened")

    with pytest.raises(UsageError, match=r"there are 1 joints \(elbow\) for 2 motors"):
        Rig(Unopened(VOLTAGE, PLAIN), gate_of(VOLTAGE), [Joint("elbow")])
    odd = CommandKind("flows", "l/s", "zero")
    Rig(Bench(odd, PLAIN), gate_of(odd), as_joints(PLAIN)).close()
    with pytest.raises(UsageError, match=r"flows in 'l/s' cannot be converted.*Units: rad, rad/s, N m"):
        Rig(Unopened(odd, PLAIN), gate_of(odd), [Joint("a"), Joint("b", gear=2.0)])


class Flywheels:
    """A plant in memory that keeps what it was told."""

    servo_ids = (4, 7)

    def __init__(self, start):
        self.start, self.told = start, []

    def advance(self, t_s):
        self.told.append(("advance", t_s))

    def command(self, servo_id, mode, goal):
        self.told.append((servo_id, mode, goal))

    def configure(self, servo_id, p_gain, d_gain, profile_velocity_rad_s):
        self.told.append((servo_id, p_gain, d_gain, profile_velocity_rad_s))

    def measure(self, servo_id):
        return self.start[servo_id - 4], 2.0, 0.5

    def state(self):
        return {"q": 1.0}

    def truth(self):
        return {"friction": 3.0}


def test_a_mounted_plant_is_seen_through_its_encoders():
    centre = np.pi
    joints = [Joint("a", zero_rad=0.3, direction=-1, gear=2.0), Joint("b", gear=0.5)]
    start = [centre + 0.4, 0.0, 0.0, centre - 1.0]
    plant = MountedPlant(Flywheels(start), joints, centre)
    assert plant.servo_ids == (4, 7)
    np.testing.assert_allclose(plant.measure(4), [centre + 0.3 - 0.8, -4.0, -0.5])
    np.testing.assert_allclose(plant.measure(7), [centre - 0.5, 1.0, 0.5])
    plant.command(4, OperatingMode.POSITION, plant.measure(4)[0])
    plant.command(4, OperatingMode.VELOCITY, 3.0)
    plant.command(4, OperatingMode.PWM, 0.7)
    plant.command(7, OperatingMode.OFF, 0.0)
    plant.configure(4, 800, 0, 5.0)
    plant.configure(7, 800, 0, np.inf)
    plant.advance(0.1)
    told = plant._plant.told
    np.testing.assert_allclose([goal for _, _, goal in told[:4]], [centre + 0.4, -1.5, -0.7, 0.0])
    assert [row[:3] for row in told[4:6]] == [(4, 800, 0), (7, 800, 0)]
    assert [row[3] for row in told[4:6]] == [2.5, np.inf]
    assert told[-1] == ("advance", 0.1)
    assert (plant.state(), plant.truth()) == ({"q": 1.0}, {"friction": 3.0})
    with pytest.raises(UsageError, match="1 joints are mounted on 2 servos"):
        MountedPlant(Flywheels(start), joints[:1], centre)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"direction": 0}, "neither 1 nor -1"), ({"gear": -2.0}, "not a number above 0"), ({"gear": 0.0}, "above 0"),
     ({"zero_rad": float("nan")}, "not a finite angle")],
)  # fmt: skip
def test_what_cannot_be_converted_is_refused(wrong, said):
    with pytest.raises(UsageError, match=f"joint 'elbow'.*{said}"):
        Joint("elbow", **wrong)


def test_a_name_stands_for_a_joint_that_turns_with_its_encoder():
    assert Joint.of("hinge") == Joint("hinge", 0.0, 1, 1.0)
    assert Joint.of("hinge").is_plain
    assert not any(joint.is_plain for joint in (Joint("a", gear=2.0), Joint("a", 0.1), Joint("a", direction=-1)))
