"""Mountings of joints: whatever zero, direction and gear are between joint and motor, joints move and stop the same."""

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual_bus import IdleDevice

from sim2real.emulation.plant import MountedPlant
from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.device import (
    POSITION,
    VOLTAGE,
    CommandColumn,
    CommandKind,
    Counters,
    OperatingMode,
    Reading,
    Transaction,
)
from sim2real.hardware.joint import Joint, Mounting
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

STEP_S, N, NEVER = 0.02, 2, Transaction(0, 0, 0, 0)
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
        return NEVER

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
                stale_s = 99.0 if step % 9 == 5 else 0.0
                allowed = rig.command(command, stale_s, STEP_S * step)
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
    assert (counts.passed, counts.stale) == (40, 4)
    sent = plain[:, -N:]
    assert np.all((sent >= [-0.9, -1.4]) & (sent <= [1.1, 0.7]))


@pytest.mark.parametrize(
    ("wanted", "gate", "device", "words"),
    [
        ([1.1, 0.0], {"max_speed_rad_s": 0.5}, {}, "joint 'motor 0' is beyond the limit of 0.5 rad/s"),
        ([0.0, 0.0], {}, {"leap_at": 8}, "joint 'motor 1' reads 2.8 rad, 3 rad from the last reading"),
    ],
    ids=["too fast", "leaps"],
)
@settings(max_examples=10, deadline=None)
@given(rows=mountings)
def test_what_stops_a_joint_stops_it_whatever_its_gear(wanted, gate, device, words, rows):
    seen, why, _ = compare(VOLTAGE, rows, np.full((60, N), wanted), gate_of(VOLTAGE, **gate), **device)
    assert words in why
    assert len(seen) == 7 if device else 0.3 < seen[-1, N] < 0.5


@settings(max_examples=30, deadline=None)
@given(rows=mountings, kind=st.sampled_from(KINDS))
def test_a_gate_is_refused_for_the_joints_that_a_plain_one_would_be_refused_for(rows, kind):
    """What the motors take is turned round with them: the low end is the joint's."""
    joints = as_joints(rows)
    for low, high in ((-0.9, 1.0), (-1.0, 1.1)):
        with pytest.raises(UsageError, match=r"exceeds the reach of the motors, \[-0\.9.* to \[1\.0"):
            Rig(Bench(kind, rows, reach=(-0.9 - 1e-9, 1.0 + 1e-9)), gate_of(kind, limit=(low - 0.01, high)), joints)
    Rig(Bench(kind, rows, reach=(-0.9 - 1e-9, 1.0 + 1e-9)), gate_of(kind, limit=(-0.9, 1.0)), joints).close()


CONTROLLERS = CommandKind.of_columns(
    "controllers",
    *(CommandColumn(n, u, "zero") for n, u in (("q", "rad"), ("kp", "N m/rad"), ("kd", "N m s/rad"))),
)


@pytest.mark.parametrize(
    ("kind", "joints", "motors"),
    [
        # The same torque acts on the joint: kp_joint * angle = gear * kp_motor * (gear * angle).
        (CONTROLLERS, [[0.5, 20.0, 1.0], [-0.5, 30.0, 1.0]], [[0.1 - 2.0 * 0.5, 5.0, 0.25], [-0.25, 120.0, 4.0]]),
        (TORQUE, [2.0, 2.0], [-1.0, 4.0]),
    ],
)
def test_columns_torques_and_loads_of_geared_joints(kind, joints, motors):
    device = SimpleNamespace(motors=("a", "b"), commanded=kind, load_unit="N m")
    mounting = Mounting([Joint("a", 0.1, -1, 2.0), Joint("b", gear=0.5)], device)
    np.testing.assert_allclose(mounting.to_motors(np.array(joints)), motors)
    np.testing.assert_allclose(mounting.to_joints(np.array(motors)), joints)
    seen = mounting.reading(Reading(np.array([0.5, 1]), np.array([4.0, 1]), np.array([-1, 4.0]), NEVER))
    rows = (seen.position_rad, seen.velocity_rad_s, seen.load)
    np.testing.assert_allclose(rows, [[-0.2, 2.0], [-2.0, 2.0], [2.0, 2.0]])


def test_a_plain_joint_changes_no_bit():
    assert Joint.of("hinge") == Joint("hinge", 0.0, 1, 1.0)
    assert Joint.of("hinge").is_plain
    assert not any(joint.is_plain for joint in (Joint("a", gear=2.0), Joint("a", 0.1), Joint("a", direction=-1)))
    device = Bench(POSITION, PLAIN)
    values = np.random.default_rng(0).normal(size=N)
    for joints in ((), as_joints(PLAIN)):
        mounting = Mounting(joints, device)
        assert np.array_equal(mounting.to_motors(values), values)
        assert np.array_equal(mounting.to_joints(values), values)
        reading = mounting.reading(Reading(values, values, np.array([np.nan, 1.0]), NEVER))
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


def test_a_mounted_plant_is_seen_through_its_encoders():
    """Servo 4 turns twice as far as its joint, the other way; servo 7 half as far."""
    centre, plant = (
        np.pi,
        Mock(servo_ids=(4, 7), **{"state.return_value": {"q": 1.0}, "truth.return_value": {"f": 3.0}}),
    )
    plant.measure.side_effect = {4: (centre + 0.4, 2.0, 0.5), 7: (centre - 1.0, 2.0, 0.5)}.get
    joints = [Joint("a", zero_rad=0.3, direction=-1, gear=2.0), Joint("b", gear=0.5)]
    mounted = MountedPlant(plant, joints, centre)
    assert mounted.servo_ids == (4, 7)
    np.testing.assert_allclose(mounted.measure(4), [centre + 0.3 - 0.8, -4.0, -0.5])
    np.testing.assert_allclose(mounted.measure(7), [centre - 0.5, 1.0, 0.5])
    goals = {OperatingMode.POSITION: (mounted.measure(4)[0], centre + 0.4), OperatingMode.VELOCITY: (3.0, -1.5),
             OperatingMode.PWM: (0.7, -0.7), OperatingMode.OFF: (0.0, 0.0)}  # fmt: skip
    for mode, (seen, own) in goals.items():
        mounted.command(4, mode, seen)
        assert plant.command.call_args.args == (4, mode, pytest.approx(own))
    for servo_id, speed, own in ((4, 5.0, 2.5), (7, np.inf, np.inf)):
        mounted.configure(servo_id, 800, 0, speed)
        assert plant.configure.call_args.args == (servo_id, 800, 0, own)
    mounted.advance(0.1)
    plant.advance.assert_called_once_with(0.1)
    assert (mounted.state(), mounted.truth()) == ({"q": 1.0}, {"f": 3.0})
    with pytest.raises(UsageError, match="1 joints are mounted on 2 servos"):
        MountedPlant(plant, joints[:1], centre)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"direction": 0}, "neither 1 nor -1"), ({"gear": -2.0}, "not a number above 0"), ({"gear": 0.0}, "above 0"),
     ({"zero_rad": float("nan")}, "not a finite angle")],
)  # fmt: skip
def test_what_cannot_be_converted_is_refused(wrong, said):
    with pytest.raises(UsageError, match=f"joint 'elbow'.*{said}"):
        Joint("elbow", **wrong)
