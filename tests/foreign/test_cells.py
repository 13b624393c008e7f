"""Cells and columns that are no numbers: missing ones are dropped and counted, others are refused or listed."""

import json

import numpy as np
import pytest
from foreign_robots import csv, imported, motion

from sim2real.errors import UsageError


@pytest.fixture(scope="module")
def recorded():
    return motion()


def columns(recorded, **more):
    t, goal, q = recorded
    own = {"t_s": t, "goal_a": goal[:, 0], "goal_b": goal[:, 1], "q_a": q[:, 0], "q_b": q[:, 1]}
    return own | more


def spoilt(values, word):
    return [word if i % 97 == 5 else f"{x:.6f}" for i, x in enumerate(values)]


def said(found):
    return "\n".join(found.evidence)


@pytest.mark.parametrize("word", ["null", "N/A", "NULL", "None", "nan", "-", ""])
def test_words_for_a_missing_number_are_missing_numbers(tmp_path, recorded, word):
    path = csv(tmp_path / "run.csv", columns(recorded, q_a=spoilt(recorded[2][:, 0], word)))
    episode, found = imported(path)
    assert episode.outputs["sensor"]["position"].shape == (1979, 2)
    assert "21 of 2000 samples lack a number" in said(found)


def test_words_in_json_and_in_arrays_of_words(tmp_path, recorded):
    t, goal, q = recorded
    rows = [
        {"t_s": a, "goal_a": b, "q_a": c}
        for a, b, c in zip(t.tolist(), goal[:, 0].tolist(), spoilt(q[:, 0], "null"), strict=True)
    ]
    (tmp_path / "run.json").write_text(json.dumps(rows))
    assert imported(tmp_path / "run.json")[0].outputs["sensor"]["position"].shape == (1979, 1)
    np.savez(tmp_path / "run.npz", t_s=t, goal=goal, q=q.astype(str))
    np.testing.assert_array_equal(imported(tmp_path / "run.npz")[0].outputs["sensor"]["position"], q)


def test_words_beside_numbers_that_are_missing(tmp_path, recorded):
    t, goal, q = recorded
    cells = [None if i % 50 == 3 else x for i, x in enumerate(spoilt(q[:, 0], "null"))]
    (tmp_path / "run.json").write_text(json.dumps({"t_s": t.tolist(), "goal": goal[:, 0].tolist(), "q": cells}))
    whole = sum(cell not in (None, "null") for cell in cells)
    assert imported(tmp_path / "run.json")[0].outputs["sensor"]["position"].shape == (whole, 1)
    cells[7] = "ERR"
    (tmp_path / "run.json").write_text(json.dumps({"t_s": t.tolist(), "goal": goal[:, 0].tolist(), "q": cells}))
    with pytest.raises(UsageError, match=r"sample 7 of 'q' in .* holds 'ERR', no number"):
        imported(tmp_path / "run.json")


def test_a_word_in_a_position_is_refused_with_its_line(tmp_path, recorded):
    path = csv(tmp_path / "run.csv", columns(recorded, q_a=spoilt(recorded[2][:, 0], "ERR")))
    with pytest.raises(UsageError, match=r"line 7 of .*column 'q_a' holds 'ERR'"):
        imported(path)


@pytest.mark.parametrize(
    ("name", "values", "listed"),
    [
        ("dq_a", lambda q: spoilt(q[:, 0], "ERR"), "column 'dq_a' holds 'ERR'"),
        ("phase", lambda q: ["warm"] * len(q), "skipped, as they hold no numbers: phase"),
        ("gripper_state", lambda q: ["open"] * len(q), "skipped, as they hold no numbers: gripper_state"),
        ("effort_a", lambda q: np.full(len(q), np.nan), "skipped: 'effort_a' has no number in any sample"),
        ("dq_a", lambda q: np.full(len(q), np.nan), "skipped: 'dq_a' has no number in any sample"),
    ],
)
def test_columns_that_do_not_matter_are_left_out_and_listed(tmp_path, recorded, name, values, listed):
    path = csv(tmp_path / "run.csv", columns(recorded, **{name: values(recorded[2])}))
    episode, found = imported(path)
    assert list(episode.outputs["sensor"]) == ["position"]
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], recorded[2], atol=1e-6)
    assert listed in said(found)


