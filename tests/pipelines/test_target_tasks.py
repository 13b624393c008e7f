"""The further tasks of the arms: aims, reward, scores, and a tracker that plans ahead on a hidden arm."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.stages.load import load_module, load_robot

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches.hidden import arms
from benches.hidden.targets import FIGURE_HZ, FIGURE_M, arrival, figure_of_eight, tasked

THERE = {"arm": (0.5, 0.4, 0.3), "so101": (0.5, -0.8, 1.0, -1.2, 0.0, 0.0)}
STEPS = 0.02 * np.arange(200)


@pytest.fixture(params=THERE)
def arm(request):
    """An arm: name, robot, kinematics, and a pose."""
    name, robot = request.param, load_robot(request.param)
    module = load_module(name, "robot")
    return SimpleNamespace(name=name, robot=robot, tip_of=module.tip_of, there=np.array(THERE[name]))


def joints_at(arm, point, begin):
    """Return joint angles within the goals' limits whose tip is nearest to a point, and its distance [m]."""
    low, high = (np.array(end) for end in (arm.robot.drive.servos.low, arm.robot.drive.servos.high))
    q, small = np.array(begin, float), 1e-6 * np.eye(len(begin))
    for _ in range(60):
        here = arm.tip_of(q)
        off, slopes = point - here, (arm.tip_of(q + small) - here).T / 1e-6
        if np.abs(off).max() < 1e-9:
            break
        step = slopes.T @ np.linalg.solve(slopes @ slopes.T + 1e-6 * np.eye(3), off)
        q = np.clip(q + np.clip(step, -0.2, 0.2), low, high)
    return q, float(np.linalg.norm(point - arm.tip_of(q)))


@pytest.mark.parametrize(
    ("turn", "sideways", "up"),
    [
        (0.0, 0.0, 0.0),
        (0.25, 0.5**0.5, 1.0),
        (0.5, 1.0, 0.0),
        (0.75, 0.5**0.5, -1.0),
        (1.0, 0.0, 0.0),
        (1.5, -1.0, 0.0),
    ],
)
def test_the_figure_of_eight_goes_to_either_side_twice_as_slowly_as_up_and_down(turn, sideways, up):
    """``turn``: of pi; the centre is on the y axis, so sideways is along -x."""
    centre = np.array([0.0, 0.2, 0.3])
    expected = centre + np.array([-FIGURE_M[0] * sideways, 0.0, FIGURE_M[1] * up])
    for phase in (0.0, 0.5, 2.0):
        t_s = (turn * np.pi - phase) / (2 * np.pi * FIGURE_HZ)
        numbers = np.array([*centre, phase])
        np.testing.assert_allclose(figure_of_eight(numbers, t_s), expected, atol=1e-12)
        np.testing.assert_allclose(figure_of_eight(numbers, t_s + 1 / FIGURE_HZ), expected, atol=1e-12)
        np.testing.assert_allclose(figure_of_eight(jnp.asarray(numbers), jnp.float32(t_s)), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("distance_mm", "settled_s", "success", "overshoot_mm"),
    [
        ([50, 30, 9, 5, 3, 2], 2.0, 1.0, 9.0),
        ([50, 9, 15, 12, 9, 2], 4.0, 1.0, 15.0),
        ([50, 9, 3, 3, 3, 11], 5.0, 0.0, 11.0),
        ([50, 40, 30, 30, 30, 30], 5.0, 0.0, np.nan),
        ([5, 5, 5, 5, 5, 5], 0.0, 1.0, 5.0),
    ],
)
def test_a_tip_that_passes_by_has_not_arrived(distance_mm, settled_s, success, overshoot_mm):
    found = arrival(np.arange(6.0), 1e-3 * np.array(distance_mm))
    assert (found["settled_s"], found["success"]) == (settled_s, success)
    assert 1e3 * found["overshoot_m"] == pytest.approx(overshoot_mm, nan_ok=True)


def test_scores_compare_with_the_target_of_each_time(arm):
    robot = tasked(arm.robot, "follow")
    numbers, q, path = robot.task.at_rest(1).aim, arm.there, []
    for t_s in STEPS:
        q, _ = joints_at(arm, figure_of_eight(numbers, t_s), q)
        path.append(q)
    path = np.array(path)
    aims = np.stack([robot.task.aim.at(numbers, t_s) for t_s in STEPS])
    states = {f"aim[{i}]": aims[:, i] for i in range(6)}

    def scored(late):
        rows = np.roll(path, late, axis=0)
        return robot.task.score(STEPS, states | {f"position[{i}]": rows[:, i] for i in range(rows.shape[1])})

    exact, late = scored(0), scored(5)
    assert (exact["success"], exact["error_m"]) == (1.0, pytest.approx(0.0, abs=1e-4))
    speed_m_s = np.linalg.norm(np.diff(aims[:, :3], axis=0), axis=1).mean() / 0.02
    assert late["error_m"] == pytest.approx(0.1 * speed_m_s, rel=0.2)


def test_goals_that_are_ahead_by_delay_and_lag_follow_the_figure_on_a_hidden_arm_and_others_do_not(arm):
    robot, hidden = tasked(arm.robot, "follow"), replace(arms.HiddenArm.draw(arm.name, 1, 2), load_kg=0.0)
    numbers, q = robot.task.at_rest(0).aim, arm.there
    path = []
    for t_s in np.arange(0.0, 1 / FIGURE_HZ + 1e-9, 0.02):
        q, _ = joints_at(arm, figure_of_eight(numbers, t_s), q)
        path.append(q)
    path = np.array(path[: round(50 / FIGURE_HZ)])

    def error_m(lead_s):
        at = [round(50 * (k / 50 + lead_s)) % len(path) for k in range(150)]
        return arms.judge(hidden, robot, "follow", lambda reading, k: path[at[k]], 0, 3.0)["error_m"]

    errors = {lead_s: error_m(lead_s) for lead_s in (0.0, 0.08, 0.14, 0.3)}
    best = min(errors, key=errors.get)
    assert best in (0.08, 0.14)
    assert errors[0.0] > 1.3 * errors[best]
    assert errors[0.3] > 1.8 * errors[best]
