"""Mappings that are proposed: from names, from data, and refused where neither decides."""

import followers
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.log import import_file
from sim2real.log.importing.files.foreign import joined, open_foreign
from sim2real.log.importing.importer import import_opened
from sim2real.log.importing.mapping import load_mapping, to_toml
from sim2real.log.importing.proposal import propose
from sim2real.log.importing.quantities import ImportHints


@pytest.fixture(scope="module")
def recorded():
    return followers.motion()


def columns(t, goal, q, stamp="t_s", names=("goal_{}", "q_{}")):
    joints = ("pan", "lift", "grip")
    told = {names[0].format(j): goal[:, i] for i, j in enumerate(joints)}
    return {stamp: t, **told, **{names[1].format(j): q[:, i] for i, j in enumerate(joints)}}


def proposed(path, **asked):
    return propose(open_foreign(path), ImportHints("rig", **asked))


def check(path, found, goal, q):
    episode = import_file(path, found.mapping)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q, atol=1e-6)
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal, atol=1e-6)
    return episode


def test_named_columns_become_vectors_of_joints(tmp_path, recorded):
    t, goal, q = recorded
    path = followers.write_csv(tmp_path / "run.csv", columns(*recorded))
    found = proposed(path)
    assert found.joints == ("pan", "lift", "grip")
    episode = check(path, found, goal, q)
    np.testing.assert_allclose(episode.steps["sensor"].begun_s, t, atol=1e-6)
    assert "30 ms later" in "\n".join(found.evidence)


def test_the_mapping_file_is_the_proposal(tmp_path, recorded):
    path = followers.write_csv(tmp_path / "run.csv", columns(*recorded))
    found = proposed(path)
    (tmp_path / "import.toml").write_text(to_toml(found.mapping, found.evidence))
    assert load_mapping(tmp_path / "import.toml").nodes == found.mapping.nodes


@pytest.mark.parametrize("seed", range(4))
def test_orders_signs_and_degrees_are_found(tmp_path, recorded, seed):
    t, goal, q = recorded
    rng = np.random.default_rng(seed)
    order, sign = rng.permutation(3), rng.choice([-1.0, 1.0], 3)
    degrees = rng.integers(2)
    told = (goal * sign)[:, order] * (np.degrees(1.0) if degrees else 1.0)
    np.savez(tmp_path / "run.npz", t_s=t, cmd=told, q_rad=q)
    check(tmp_path / "run.npz", proposed(tmp_path / "run.npz"), goal, q)


def test_without_names_what_follows_was_measured(tmp_path, recorded):
    t, goal, q = recorded
    np.savez(tmp_path / "run.npz", t=t, a=q, b=goal)
    found = proposed(tmp_path / "run.npz")
    assert "'a' follows 'b'" in found.evidence[0]
    check(tmp_path / "run.npz", found, goal, q)


def test_anonymous_columns_are_paired(tmp_path, recorded):
    t, goal, q = recorded
    mixed = {"x0": goal[:, 1], "x1": q[:, 0], "x2": q[:, 1], "x3": goal[:, 2], "x4": goal[:, 0], "x5": q[:, 2]}
    path = followers.write_csv(tmp_path / "run.csv", {"t_s": t, **mixed})
    check(path, proposed(path), goal, q)


