"""What names propose, what they leave open, and how an answer in the file closes a question."""

import re

import numpy as np
import pytest
from foreign_robots import MODEL, VENDOR, csv, imported, motion, proposed

from sim2real import cli
from sim2real.errors import UsageError
from sim2real.log import import_file, load_mapping, read_log
from sim2real.log.importing.names import are_numbers, columns_of, meaning
from sim2real.log.importing.propose import ImportHints, propose
from sim2real.log.importing.readers import joined, open_tables

T, GOAL, Q = motion(10.0)


def table(path, goal="goal_{}_rad", q="q_{}_rad", stamps="t_s", factor=1.0, **more):
    """Write joints a and b by patterns of names."""
    columns = {stamps: T}
    columns |= {goal.format(j): factor * GOAL[:, i] for i, j in enumerate("ab")}
    columns |= {q.format(j): factor * Q[:, i] for i, j in enumerate("ab")}
    return csv(path / "run.csv", columns | more)


@pytest.mark.parametrize("degrees", [0.9, 20.0, 500.0])
def test_a_unit_that_no_name_has_is_asked_however_small_or_large_the_motion(tmp_path, degrees):
    path = table(tmp_path, "goal_{}", "q_{}", factor=degrees)
    questions = proposed(path).questions
    assert {key for _, _, key in questions} == {"unit"}
    assert all('"rad" or "deg"' in text for text in questions.values())
    episode, _ = imported(path, unit="deg")
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], np.radians(degrees * Q), atol=1e-6)


@pytest.mark.parametrize(
    ("goal", "q", "asked"), [("goal_{}_rad", "q_{}", "sensor"), ("goal_{}", "q_{}_rad", "actuator")]
)
@pytest.mark.parametrize("factor", [1.0, 8.0])
def test_a_unit_of_one_side_holds_for_the_other_unless_the_data_contradict_it(tmp_path, goal, q, asked, factor):
    scale = {"sensor": (1.0, factor), "actuator": (factor, 1.0)}[asked]
    columns = {"t_s": T} | {goal.format(j): scale[0] * GOAL[:, i] for i, j in enumerate("ab")}
    columns |= {q.format(j): scale[1] * Q[:, i] for i, j in enumerate("ab")}
    found = proposed(csv(tmp_path / "run.csv", columns))
    assert {key[:1] + key[2:] for key in found.questions} == ({(asked, "unit")} if factor > 1 else set())
    assert found.mapping.nodes["sensor"].fields["position"].unit == "rad"


@pytest.mark.parametrize("suffix", ["_ticks", "_percent", ""])
def test_counts_and_percent_are_asked(tmp_path, suffix):
    path = table(tmp_path, f"goal_{{}}{suffix}", f"q_{{}}{suffix}", factor=2048 / np.pi)
    assert {key for _, _, key in proposed(path).questions} == {"unit"}
    episode, _ = imported(path, unit="counts:4096")
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], Q, atol=1e-5)


def test_whole_numbers_may_be_counts(tmp_path):
    np.savez(tmp_path / "run.npz", t_s=T, goal=np.round(652 * GOAL), q=np.round(652 * Q))
    assert all("counts:4096" in text for text in proposed(tmp_path / "run.npz").questions.values())


def test_a_question_stands_in_the_file_and_an_edited_line_answers_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    table(tmp_path, "goal_{}", "q_{}", factor=180 / np.pi)
    assert cli.main(["import", "run.csv"]) == 2
    error = capsys.readouterr().err
    assert "run.import.toml" in error
    assert not (tmp_path / "runs").exists()
    with pytest.raises(UsageError, match="open question"):
        load_mapping("run.import.toml")
    text = (tmp_path / "run.import.toml").read_text()
    assert len(re.findall(r"^# unit = .*\?", text, re.MULTILINE)) == 2
    (tmp_path / "run.import.toml").write_text(re.sub(r"^# unit = .*\?.*$", 'unit = "deg"', text, flags=re.MULTILINE))
    assert cli.main(["import", "run.csv", "--mapping", "run.import.toml", "--out", "log.mcap"]) == 0
    np.testing.assert_allclose(read_log("log.mcap").outputs["sensor"]["position"], Q, atol=1e-5)
    assert cli.main(["import", "run.csv"]) == 2, "an edited file is not overwritten"
    assert 'unit = "deg"' in (tmp_path / "run.import.toml").read_text()
    assert cli.main(["import", "run.csv", "--unit", "deg", "--out", "other.mcap"]) == 0


