"""A hundred files with ordinary names, as makers of robots and their users write them: most need no answer."""

import itertools

import numpy as np
from foreign_robots import csv, motion

from sim2real.log.importing.importer import import_table
from sim2real.log.importing.propose import ImportHints, propose
from sim2real.log.importing.readers import open_tables

T, GOAL, Q = motion(8.0, dt=0.01)
UNITS = {"rad": 1.0, "deg": 180 / np.pi, "rev": 0.5 / np.pi, "mrad": 1e3}
TIMES = {
    "t": 1.0, "t_s": 1.0, "time": 1.0, "Time [s]": 1.0, "time_ms": 1e3, "timestamp": 1.0, "timestamp_us": 1e6,
    "stamp_ns": 1e9, "elapsed_s": 1.0, "seconds": 1.0, "host_time": 1.0, "sim_time": 1.0, "Timestamp (ms)": 1e3,
    "clock_s": 1.0, "ros_time": 1.0, "relative_time": 1.0, "unix_time": 1.0, "millis": 1e3, "uptime_ms": 1e3,
}  # fmt: skip
"""Name of the stamps -> their size for a second."""
NAMES = (
    ("hip", "knee"),
    ("joint1", "joint2"),
    ("FL_hip", "FL_knee"),
    ("shoulder_pan", "elbow"),
    ("0", "1"),
    ("A1", "A2"),
)
"""Joints."""
OF_UNIT = [
    ("goal_{j}_{u}", "q_{j}_{u}"),
    ("action.{j}.pos_{u}", "observation.{j}.pos_{u}"),
    ("command/{j}/position_{u}", "state/{j}/position_{u}"),
    ("ctrl_{j}_{u}", "qpos_{j}_{u}"),
    ("q_des_{j}_{u}", "q_{j}_{u}"),
    ("{j}_goal_{u}", "{j}_pos_{u}"),
    ("{j}.goal_{u}", "{j}.pos_{u}"),
    ("cmd_{u}/{j}", "meas_{u}/{j}"),
    ("target_{j} [{u}]", "position_{j} [{u}]"),
    ("{j} target position ({u})", "{j} actual position ({u})"),
    ("q_cmd_{j}_{u}", "q_meas_{j}_{u}"),
    ("joint_pos_target_{j}_{u}", "joint_pos_{j}_{u}"),
    ("action_{j}_{u}", "state_{j}_{u}"),
    ("setpoint.{j}.{u}", "encoder.{j}.{u}"),
    ("reference_{j}_{u}", "angle_{j}_{u}"),
    ("desired_angle_{j}_{u}", "measured_angle_{j}_{u}"),
    ("goal_position_{j}_{u}", "present_position_{j}_{u}"),
    ("AxisPosCmd_{j} [{u}]", "AxisPosAct_{j} [{u}]"),
    ("posDesired_{j}_{u}", "posActual_{j}_{u}"),
    ("{j}_command_{u}", "{j}_feedback_{u}"),
    ("input_pos_{j}_{u}", "pos_estimate_{j}_{u}"),
    ("theta_ref_{j}_{u}", "theta_{j}_{u}"),
    ("q_set_{j}_{u}", "q_act_{j}_{u}"),
    ("PositionCmd_{j}_{u}", "PositionFbk_{j}_{u}"),
    ("soll_{j} [{u}]", "ist_{j} [{u}]"),
    ("jpos_des_{j}_{u}", "jpos_{j}_{u}"),
    ("Axis {j} demand position ({u})", "Axis {j} reading position ({u})"),
    ("tgt_{j}_{u}", "enc_{j}_{u}"),
    ("CommandedJointPosition_{j}_{u}", "MeasuredJointPosition_{j}_{u}"),
]
"""Goals and positions of a joint whose names have the unit."""
IN_RADIANS = [
    ("joint_command.position.{j}", "joint_states.position.{j}"),
    ("/joint_commands/position/{j}", "/joint_states/position/{j}"),
    ("/joint_states/{j}/target", "/joint_states/{j}/position"),
    ("ctrl_{j}", "qpos_{j}"),
    ("dof_pos_target_{j}", "dof_pos_{j}"),
    ("target_q_{j}", "actual_q_{j}"),
    ("q_d_{j}", "q_{j}_rad"),
    ("motor_cmd[{j}].q", "motor_state[{j}].q"),
]
"""Names of messages and simulators that are in radians: of ROS, MuJoCo, Isaac, UR, Franka, Unitree."""
WITHOUT = [("goal_{j}", "q_{j}"), ("cmd.{j}", "position.{j}")]
"""Names that have no unit: it is asked."""


def written(seed, folder):
    """Return a file with ordinary names."""
    rng = np.random.default_rng(seed)
    styles = [*itertools.product(OF_UNIT, ["rad", "deg", "deg", "rev", "mrad"]),
              *itertools.product(IN_RADIANS * 4, ["rad"]), *itertools.product(WITHOUT * 4, ["deg"])]  # fmt: skip
    (goal, q), unit = styles[np.random.default_rng(0).permutation(len(styles))[seed % len(styles)]]
    word = str(rng.choice({"deg": ["deg", "degrees"], "rev": ["rev", "turns"]}.get(unit, [unit])))
    stamps, factor = list(TIMES.items())[int(rng.integers(len(TIMES)))]
    names = NAMES[int(rng.integers(len(NAMES)))]
    begin = 1.7e9 if "unix" in stamps or "ros" in stamps else 0.0
    columns = {stamps: (T + begin) * factor}
    columns |= {goal.format(j=j, u=word): UNITS[unit] * GOAL[:, i] for i, j in enumerate(names)}
    columns |= {q.format(j=j, u=word): UNITS[unit] * Q[:, i] for i, j in enumerate(names)}
    rate = np.gradient(Q, T, axis=0) * UNITS[unit]
    more = [{f"dq_{j}_{word}_s": rate[:, i] for i, j in enumerate(names)}, {"temperature": 30 + 0 * T},
            {"battery_voltage": 24.0 - 0.01 * T}, {"seq": np.arange(len(T))}, {"loop_time_us": 5000 + 0 * T},
            {f"current_{j}_A": rate[:, i] / 9 for i, j in enumerate(names)}]  # fmt: skip
    for i in rng.permutation(len(more))[: rng.integers(3)]:
        columns |= more[i]
    if rng.random() < 0.3:
        np.savez(folder / "run.npz", **{name.replace("/", "."): values for name, values in columns.items()})
        return folder / "run.npz"
    return csv(folder / "run.csv", columns)


def outcome(path):
    """Return ``right``, or what is asked; an error if the import is wrong without a word."""
    (table,) = open_tables(path)
    found = propose(table, ImportHints("x"))
    if found.questions:
        return f"{', '.join(table.keys)}: {found.open_questions()}"
    episode = import_table(table, found.mapping)
    assert episode.units["sensor"]["position"] == "rad"
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], Q, atol=2e-4)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], GOAL, atol=2e-4)
    start_us = episode.steps["sensor"].start
    np.testing.assert_allclose(start_us - start_us[0], 1e6 * T, atol=1)
    return "right"


def test_nine_of_ten_files_with_ordinary_names_are_right_at_once(tmp_path):
    asked = [found for seed in range(100) if (found := outcome(written(seed, tmp_path))) != "right"]
    assert len(asked) <= 10, asked
    assert all("unit" in question for question in asked)
