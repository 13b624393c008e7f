"""The rows of joints: which delay and which friction is that of a joint, and its verdict."""

from dataclasses import replace

from sim2real.artifacts.identification import Estimate, HeldOut, Identification, Judgement
from sim2real.artifacts.joints import joint_rows, joints_table


def estimate(name, value, kind="dynamics", verdict="accepted"):
    return Estimate(name, "s" if kind in ("delay", "derived") else "N m", kind, "", None, value, verdict)


def test_each_joint_has_its_delay_friction_and_verdict():
    parameters = (
        estimate("friction_hip", 0.3),
        estimate("friction_left_knee", 0.4, verdict="at a bound"),
        estimate("friction", 0.2),
        estimate("delay", 0.01, "delay"),
        estimate("delay_left_knee", 0.02, "delay"),
        estimate("round_trip_delay", 0.03, "derived"),
    )
    beaten = {"left_hip": (), "left_knee": (), "wrist": ("hold",)}
    held_out = tuple(HeldOut(n, n, "rad", 1.0, {"identified": 0.01}, b) for n, b in beaten.items())
    found = Identification("dog", (), Judgement("", ()), parameters, held_out=held_out)
    assert joints_table(found).rows == [
        ["left_hip", "0.01 rad", "30.0 ms", "0.3 N m", "accepted"],
        ["left_knee", "0.01 rad", "20.0 ms", "0.4 N m", "friction at a bound"],
        ["wrist", "0.01 rad", "30.0 ms", "0.2 N m", "no better than hold"],
    ]
    still = (replace(estimate("delay_wrist", 0.0, "delay", "at a bound"), lower=0.0, upper=0.05),)
    (row,) = joint_rows(replace(found, parameters=still, held_out=(replace(held_out[2], beaten_by=()),)))
    assert row.delay is still[0]
    assert row.verdict == "accepted", "a delay of 0 is the smallest possible one"
    assert joint_rows(Identification("dog", (), Judgement("", ()), ())) == []


def test_the_friction_of_a_group_is_that_of_its_joints():
    parameters = tuple(estimate(f"{group}_friction", i) for i, group in enumerate(("hip", "calf", "foot")))
    held_out = tuple(HeldOut(n, n, "rad", 1.0, {"identified": 0.01}) for n in ("FR_hip", "FR_calf", "FR_thigh"))
    rows = joint_rows(Identification("dog", (), Judgement("", ()), parameters, held_out=held_out))
    assert [row.friction for row in rows] == [parameters[0], parameters[1], None]