def test_a_vendors_names_are_matched_by_leg_and_number(tmp_path):
    t, goal, q = motion(10.0, joints=6)
    np.savez(tmp_path / "run.npz", t_s=t, q_des_rad=goal, q_rad=q, joint_names=np.array(VENDOR))
    episode, found = imported(tmp_path / "run.npz", joints=MODEL)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q[:, [3, 4, 5, 0, 1, 2]])
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal[:, [3, 4, 5, 0, 1, 2]])
    assert any("FL_0 is FL_hip_joint" in line for line in found.evidence)


@pytest.mark.parametrize(
    ("labels", "joints", "places"),
    [
        (("LF_HAA", "LF_HFE", "LF_KFE"), ("FL_hip", "FL_thigh", "FL_calf"), [0, 1, 2]),
        (("FR1", "FR2", "FL1", "FL2"), ("FL_hip", "FL_thigh", "FR_hip", "FR_thigh"), [2, 3, 0, 1]),
        (("front_left_knee", "front_left_hip"), ("FL_hip_joint", "FL_calf_joint"), [1, 0]),
        (("b", "a"), ("a_joint", "b_joint"), [1, 0]),
        (("hip_FR", "hip_FL", "calf_FR", "calf_FL"), ("FL_hip", "FL_calf", "FR_hip", "FR_calf"), [1, 3, 0, 2]),
        (("ur5e_lift", "ur5e_pan"), ("pan_joint", "lift_joint"), [1, 0]),
        (("lift", "pan"), ("ur5e/pan", "ur5e/lift"), [1, 0]),
        (("left_pan", "left_lift"), ("right_pan", "right_lift"), None),
        (("A3", "A1", "A2"), ("iiwa_joint_1", "iiwa_joint_2", "iiwa_joint_3"), [1, 2, 0]),
        (("m0", "m1"), ("joint1", "joint2"), [0, 1]),
        (("j2", "j3"), ("joint1", "joint2"), None),
        (("FR_0", "FL_0", "RR_0"), ("FL_hip", "FL_thigh", "FL_calf"), None),
        (("x", "y"), ("a", "b"), None),
        (("FR_0", "FR_2"), ("FR_hip", "FR_thigh"), None),
    ],
)
def test_names_match_or_they_do_not(labels, joints, places):
    found = columns_of(joints, tuple(x.lower() for x in labels))
    assert (found and found[0]) == places


def test_joints_that_the_file_only_counts_are_in_the_order_of_their_numbers(tmp_path):
    np.savez(tmp_path / "run.npz", t_s=T, goal_rad=GOAL, q_rad=Q, names=np.array(["motor_2", "motor_1"]))
    episode, found = imported(tmp_path / "run.npz", joints=("hip", "knee"))
    np.testing.assert_array_equal(episode.outputs["sensor"]["position"], Q[:, ::-1])
    np.testing.assert_array_equal(episode.outputs["actuator"]["goal"], GOAL[:, ::-1])
    assert any("order is assumed" in line for line in found.evidence)


def test_columns_with_units_of_their_own_are_one_field(tmp_path):
    columns = {"t_s": T, "goal_a_mdeg": 1e3 * np.degrees(GOAL[:, 0]), "goal_b_rad": GOAL[:, 1]}
    columns |= {"q_a_deg": np.degrees(Q[:, 0]), "q_b_rev": Q[:, 1] / (2 * np.pi)}
    episode, _ = imported(csv(tmp_path / "run.csv", columns))
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], Q, atol=1e-4)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], GOAL, atol=1e-4)


def test_a_gripper_of_lerobots_names_is_in_no_unit_of_angle(tmp_path):
    columns = {"t_s": T} | {f"action.{j}.pos": GOAL[:, i] for i, j in enumerate(("elbow", "gripper"))}
    columns |= {f"state.{j}.pos": Q[:, i] for i, j in enumerate(("elbow", "gripper"))}
    with pytest.raises(UsageError, match="gripper as 0 to 100"):
        proposed(csv(tmp_path / "run.csv", columns), unit="deg")


def test_a_column_that_may_be_the_time_is_named_in_the_question(tmp_path):
    found = proposed(table(tmp_path, stamps="Tijd"))
    assert all('stamps = "Tijd"' in text for text in found.questions.values())


def test_columns_of_a_floating_base_before_those_of_the_joints_are_asked(tmp_path):
    qpos = np.column_stack([np.zeros((len(T), 7)), Q])
    np.savez(tmp_path / "run.npz", time=T, ctrl=GOAL, qpos=qpos)
    found = proposed(tmp_path / "run.npz", joints=("hip", "knee"))
    ((at, question),) = found.questions.items()
    assert (at, question.partition(" or ")[0]) == (("sensor", "position", "source"), '"qpos[:,7:9]"')
    answered = re.sub(r"^# source = (\S+) or .*$", r"source = \1", found.toml(), flags=re.MULTILINE)
    (tmp_path / "import.toml").write_text(answered)
    episode = import_file(tmp_path / "run.npz", tmp_path / "import.toml")
    np.testing.assert_array_equal(episode.outputs["sensor"]["position"], Q)


