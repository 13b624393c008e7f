"""Columns that are not what they are called: commands that are measurements, gains that are 0 throughout."""

from pathlib import Path

import numpy as np
import pytest
from foreign_robots import imported, motion
from mcap_ros2.writer import Writer

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.check.stage import check
from sim2real.stages.pipeline import from_model
from sim2real.stages.pipeline.robot_flags import RobotFlags

XML = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.05" mass="0.3"/>
  <body pos="0 0 -0.2"><joint name="b" axis="0 1 0"/><geom size="0.05" mass="0.2"/></body></body></worldbody>
</mujoco>"""
STEP = 2 * np.pi / 4096


@pytest.fixture(scope="module")
def recorded():
    return motion()


COPIES = {
    "the state": lambda goal, q: q,
    "the next state": lambda goal, q: np.roll(q, -1, axis=0),
    "the state before": lambda goal, q: np.roll(q, 1, axis=0),
    "the state after three": lambda goal, q: np.roll(q, -3, axis=0),
    "the state after 100 ms": lambda goal, q: np.roll(q, -20, axis=0),
    "in degrees": lambda goal, q: np.degrees(q),
    "turned": lambda goal, q: -q,
    "rounded": lambda goal, q: np.round(q, 2),
    "of one joint": lambda goal, q: np.stack([q[:, 0], goal[:, 1]], axis=1),
}


@pytest.mark.parametrize("copy", COPIES)
def test_commands_that_are_the_measurements_are_refused(tmp_path, recorded, copy):
    t, goal, q = recorded
    np.savez(tmp_path / "run.npz", t_s=t, goal=COPIES[copy](goal, q), q=q)
    with pytest.raises(UsageError, match=r"are copies of the measurements: goal\[:,0\] is q\[:,0\]"):
        imported(tmp_path / "run.npz")


@pytest.mark.parametrize("rows", [4, 20, 90])
@pytest.mark.parametrize("form", ["motion", "gait"])
def test_commands_that_are_late_copies_are_refused(tmp_path, recorded, rows, form):
    """A gait that repeats follows its late copy one period later, too."""
    t, _, q = recorded
    if form == "gait":
        q = np.stack([np.sin(4 * np.pi * t + p) + 0.3 * np.sin(8 * np.pi * t) for p in (0.3, 1.1)], axis=1)
    np.savez(tmp_path / "run.npz", t_s=t, goal=np.roll(q, rows, axis=0), q_rad=q)
    with pytest.raises(UsageError, match="copies of"):
        imported(tmp_path / "run.npz")


def test_a_mapping_of_such_commands_is_contradicted(recorded):
    t, _, q = recorded
    assert "its commands are copies of its measurements" in evidence.contradictions((t, t), q, q)[0]


SCHEMA = """std_msgs/Header header
string[] name
float64[] position
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def bag(path, t, goal, q, ahead_s=0.0):
    """Write a bag of both topics; ``ahead_s``: of the clock that stamps commands."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        kind = writer.register_msgdef("sensor_msgs/msg/JointState", SCHEMA)
        for k in range(len(t)):
            for topic, values, ahead in (("/cmd", goal, ahead_s), ("/joint_states", q, 0.0)):
                ns = round((1000.0 + t[k]) * 1e9)
                sec, nanosec = divmod(round((1000.0 + t[k] + ahead) * 1e9), 10**9)
                header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}
                row = {"header": header, "name": ["a", "b"], "position": values[k].tolist()}
                writer.write_message(topic, kind, row, log_time=ns, publish_time=ns)
        writer.finish()
    return path


def test_topics_that_are_exchanged_are_refused_but_a_clock_that_is_ahead_is_not(tmp_path, recorded):
    """The recorder's clock is one for both topics: if positions lead by it, too, no clock explains that."""
    t, goal, q = recorded
    with pytest.raises(UsageError, match="move before their commands: a by"):
        imported(bag(tmp_path / "exchanged.mcap", t, q, goal))
    _, found = imported(bag(tmp_path / "ahead.mcap", t, goal, q, 0.2))
    assert found.mapping.nodes["actuator"].stamp_offset == pytest.approx(0.09 - 0.2, abs=0.02)
    assert imported(bag(tmp_path / "right.mcap", t, goal, q))[1].mapping.nodes["actuator"].stamp_offset == 0.0


@pytest.mark.parametrize(
    "change",
    [
        lambda goal, q: (goal, q),
        lambda goal, q: (goal, np.round(q / STEP) * STEP),
        lambda goal, q: (np.round(goal / STEP) * STEP, np.round(q / STEP) * STEP),
    ],
)
def test_what_is_measured_and_rounded_is_no_copy(tmp_path, recorded, change):
    t, goal, q = recorded
    goal, q = change(goal, q)
    np.savez(tmp_path / "run.npz", t_s=t, goal=goal, q=q)
    np.testing.assert_allclose(imported(tmp_path / "run.npz")[0].outputs["actuator"]["goal"], goal)


@pytest.mark.parametrize("name", ["kd", "kp", "tau_ff", "dq_des", "torque_enable"])
def test_what_is_zero_throughout_is_left_out(tmp_path, monkeypatch, recorded, name):
    t, goal, q = recorded
    monkeypatch.chdir(tmp_path)
    Path("robot.xml").write_text(XML)
    np.savez(
        "run.npz", t_s=t, goal_rad=goal, q_rad=q, **{name: np.zeros((len(t), 2)) if name != "kd" else np.zeros(len(t))}
    )
    episode, found = imported(Path("run.npz"))
    assert set(episode.outputs["actuator"]) == {"goal"}
    assert f"skipped: '{name}' is 0 throughout" in "\n".join(found.evidence)
    assert from_model.from_flags(RobotFlags(mjcf=Path("robot.xml")), ["run.npz"]).description.commands == ("goal",)