@pytest.mark.parametrize(("stamps", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns"), (1.0, "s")])
def test_units_of_stamps_by_their_distance(tmp_path, recorded, stamps, unit):
    t, goal, q = recorded
    np.savez(tmp_path / "run.npz", clock=(t + 7.0) * stamps, goal=goal, q=q)
    found = proposed(tmp_path / "run.npz")
    assert found.mapping.nodes["sensor"].stamp_unit == unit


def test_a_wall_clock_in_seconds(tmp_path, recorded):
    t, goal, q = recorded
    np.savez(tmp_path / "run.npz", stamp=1.7e9 + t, goal=goal, q=q)
    assert proposed(tmp_path / "run.npz").mapping.nodes["sensor"].stamp_unit == "s"


def test_clocks_of_their_own_are_aligned(tmp_path, recorded):
    t, goal, q = recorded
    np.savez(tmp_path / "run.npz", t_cmd_s=t + 3.0, cmd=goal, t_meas_s=t[:-7], q_rad=q[:-7])
    found = proposed(tmp_path / "run.npz")
    period_s = 1 / followers.RATE_HZ
    # One period of delay is left; the rest of the true 30 ms is not known from clocks.
    expected = followers.LATE_S - period_s - 3.0
    assert found.mapping.nodes["actuator"].stamp_offset == pytest.approx(expected, abs=1e-3)
    assert "clock" in "\n".join(found.evidence)
    episode = import_file(tmp_path / "run.npz", found.mapping)
    first = episode.steps["actuator"].begun_s[0] - episode.steps["sensor"].begun_s[0]
    assert first == pytest.approx(followers.LATE_S - period_s, abs=1e-3)


def test_files_of_one_recording_are_joined(tmp_path, recorded):
    t, goal, q = recorded
    np.savez(tmp_path / "commands.npz", t_s=t, cmd=goal)
    np.savez(tmp_path / "states.npz", t_s=t[5:], q_rad=q[5:])
    file = joined([open_foreign(tmp_path / "commands.npz"), open_foreign(tmp_path / "states.npz")])
    found = propose(file, ImportHints("rig"))
    episode = import_opened(file, found.mapping)
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q[5:])
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"], goal)
    assert list(episode.metadata["source"]["beside"]) == ["states.npz"]


def test_missing_numbers_and_repeated_stamps_get_a_named_policy(tmp_path, recorded):
    t, goal, q = (x.copy() for x in recorded)
    q[100:103, 1] = np.nan
    t[500] = t[499]
    path = followers.write_csv(tmp_path / "run.csv", columns(t, goal, q))
    found = proposed(path)
    assert (found.mapping.nodes["sensor"].missing, found.mapping.nodes["sensor"].repeated) == ("drop", "first")
    assert "3 of 2400 samples lack a number" in "\n".join(found.evidence)
    episode = import_file(path, found.mapping)
    assert len(episode.steps["sensor"]) == len(t) - 4
    assert episode.metadata["source"]["dropped"] == {"actuator": 1, "sensor": 4}
    kept = np.setdiff1d(np.arange(len(t)), [100, 101, 102, 500])
    np.testing.assert_allclose(episode.outputs["sensor"]["position"], q[kept])


def test_a_velocity_is_taken_where_it_is_the_rate_of_the_positions(tmp_path, recorded):
    t, goal, q = recorded
    rate = np.gradient(np.stack([np.convolve(x, np.ones(9) / 9, "same") for x in q.T], 1), t, axis=0)
    np.savez(tmp_path / "run.npz", t_s=t, goal=goal, q_rad=q, dq_deg_s=-np.degrees(rate))
    found = proposed(tmp_path / "run.npz")
    np.testing.assert_allclose(found.mapping.nodes["sensor"].fields["velocity"].scale, -1 / np.degrees(1.0), rtol=1e-6)
    np.savez(tmp_path / "other.npz", t_s=t, goal=goal, q_rad=q, dq=np.cos(3 * t)[:, None] * [1.0, 2.0, 3.0])
    other = proposed(tmp_path / "other.npz")
    assert "velocity" not in other.mapping.nodes["sensor"].fields
    assert "skipped" in "\n".join(other.evidence)


def test_names_of_a_models_joints_choose_columns(tmp_path, recorded):
    _, goal, q = recorded
    path = followers.write_csv(tmp_path / "run.csv", columns(*recorded))
    found = proposed(path, joints=("grip_joint", "pan_joint", "lift_joint"))
    assert found.joints == ("grip_joint", "pan_joint", "lift_joint")
    check(path, found, goal[:, [2, 0, 1]], q[:, [2, 0, 1]])


def test_ranges_of_joints_tell_degrees(tmp_path, recorded):
    t, goal, q = recorded
    ranges = np.array([[-1.2, 1.2]] * 3)
    np.savez(tmp_path / "run.npz", t_s=t, goal=np.degrees(goal), q=np.degrees(q))
    found = proposed(tmp_path / "run.npz", joints=("a", "b", "c"), ranges=ranges)
    check(tmp_path / "run.npz", found, goal, q)
    assert "outside of the joints' ranges" in "\n".join(found.evidence)


def with_other(recorded, **arrays):
    t, goal, q = recorded
    return {"t_s": t, "goal": goal, "q": q, **{name: make(*recorded) for name, make in arrays.items()}}


@pytest.mark.parametrize(
    ("arrays", "named"),
    [
        ({"position": lambda t, goal, q: q + 0.1}, ["measured position", "'q'", "'position'"]),
        ({"target": lambda t, goal, q: goal + 0.1}, ["command", "'goal'", "'target'"]),
        ({"time": lambda t, goal, q: t + 0.1}, ["which stamps", "t_s", "time"]),
        ({"q": lambda t, goal, q: 12.0 * q}, ["radians or degrees", "rad, deg"]),
        ({"q": lambda t, goal, q: q[:, :2]}, ["3 columns for 2 joints"]),
        ({"goal": lambda t, goal, q: goal[:5], "q": lambda t, goal, q: q[:5], "t_s": lambda t, goal, q: t[:5]},
         ["4 samples"]),
        ({"t_s": lambda t, goal, q: np.where(np.arange(len(t)) == 700, t - 1.0, t)}, ["earlier than the one before"]),
    ],
)  # fmt: skip
def test_what_is_ambiguous_is_refused_with_its_candidates(tmp_path, recorded, arrays, named):
    np.savez(tmp_path / "run.npz", **with_other(recorded, **arrays))
    with pytest.raises(UsageError) as refused:
        proposed(tmp_path / "run.npz")
    for part in named:
        assert part in str(refused.value)


def test_without_stamps_the_rate_must_be_said(tmp_path, recorded):
    _, goal, q = recorded
    np.savez(tmp_path / "run.npz", goal=goal, q=q)
    with pytest.raises(UsageError, match="--rate-hz"):
        proposed(tmp_path / "run.npz")
    found = proposed(tmp_path / "run.npz", rate_hz=200.0)
    assert found.mapping.nodes["sensor"].rate_hz == 200.0


def test_names_that_the_data_contradicts_are_refused(tmp_path, recorded):
    t, goal, q = recorded
    wrong = columns(t, goal[:, [1, 0, 2]], q)
    with pytest.raises(UsageError, match="contradict each other"):
        proposed(followers.write_csv(tmp_path / "run.csv", wrong))


@pytest.mark.parametrize("moved", [(), (0,)])
def test_a_goal_in_radians_is_a_goal_although_joints_stand_still(tmp_path, recorded, moved):
    t, goal, q = recorded
    still = np.zeros_like(goal)
    still[:, moved] = goal[:, moved]
    seen = still + 1e-3 * np.random.default_rng(0).standard_normal(q.shape)
    np.savez(tmp_path / "run.npz", t_s=t, q_rad=seen, goal_rad=still)
    check(tmp_path / "run.npz", proposed(tmp_path / "run.npz"), still, seen)


def test_what_goes_with_a_goal_in_mit_mode_is_taken_by_name(tmp_path, recorded):
    t, goal, q = recorded
    more = {
        "dq_des": np.gradient(goal, t, axis=0),
        "tau_ff": 0.1 * goal,
        "kp": 20.0 + 0.0 * goal,
        "kd": np.float64(0.5),
    }
    np.savez(tmp_path / "run.npz", t_s=t, q_des=goal, q=q, tau=q, **more)
    fields = proposed(tmp_path / "run.npz").mapping.nodes["actuator"].fields
    assert {name: how.source for name, how in fields.items()} == {
        "goal": ("q_des",), "goal_velocity": ("dq_des",), "torque": ("tau_ff",), "kp": ("kp",), "kd": ("kd",)
    }  # fmt: skip