@pytest.mark.parametrize(
    ("labels", "numbers"),
    [("3 4", True), ("m_3 m_4", True), ("m3 m12", True), ("a_1 b_2", False), ("hip 3", False), ("hip knee", False)],
)
def test_numbers_are_no_names(labels, numbers):
    assert are_numbers(labels.split()) is numbers


@pytest.mark.parametrize("nameless", [False, True])
def test_names_that_exist_and_do_not_match_are_never_no_names(tmp_path, nameless):
    names = {} if nameless else {"joint_names": np.array(["left", "right"])}
    np.savez(tmp_path / "run.npz", t_s=T, goal_rad=GOAL, q_rad=Q, **names)
    if nameless:
        _, found = imported(tmp_path / "run.npz", joints=("hip", "knee"))
        assert any("order is assumed" in line for line in found.evidence)
        return
    with pytest.raises(UsageError, match=r"left, right.*hip, knee"):
        proposed(tmp_path / "run.npz", joints=("hip", "knee"))


@pytest.mark.parametrize("names", [("pan", "lift"), ("j1", "j2")])
@pytest.mark.parametrize("of_robot", [True, False])
def test_goals_of_the_left_arm_are_not_of_the_right_one(tmp_path, names, of_robot):
    columns = {"t_s": T} | {f"goal_left_{n}_rad": GOAL[:, i] for i, n in enumerate(names)}
    columns |= {f"q_right_{n}_rad": Q[:, i] for i, n in enumerate(names)}
    with pytest.raises(UsageError, match=r"left.*right"):
        proposed(csv(tmp_path / "run.csv", columns), joints=names if of_robot else ())


def test_goals_and_positions_of_other_joints_are_refused(tmp_path):
    columns = {"t_s": T, "goal_a_rad": GOAL[:, 0], "goal_b_rad": GOAL[:, 1], "q_a_rad": Q[:, 0], "q_c_rad": Q[:, 1]}
    with pytest.raises(UsageError, match=r"a, b.*a, c"):
        proposed(csv(tmp_path / "run.csv", columns))


def test_columns_in_another_order_without_names_are_asked(tmp_path):
    np.savez(tmp_path / "run.npz", t_s=T, goal_rad=GOAL[:, ::-1], q_rad=Q)
    assert set(proposed(tmp_path / "run.npz").questions) == {("actuator", "goal", "source")}
    assert proposed(tmp_path / "run.npz", as_told=True).questions == {}


def test_a_unit_that_no_motion_proves_is_asked_until_the_flag_answers(tmp_path):
    rng = np.random.default_rng(0)
    np.savez(tmp_path / "run.npz", t_s=T, goal_rad=GOAL, q_rad=0.3 * rng.permutation(Q))
    assert set(proposed(tmp_path / "run.npz").questions) == {("actuator", "goal", "unit")}
    found = proposed(tmp_path / "run.npz", unit="rad")
    assert found.questions == {}
    assert any("no position follows" in line for line in found.evidence)


def test_a_sign_is_asked_and_told_by_the_file(tmp_path):
    np.savez(tmp_path / "run.npz", t_s=T, goal_rad=GOAL * [1, -1], q_rad=Q)
    assert "[1.0, -1.0]" in proposed(tmp_path / "run.npz").questions["actuator", "goal", "scale"]


def test_one_column_of_another_scale_is_refused_by_name(tmp_path):
    names = np.array(["arm", "finger"])
    np.savez(tmp_path / "run.npz", time=T, ctrl=GOAL * [1, 255], qpos=Q * [1, 0.04], joint_names=names)
    with pytest.raises(UsageError, match="finger"):
        proposed(tmp_path / "run.npz")
    _, found = imported(tmp_path / "run.npz", joints=("arm",))
    assert found.joints == ("arm",)
    np.savez(tmp_path / "run.npz", time=T, ctrl=GOAL * [1, 255], qpos=Q * [1, 255], joint_names=names)
    (question,) = proposed(tmp_path / "run.npz").questions.values()
    assert "finger reads up to" in question


def test_stamps_units_and_rates(tmp_path):
    for name, factor, unit in (("t_ms", 1e3, "ms"), ("time", 1e9, "ns"), ("timestamp", 1e6, "us")):
        columns = {name: np.round(1.7e9 * factor + T * factor), "goal_a_rad": GOAL[:, 0], "q_a_rad": Q[:, 0]}
        _, found = imported(csv(tmp_path / "run.csv", columns))
        assert found.mapping.nodes["sensor"].stamp_unit == unit
    path = csv(tmp_path / "run.csv", {"goal_a_rad": GOAL[:, 0], "q_a_rad": Q[:, 0]})
    assert set(proposed(path).questions) == {("actuator", "", "rate_hz"), ("sensor", "", "rate_hz")}
    assert imported(path, rate_hz=200.0)[0].metadata["stamps"] == {"actuator": "generated", "sensor": "generated"}