def test_a_joint_without_a_number_is_left_out_or_refused_where_it_is_asked_for(tmp_path, recorded):
    path = csv(tmp_path / "run.csv", columns(recorded, q_a=["null"] * 2000))
    _, found = imported(path)
    assert found.joints == ("b",)
    assert found.mapping.nodes["actuator"].fields["goal"].source == ("goal_b",)
    assert "skipped: 'q_a' has no number" in said(found)
    with pytest.raises(UsageError, match="are not the robot's 2 joints"):
        imported(path, joints=("a", "b"))


def test_vectors_with_columns_that_have_no_number(tmp_path, recorded):
    t, goal, q = recorded
    nan = np.full(len(t), np.nan)
    np.savez(tmp_path / "run.npz", t_s=t, goal=goal, q=q, dq=np.stack([nan, q[:, 1]], 1), effort=np.stack([nan] * 2, 1))
    episode, found = imported(tmp_path / "run.npz")
    assert list(episode.outputs["sensor"]) == ["position"]
    assert "skipped: 'dq' lacks numbers" in said(found)
    np.savez(tmp_path / "run.npz", t_s=t, goal=goal, q=np.stack([q[:, 0], nan], 1))
    with pytest.raises(UsageError, match="2 columns for 1 joints"):
        imported(tmp_path / "run.npz")


def test_a_velocity_that_lacks_some_numbers(tmp_path, recorded):
    t, _, q = recorded
    velocity = np.gradient(q, t, axis=0)
    more = {"dq_a": spoilt(velocity[:, 0], "null"), "dq_b": velocity[:, 1]}
    episode, _ = imported(csv(tmp_path / "run.csv", columns(recorded, **more)))
    assert {name: len(v) for name, v in episode.outputs["sensor"].items()} == {"position": 1979, "velocity": 1979}


@pytest.mark.parametrize("header", ["", ","])
@pytest.mark.parametrize("end", ["", ","])
def test_a_comma_at_the_end_of_lines_is_no_column(tmp_path, recorded, header, end):
    path = csv(tmp_path / "run.csv", columns(recorded), end)
    first, _, rest = path.read_text().partition("\n")
    path.write_text(f"{first}{header}\n{rest}")
    np.testing.assert_allclose(imported(path)[0].outputs["sensor"]["position"], recorded[2], atol=1e-6)


def test_velocities_in_another_order_go_by_their_names(tmp_path, recorded):
    t, _, q = recorded
    velocity = np.gradient(q, t, axis=0)
    path = csv(tmp_path / "run.csv", columns(recorded, dq_b=velocity[:, 1], dq_a=velocity[:, 0]))
    assert imported(path)[1].mapping.nodes["sensor"].fields["velocity"].source == ("dq_a", "dq_b")
    path = csv(tmp_path / "run.csv", columns(recorded, dq_a=0 * t, dq_b=velocity[:, 1]))
    assert "velocity" not in imported(path)[1].mapping.nodes["sensor"].fields


def test_cells_of_another_recorder_with_decimal_commas(tmp_path, recorded):
    """Missing numbers, words and a column without a name, in a table with semicolons."""
    t, _goal, q = recorded
    table = columns(recorded, q_a=spoilt(q[:, 0], "null"), phase=["warm"] * len(t))
    rows = [";".join(["7", *(str(x).replace(".", ",") for x in row)]) for row in zip(*table.values(), strict=True)]
    (tmp_path / "run.csv").write_text("\n".join([";".join(["", *table]), *rows]))
    episode, found = imported(tmp_path / "run.csv")
    assert len(episode.outputs["sensor"]["position"]) == sum(cell != "null" for cell in table["q_a"])
    said = "\n".join(found.evidence)
    assert "skipped, as they hold no numbers: phase" in said
    assert "skipped: columns without a name: 1" in said