@pytest.mark.parametrize("name", ["kd", "kp", "torque_enable"])
def test_what_is_zero_for_some_joints_that_follow_is_left_out(tmp_path, recorded, name):
    t, goal, q = recorded
    gain = np.tile([1.0, 0.0], (len(t), 1))
    np.savez(tmp_path / "run.npz", t_s=t, goal_rad=goal, q_rad=q, **{name: gain})
    episode, found = imported(tmp_path / "run.npz")
    assert set(episode.outputs["actuator"]) == {"goal"}
    assert f"skipped: '{name}' is 0 throughout for q_rad[:,1]" in "\n".join(found.evidence)
    # A joint that does not follow has no drive: its gain is 0.
    q = q * [1.0, 0.0] + 1e-3 * np.random.default_rng(0).standard_normal(q.shape)
    np.savez(tmp_path / "run.npz", t_s=t, goal_rad=goal, q_rad=q, **{name: gain})
    episode, _ = imported(tmp_path / "run.npz")
    assert len(set(episode.outputs["actuator"]) - {"goal"}) == 1


def test_a_mapping_with_a_gain_of_zero_describes_a_robot_without_it(tmp_path, monkeypatch, recorded):
    t, goal, q = recorded
    monkeypatch.chdir(tmp_path)
    Path("robot.xml").write_text(XML)
    np.savez("run.npz", t_s=t, goal=goal, q=q, kd=0.0)
    Path("map.toml").write_text(
        'pipeline = "robot"\n[nodes.actuator]\nstamps = "t_s"\nfields.goal = { source = "goal", unit = "rad" }\n'
        'fields.kd = { source = "kd" }\n'
        '[nodes.sensor]\nstamps = "t_s"\nfields.position = { source = "q", unit = "rad" }\n'
    )
    told = RobotFlags(mjcf=Path("robot.xml"), mapping=Path("map.toml"))
    assert from_model.from_flags(told, ["run.npz"]).description.commands == ("goal",)


SECOND = {
    "a command in degrees": (
        lambda g, q: {"goal": g, "q": q, "target_deg": np.degrees(g)},
        "commands that are not imported: goal (instead: target_deg)",
    ),
    "a voltage beside a goal": (
        lambda g, q: {"goal_a": g[:, 0], "goal_b": g[:, 1], "q_a": q[:, 0], "q_b": q[:, 1], "cmd_pwm_a": g[:, 0]},
        "commands that are not imported: cmd_pwm_a (joint a has goal_a)",
    ),
    "a second encoder": (
        lambda g, q: {"goal_rad": g, "q_rad": q, "encoder": q + 0.1},
        "measurements that are not imported: encoder (instead: q_rad)",
    ),
    "an encoder of one joint": (
        lambda g, q: {"goal_rad": g, "q_rad": q, "motor_angle": q[:, :1]},
        "measurements that are not imported: motor_angle (instead: q_rad)",
    ),
}


@pytest.mark.parametrize("case", SECOND)
def test_a_second_command_or_measurement_of_a_joint_is_named(tmp_path, recorded, case):
    columns, note = SECOND[case]
    t, goal, q = recorded
    np.savez(tmp_path / "run.npz", t_s=t, **columns(goal, q))
    assert note in imported(tmp_path / "run.npz")[1].evidence


def test_a_log_whose_columns_are_all_imported_has_no_such_note(tmp_path, recorded):
    t, goal, q = recorded
    more = {"dq_des": np.gradient(goal, t, axis=0), "tau_cmd": goal, "dq": np.gradient(q, t, axis=0), "effort": q}
    np.savez(tmp_path / "run.npz", t_s=t, goal=goal, q=q, **more)
    assert not any(
        "not imported" in line or "no command" in line for line in imported(tmp_path / "run.npz")[1].evidence
    )


@pytest.mark.parametrize(("name", "doubtful"), [("effort", True), ("tau", True), ("cmd_torque", False)])
def test_import_and_check_name_a_measured_torque_that_is_taken_as_the_command(tmp_path, recorded, name, doubtful):
    t, goal, q = recorded
    (tmp_path / "robot.xml").write_text(XML)
    np.savez(log := tmp_path / "run.npz", t_s=t, q_rad=q, **{name: goal})
    evidence_lines = imported(log)[1].evidence
    pipeline = from_model.from_flags(RobotFlags(mjcf=tmp_path / "robot.xml"), [str(log)])
    assert pipeline.description.commands == ("torque",)
    recommendation = check(pipeline, None, CheckConfig(record=pipeline.record, log=(str(log),))).recommendation
    for lines in (evidence_lines, recommendation):
        assert any(f"'{name}' is taken as the commanded torque" in line for line in lines) == doubtful


def test_a_torque_that_is_measured_by_its_name_is_no_command(tmp_path, recorded):
    t, goal, q = recorded
    np.savez(tmp_path / "run.npz", t_s=t, q_rad=q, measured_effort=goal)
    with pytest.raises(UsageError, match=r"A measured torque is no command: 'measured_effort'"):
        imported(tmp_path / "run.npz")