def test_stamps_that_step_back_are_refused_with_the_place_and_a_part_is_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    csv(tmp_path / "run.csv", {"t_s": np.where(T > 6, T - 6, T), "goal_a_rad": GOAL[:, 0], "q_a_rad": Q[:, 0]})
    with pytest.raises(UsageError, match="before sample 1201"):
        proposed(tmp_path / "run.csv")
    assert cli.main(["import", "run.csv", "--samples", "0:1201", "--out", "part.mcap"]) == 0
    assert len(read_log("part.mcap").steps["sensor"]) == 1201
    assert imported(tmp_path / "run.csv", rate_hz=200.0)[1].questions == {}


def test_gains_torque_switches_and_velocities_go_along(tmp_path):
    on = (T > 1.0).astype(float)
    rate = np.gradient(Q, T, axis=0)
    _, found = imported(
        table(
            tmp_path, kp=np.full(len(T), 8.0), kd=0 * T, torque_enable=on, dq_a_rad_s=rate[:, 0], dq_b_rad_s=rate[:, 1]
        )
    )
    assert set(found.mapping.nodes["actuator"].fields) == {"goal", "kp", "enabled"}
    assert found.mapping.nodes["sensor"].fields["velocity"].unit == "rad/s"
    assert any("'kd'" in line for line in found.evidence)


def test_a_gain_that_is_logged_rarely_drops_no_commands(tmp_path, monkeypatch):
    kp = np.where(np.arange(len(T)) % 25 == 0, 8.0, np.nan)
    path = table(tmp_path, kp=kp)
    with pytest.raises(UsageError, match="kp"):
        proposed(path)
    # The mapping is there to be edited.
    monkeypatch.chdir(tmp_path)
    assert cli.main(["import", path.name]) == 2
    edit = tmp_path / "run.import.toml"
    edit.write_text(edit.read_text().replace('[nodes.actuator.fields.kp]\nsource = ["kp"]  # by its name\n', ""))
    assert cli.main(["import", path.name, "--mapping", edit.name, "--out", "log.mcap"]) == 0
    assert set(read_log("log.mcap").outputs["actuator"]) == {"goal"}


def test_names_of_files_of_one_recording_are_no_joints(tmp_path):
    sent = csv(tmp_path / "run1.csv", {"t_s": T, "goal_a_rad": GOAL[:, 0], "goal_b_rad": GOAL[:, 1]})
    read = csv(tmp_path / "q2.csv", {"t_s": T, "q_a_rad": Q[:, 0], "q_b_rad": Q[:, 1]})
    found = propose(joined([open_tables(path)[0] for path in (sent, read)]), ImportHints("x"))
    assert (found.joints, found.questions) == (("a", "b"), {})
    # Two files of like messages: which one has the commands is asked; a counter is no candidate.
    for path, values in ((sent, GOAL), (read, Q)):
        rows = {"%time": T * 1e9, "field.header.seq": np.arange(len(T)), "field.position0": values[:, 0]}
        csv(path, rows)
    found = propose(joined([open_tables(path)[0] for path in (sent, read)]), ImportHints("x"))
    assert {("sensor", "position", "source"), ("actuator", "goal", "source")} <= set(found.questions)
    assert not any("seq" in text for text in found.questions.values())


def test_which_of_two_commands_is_asked(tmp_path):
    other = {"command_a_rad": GOAL[::-1, 0], "command_b_rad": GOAL[::-1, 1]}
    path = table(tmp_path)
    episode = csv(path, {"t_s": T, "goal_rad": GOAL[:, 0], "target_rad": GOAL[::-1, 0], "q_rad": Q[:, 0], **other})
    question = proposed(episode).questions["actuator", "goal", "source"]
    assert question.startswith('["goal_rad"] or ["target_rad"]')


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("cmd_deg/FL_hip", ("command", "", "deg", "fl_hip")),
        ("observation.state", ("measured", "", "", "")),
        ("/controller_state.reference.positions", ("command", "position", "", "controller")),
        ("dq_rad_s", ("", "velocity", "rad", "")),
        ("field.header.stamp", ("", "stamp", "", "")),
        ("shoulder.pos", ("", "position", "", "shoulder")),
        ("hip position [deg]", ("", "position", "deg", "hip")),
        ("grip [%]", ("", "", "percent", "grip")),
    ],
)
def test_meanings(name, found):
    m = meaning(name)
    assert (m.side, m.quantity, m.unit, m.label) == found
