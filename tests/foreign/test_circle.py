"""Angles on a circle: turns are counted, of positions and of goals, and what cannot turn is refused."""

import numpy as np
import pytest
from foreign_robots import csv, goal_scales, imported, servo

from sim2real.errors import UsageError
from sim2real.log import ImportMapping, import_file, load_mapping
from sim2real.log.importing.files.foreign import open_foreign
from sim2real.log.importing.importer import import_opened
from sim2real.log.importing.mapping import to_toml
from sim2real.stages.import_logs.stage import description_of_model, proposed

T = np.arange(0, 16, 0.01)
GOAL = 0.8 * T + 0.4 * np.sin(2 * T) + 0.3 * np.sin(5.3 * T)
Q = servo(T, GOAL) + 1e-3 * np.random.default_rng(0).standard_normal(len(T))
SEAM = np.pi + 0.3 * np.sin(3 * T) + 0.2 * np.sin(1.1 * T)
AT_SEAM = servo(T, SEAM) + 2e-3 * np.random.default_rng(1).standard_normal(len(T))


def within(x, low=-np.pi):
    return (x - low) % (2 * np.pi) + low


def check(episode, found, q, sign=1.0):
    position, goal = episode.outputs["sensor"]["position"][:, 0], episode.outputs["actuator"]["goal"][:, 0]
    np.testing.assert_allclose(position - position[0], q - q[0], atol=1e-5)
    assert np.abs(goal - position).max() < 0.6
    assert np.sign(goal_scales(found)) == [sign]
    assert "turn" in "\n".join(found.evidence)


@pytest.mark.parametrize(
    ("goal", "q", "unit", "truth"),
    [
        (within(GOAL), within(Q), "", Q),
        (within(GOAL, 0.0), within(Q, 0.0), "", Q),
        (np.degrees(within(GOAL)), np.degrees(within(Q)), "", Q),
        (np.degrees(within(GOAL, 0.0)), np.degrees(within(Q, 0.0)), "", Q),
        (within(-GOAL), within(-Q), "", -Q),
        (np.degrees(within(GOAL)), within(Q), "", Q),
        (within(GOAL, 0.0), within(Q), "_rad", Q),
        (within(GOAL), Q, "_rad", Q),
        (GOAL, within(Q), "_rad", Q),
        (within(SEAM), within(AT_SEAM), "", AT_SEAM),
        (within(SEAM, 0.0), within(AT_SEAM), "", AT_SEAM),
    ],
)
def test_turns_are_counted(tmp_path, goal, q, unit, truth):
    path = csv(tmp_path / "run.csv", {"t_s": T, f"goal_pan{unit}": goal, f"q_pan{unit}": q})
    check(*imported(path), truth)


def test_a_reversed_joint_that_turns(tmp_path):
    path = csv(tmp_path / "run.csv", {"t_s": T, "goal_pan": within(-GOAL), "q_pan": within(Q)})
    check(*imported(path), Q, -1.0)


def test_the_mapping_file_counts_turns_in_a_part_too(tmp_path):
    path = csv(tmp_path / "run.csv", {"t_s": T, "goal_pan": within(GOAL), "q_pan": within(Q)})
    whole, found = imported(path)
    (tmp_path / "import.toml").write_text(to_toml(found.mapping))
    assert load_mapping(tmp_path / "import.toml").nodes == found.mapping.nodes
    part = import_file(path, tmp_path / "import.toml", samples=slice(900, 1000))
    np.testing.assert_allclose(part.outputs["sensor"]["position"], whole.outputs["sensor"]["position"][900:1000])


