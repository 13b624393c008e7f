"""Commands that repeat: which lag and sign are taken, and what is refused because no data can tell it."""

import numpy as np
import pytest
from foreign_robots import csv, goal_scales, imported, servo

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import following

T = np.arange(0, 10, 0.01)
NOISE = 0.001 * np.random.default_rng(0).standard_normal(len(T))
SHAPES = {
    "sine": lambda f, t: 0.5 * np.sin(2 * np.pi * f * t),
    "sine about a level": lambda f, t: 0.3 + 0.5 * np.sin(2 * np.pi * f * t + 1),
    "triangle": lambda f, t: 0.4 * np.arcsin(np.sin(2 * np.pi * f * t)),
    "gait": lambda f, t: 0.4 * np.sin(2 * np.pi * f * t + 1) + 0.2 * np.sin(4 * np.pi * f * t),
    "rest first": lambda f, t: 0.5 * np.sin(2 * np.pi * f * np.maximum(t - 1.0, 0.0)),
}


def log(tmp_path, goal, q):
    return csv(tmp_path / "run.csv", {"t_s": T, "goal_a_rad": goal, "q_a_rad": q + NOISE})


def lag_ms(found):
    line = next(s for s in found.evidence if "ms later, slope" in s)
    return int(line.split(" ms later")[0].split()[-1])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("f", [0.4, 0.6, 1.0, 1.25, 2.0, 3.0])
def test_a_command_that_repeats_keeps_its_sign_and_the_least_lag(tmp_path, shape, f):
    goal = SHAPES[shape](f, T)
    _, found = imported(log(tmp_path, goal, servo(T, goal)))
    assert goal_scales(found) == [1.0]
    # The servo's delay is 86 ms at low frequencies, and less at high ones.
    assert 70 <= lag_ms(found) <= 88


@pytest.mark.parametrize(
    ("shape", "f"),
    [("sine", 0.3), ("gait", 1.0), ("sine about a level", 1.7), ("sine about a level", 2.5), ("rest first", 1.0)],
)
def test_a_reversed_sign_is_claimed_where_the_data_tells_it(tmp_path, shape, f):
    goal = SHAPES[shape](f, T)
    _, found = imported(log(tmp_path, goal, -servo(T, goal)))
    assert goal_scales(found) == [-1.0]
    assert 70 <= lag_ms(found) <= 88


def square(f, t):
    return 0.4 * np.sign(np.sin(2 * np.pi * f * t + 0.3))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("shape", "f", "late"),
    [("sine", 0.55, 0.05), ("sine", 1.0, 0.05), ("sine", 3.0, 0.25), ("triangle", 1.7, 0.4), ("square", 2.5, 0.3)],
)
def test_a_sign_that_no_data_can_tell_is_refused_with_both_candidates(tmp_path, shape, f, late, sign):
    """One joint, one tone, no start from rest: the opposite sign half a period later is the same log."""
    wave = SHAPES.get(shape, square)
    path = log(tmp_path, wave(f, T), sign * wave(f, T - late))
    if sign > 0 and late <= 0.3 and late + 0.5 / f > 0.6:  # no servo is 959 ms late
        _, found = imported(path)
        assert goal_scales(found) == [1.0]
        assert "which no servo is: the sign of the file is kept" in "\n".join(found.evidence)
        return
    with pytest.raises(
        UsageError, match=r"signs are ambiguous: a follows \d+ ms later, or with the opposite sign \d+ ms"
    ):
        imported(path)
    _, found = imported(path, as_told=True)
    assert goal_scales(found) == [1.0]
    assert "the signs of the file are kept" in "\n".join(found.evidence)


@pytest.mark.parametrize("f", [0.6, 1.0, 3.0])
def test_a_mapping_that_is_right_is_not_contradicted(f):
    goal = SHAPES["sine"](f, T)
    told = goal[:, None], (servo(T, goal) + NOISE)[:, None]
    assert not evidence.contradictions((T, T), *told)


def test_other_joints_tell_a_sign_that_one_alone_leaves_open(tmp_path):
    """At 3 Hz a reversed joint that is 280 ms late looks like one that is 113 ms late, unlike its neighbour."""
    late = 0.28
    goal = np.stack([SHAPES["sine"](3.0, T), SHAPES["gait"](0.8, T)], axis=1)
    q = np.stack([-SHAPES["sine"](3.0, T - late), SHAPES["gait"](0.8, T - late)], axis=1)
    columns = {"t_s": T, "goal_a": goal[:, 0], "goal_b": goal[:, 1], "q_a": q[:, 0] + NOISE, "q_b": q[:, 1] - NOISE}
    with pytest.raises(
        UsageError, match="signs are ambiguous: a follows 113 ms later, or with the opposite sign 280 ms"
    ):
        imported(csv(tmp_path / "run.csv", columns))


def test_joints_of_other_periods_exclude_the_wrong_sign(tmp_path):
    """Each joint alone fits with either sign; only one lag fits all three."""
    waves, late = [(2.0, 1), (2.7, -1), (1.3, 1)], 0.07
    goal = np.stack([SHAPES["sine"](f, T) for f, _ in waves], axis=1)
    q = np.stack([sign * SHAPES["sine"](f, T - late) + NOISE for f, sign in waves], axis=1)
    columns = {"t_s": T} | {f"{kind}_{'abc'[i]}": x[:, i] for kind, x in (("goal", goal), ("q", q)) for i in range(3)}
    path = csv(tmp_path / "run.csv", columns)
    with pytest.raises(UsageError, match="signs are ambiguous: b follows"):
        imported(path)  # the positive sign of b has the longer lag
    columns["q_b"] = -columns["q_b"]
    _, found = imported(csv(tmp_path / "right.csv", columns))
    assert goal_scales(found).tolist() == [1.0, 1.0, 1.0]


def test_the_order_of_commands_that_look_alike_is_refused_without_names(tmp_path):
    """Two joints of one gait, a quarter of its time apart, are exchanged as likely as they are not."""
    goal = np.stack([SHAPES["sine"](1.0, T), SHAPES["sine"](1.0, T - 0.25), SHAPES["sine"](1.0, T - 0.6)], axis=1)
    q = np.stack([servo(T, column) + NOISE for column in goal.T], axis=1)
    np.savez(tmp_path / "right.npz", t_s=T, goal=goal, q=q)
    _, found = imported(tmp_path / "right.npz")
    assert found.mapping.nodes["actuator"].fields["goal"].source == ("goal",)
    np.savez(tmp_path / "wrong.npz", t_s=T, goal=goal[:, [1, 2, 0]], q=q)
    with pytest.raises(UsageError, match=r"(order of commands|signs).* ambiguous"):
        imported(tmp_path / "wrong.npz")


def test_a_drift_tells_the_sign_and_what_is_beside_it_the_lag():
    waves = [0.3 * np.sin(2 * np.pi * 2.0 * (T - late)) + 0.8 * (T - late) for late in (0.0, 0.2)]
    found = following(waves[0][:, None], (-waves[1] + NOISE)[:, None], 0.01)
    assert found.r[0, 0] < -0.9
    assert float(found.lag_s[0, 0]) == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_exchanged_labels_are_refused(tmp_path, seed):
    rng = np.random.default_rng(seed)
    goal = 0.12 * np.sin(2 * np.pi * np.outer(T, rng.uniform(0.1, 2, 8)) + rng.uniform(0, 6, 8)).sum(axis=1)
    with pytest.raises(UsageError, match=r"move before their commands: a by 8\d ms"):
        imported(csv(tmp_path / "run.csv", {"t_s": T, "goal_a_rad": servo(T, goal), "q_a_rad": goal}))
