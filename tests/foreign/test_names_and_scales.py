"""Columns whose names, units or scales mislead: imported right, or refused with the name of the column."""

import json

import numpy as np
import pytest
from foreign_robots import csv, imported, motion

from sim2real.errors import UsageError

T, GOAL, Q = motion()
RATE = np.gradient(Q, T, axis=0)
TURNED = [1, 0]


def table(folder, **columns):
    return csv(folder / "run.csv", {"t_s": T} | columns)


@pytest.mark.parametrize("form", ["npz", "json"])
def test_a_list_of_names_orders_the_columns(tmp_path, form):
    """As Isaac Lab and Gym write them: arrays (T, N) beside the names of N joints, in another order than the model."""
    arrays = {"dof_pos": Q[:, TURNED], "dof_pos_target": GOAL[:, TURNED]}
    if form == "npz":
        np.savez(tmp_path / "run.npz", dt=0.005, dof_names=np.array(["b_joint", "a_joint"]), **arrays)
    else:
        lists = {name: values.tolist() for name, values in arrays.items()}
        (tmp_path / "run.json").write_text(json.dumps({"dt": 0.005, "joint_names": ["b_joint", "a_joint"], **lists}))
    episode, found = imported(tmp_path / f"run.{form}", joints=("a_joint", "b_joint"))
    assert found.joints == ("a_joint", "b_joint")
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], Q)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], GOAL)


def test_lists_of_names_in_different_orders(tmp_path):
    names = {"dof_names": np.array(["b", "a"]), "target_names": np.array(["a", "b"])}
    np.savez(tmp_path / "run.npz", dt=0.005, dof_pos=Q[:, TURNED], dof_pos_target=GOAL, **names)
    with pytest.raises(
        UsageError, match=r"dof_names, target_names .* name the columns of 'dof_pos_target' in different"
    ):
        imported(tmp_path / "run.npz")
    # A list of bodies names no joints.
    np.savez(tmp_path / "run.npz", dt=0.005, dof_pos=Q, dof_pos_target=GOAL, body_names=np.array(["x", "y"]))
    assert imported(tmp_path / "run.npz", joints=("a", "b"))[1].joints == ("a", "b")


@pytest.mark.parametrize(
    ("columns", "named"),
    [
        ({"goal_a_rev": GOAL[:, 0] / 6.2832, "q_a_rev": Q[:, 0] / 6.2832}, "'q_a_rev' .* is in rev by its name"),
        ({"goal_a_mrad": 1e3 * GOAL[:, 0], "q_a_mrad": 1e3 * Q[:, 0]}, "'q_a_mrad' .* is in mrad by its name"),
        ({"goal_a_rev": GOAL[:, 0] / 6.2832, "q_a_rad": Q[:, 0]}, "'goal_a_rev' .* is in rev by its name"),
        (
            {"goal_a_rad": GOAL[:, 0], "goal_grip_mm": 20 * GOAL[:, 1], "q_a_rad": Q[:, 0], "q_grip_mm": 20 * Q[:, 1]},
            "which signal .* is the measured position. Candidates: 'q_a_rad', 'q_grip_mm'",
        ),
        (
            {"goal_a": GOAL[:, 0], "goal_b": np.degrees(GOAL[:, 1]), "q_a": Q[:, 0], "q_b": np.degrees(Q[:, 1])},
            "are all joints of 'q_a, q_b' .* in degrees. They reach 32.91, but q_a moves by 1.11",
        ),
        ({"goal_a": GOAL[:, 0] / 6.2832, "q_a_rad": Q[:, 0]}, "follow 'goal_a' .*slopes of 5.94: it is scaled"),
        ({"action_a": (GOAL[:, 0] - 0.3) / 0.25, "q_a_rad": Q[:, 0]}, "slopes of 0.236: it is scaled"),
        ({"action_a": (GOAL[:, 0] - 0.3) / 0.5, "q_a_rad": Q[:, 0]}, "slopes of 0.472: it is scaled"),
        ({"action_a": RATE[:, 0], "q_a_rad": Q[:, 0]}, "does 'action_a' .* command velocities or duty"),
        ({"goal_vel_a": RATE[:, 0], "dq_a": RATE[:, 0]}, "no signal .* is a measured position"),
    ],
)  # fmt: skip
def test_units_and_scales_that_are_refused(tmp_path, columns, named):
    with pytest.raises(UsageError, match=named) as caught:
        imported(table(tmp_path, **columns))
    assert caught.value.hint


def test_zeros_before_the_first_reading_are_refused(tmp_path):
    begun, level = (np.arange(len(T)) >= 80)[:, None], np.array([0.5, -0.7])
    np.savez(tmp_path / "run.npz", t_s=T, goal_rad=GOAL + level, q_rad=(Q + level) * begun)
    with pytest.raises(UsageError, match="is 0 in its first 80 samples"):
        imported(tmp_path / "run.npz")


@pytest.mark.parametrize(
    ("places", "signs", "refused"),
    [([0, 1], (1, 1), False), ([0, 1], (-1, -1), False), ([0, 1], (-1, 1), False), ([1, 0], (1, 1), True),
     ([1, 0], (-1, -1), True)],
)  # fmt: skip
def test_joints_of_one_gait_keep_the_order_or_are_refused(tmp_path, places, signs, refused):
    """Joints of one wave, a tenth of a period apart: exchanged, each has another lag."""
    wave = lambda t: 0.4 * np.sin(9.0 * t) + 0.15 * np.sin(18.0 * t + 1.0)  # noqa: E731
    apart, late, noise = np.array([0.0, 0.07]), 0.16, 1e-3 * np.random.default_rng(0).standard_normal((len(T), 2))
    goal, q = (wave(T[:, None] - apart - by) * sign for by, sign in ((0.0, 1.0), (late, np.array(signs))))
    np.savez(tmp_path / "run.npz", t_s=T, goal_rad=goal[:, places], q_rad=q + noise)
    if refused:
        with pytest.raises(UsageError, match=r"order of commands in .* is ambiguous"):
            imported(tmp_path / "run.npz")
    else:
        assert imported(tmp_path / "run.npz")[1].mapping.nodes["actuator"].fields["goal"].source == ("goal_rad",)