def test_a_mapping_that_does_not_count_turns_is_refused(tmp_path):
    path = csv(tmp_path / "run.csv", {"t_s": T, "q_pan": within(Q)})
    field = {"source": "q_pan", "unit": "rad"}
    nodes = {"sensor": {"stamps": "t_s", "fields": {"position": field}}}
    with pytest.raises(UsageError, match=r"(?s)jumps by 2 pi at the end of a turn.*turn = 6.28"):
        import_file(path, ImportMapping.from_dict({"pipeline": "x", "nodes": nodes}))
    field["turn"] = 2 * np.pi
    episode = import_file(path, ImportMapping.from_dict({"pipeline": "x", "nodes": nodes}))
    assert np.abs(np.diff(episode.outputs["sensor"]["position"])).max() < 0.1


@pytest.mark.parametrize("end", [3.0, np.pi])
def test_a_joint_that_is_sent_from_end_to_end_does_not_turn(tmp_path, end):
    goal = np.where((T % 4) < 2, -end, end)
    q = servo(T, goal, wn=5.0)
    episode, _ = imported(csv(tmp_path / "run.csv", {"t_s": T, "goal_pan_rad": goal, "q_pan_rad": q}))
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"][:, 0], goal, atol=1e-6)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"][:, 0], q, atol=1e-6)


def test_a_joint_with_a_range_does_not_turn(tmp_path):
    path = csv(tmp_path / "run.csv", {"t_s": T, "goal_pan": within(GOAL), "q_pan": within(Q)})
    with pytest.raises(UsageError, match=r"jumps by a turn, but the range of its joint is -1\.5 to 1\.5 rad"):
        imported(path, joints=("pan",), ranges=np.array([[-1.5, 1.5]]))


RAIL = """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"{}/><geom size=".1" mass="1"/>
<body><joint name="pan"/><geom size=".1" pos=".2 0 0" mass="1"/></body></body></worldbody></mujoco>"""


def of_rail(tmp_path, values, joints, limits=""):
    (tmp_path / "rail.xml").write_text(RAIL.format(limits))
    np.savez(tmp_path / "run.npz", **values)
    file = open_foreign(tmp_path / "run.npz")
    mapping, text = proposed(file, description_of_model(tmp_path / "rail.xml", "rail", joints))
    return import_opened(file, mapping), text


def test_turns_of_a_slide_are_not_counted(tmp_path):
    """A carriage that goes back to where it began, by what would be a turn, was not there for a while."""
    goal = np.mod(0.8 * T, 2 * np.pi)
    with pytest.raises(UsageError, match=r"changes by 6.2\d* m before sample"):
        of_rail(tmp_path, {"t_s": T, "goal": goal[:, None], "q": goal[:, None]}, ("x",))


def test_turns_of_a_hinge_on_a_slide(tmp_path):
    x = 0.5 * np.sin(1.7 * T) + 0.2 * np.sin(4.1 * T)
    q = np.stack([servo(T, x), within(Q)], axis=1)
    episode, text = of_rail(tmp_path, {"t_s": T, "goal": np.stack([x, within(GOAL)], axis=1), "q": q}, ("x", "pan"))
    position, goal = episode.outputs["sensor"]["position"], episode.outputs["actuator"]["goal"]
    np.testing.assert_allclose(position[:, 0], q[:, 0], atol=1e-9)
    np.testing.assert_allclose(position[:, 1] - position[0, 1], Q - Q[0], atol=1e-5)
    np.testing.assert_allclose(goal[:, 0], x, atol=1e-9)
    assert np.abs(goal - position).max() < 0.6
    assert "q[:,1] jumps by a turn" in text
    assert "x slides" in text


@pytest.mark.parametrize(("limits", "scale"), [("", 250.0), (' range="-.3 .3"', 3.0)])
def test_a_slide_that_is_not_in_metres(tmp_path, limits, scale):
    x = scale * (0.5 * np.sin(1.7 * T) + 0.2 * np.sin(4.1 * T))[:, None]
    with pytest.raises(UsageError, match=r"(?s)x slides, but 'q.*' in .* is not in metres.*0.001 for mm"):
        of_rail(tmp_path, {"t_s": T, "goal": x, "q": servo(T, x[:, 0])[:, None]}, ("x",), limits)
