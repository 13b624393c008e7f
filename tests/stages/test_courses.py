"""Whole episodes beside simulations: what counts as the same course, and what does not."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.artifacts.deployment import Deployment, Replay, Scores
from sim2real.graph.episode import Episode, Steps
from sim2real.stages.deploy.trajectories import courses, lost_s, off_course

T = np.arange(0.0, 10.0, 0.02)
ROW = Replay("hinge", "rad", 0.1, {}, 0.007, column="th", free_run=0.01)
UNITS = {"th": "rad", "x": "m"}


def swing(rest, late_s=0.0, creep=0.0, sign=1.0):
    """From pi to a place of rest near 0, on one side or the other, within 1 s; from there it creeps [rad/s]."""
    share = np.clip(T - late_s, 0.0, 1.0)
    angle = np.pi + (rest - np.pi) * share + creep * np.maximum(T - 1.0, 0.0)
    return angle if sign > 0 else 2 * np.pi - angle


def sentences(real, simulated, row=ROW, column="th"):
    own = courses([(T, {column: real})], [(T, {column: s}) for s in simulated], UNITS, [0.0])
    return list(off_course(Deployment((Scores({}),), (), replay=(replace(row, column=column),), courses=own), False))


SIMULATED = [swing(rest, late_s) for rest, late_s in ((0.0, 0.0), (0.01, 0.02), (0.02, 0.04), (0.015, 0.01))]


@pytest.mark.parametrize(
    ("real", "simulated", "said"),
    [
        (swing(0.01), SIMULATED, ()),
        (swing(0.04), SIMULATED, ()),  # within three times the free run's error
        (swing(0.01, late_s=0.1), SIMULATED, ()),
        (swing(0.01) + 2 * np.pi, SIMULATED, ()),  # another turn
        (swing(-0.01, sign=-1.0), SIMULATED, ()),  # the other way round to the same place
        (swing(0.2), SIMULATED, ("0.18 rad or more beside all simulations",)),
        (swing(-0.2, sign=-1.0), SIMULATED, ("0.18 rad or more beside all simulations",)),
        # The robot rests, its simulations creep through where it rests, and the reverse.
        (swing(0.04), [swing(0.04 - 0.006 * k, creep=0.009) for k in (0, 5, 9)],
         ("moves by 0 rad in the second half, in each simulation of the policy by 0.045 rad or more",)),
        (swing(0.0, creep=0.009), SIMULATED,
         ("beside all simulations", "in the second half, in no simulation of the policy by more than 0 rad")),
        (swing(0.04), [swing(0.02, creep=0.009), swing(0.06)], ()),  # one of them rests, too
    ],
)  # fmt: skip
def test_courses_are_off_where_no_simulation_goes(real, simulated, said):
    found = sentences(real, simulated)
    assert len(found) == len(said)
    assert all(part in sentence for part, sentence in zip(said, found, strict=True))


def test_a_slide_has_no_turns():
    off = [s + 2 * np.pi for s in SIMULATED]
    assert not sentences(swing(0.01), off)
    assert "6.3 m or more beside" in sentences(swing(0.01), off, replace(ROW, unit="m"), "x")[0]


@pytest.mark.parametrize("row", [replace(ROW, expected=None), replace(ROW, column="other")])
def test_without_an_expected_error_nothing_is_judged(row):
    own = courses([(T, {"th": swing(0.5)})], [(T, {"th": s}) for s in SIMULATED], UNITS, [0.0])
    assert not list(off_course(Deployment((Scores({}),), (), replay=(row,), courses=own), False))


def test_time_is_lost_in_steps_of_two_periods_or_more():
    at = np.arange(0, 4_000_000, 20_000)
    late = np.where(at >= 2_000_000, at + 400_000, at + 5_000 * (at == 1_000_000))  # one pause, and one late step
    nodes = {
        name: Steps(scheduled=t, start=t, woken=t, ts_overwrite=0 * t - 1, end=t + 1000, drift=0 * t)
        for name, t in (("sensor", at), ("agent", late))
    }
    recorded = Episode(steps=nodes, messages={}, outputs={})
    assert lost_s(recorded, ["sensor"]) == 0.0
    assert lost_s(recorded, ["sensor", "agent"]) == pytest.approx(0.4)


def test_each_episode_is_beside_its_own_simulations():
    real = [(T, {"th": swing(rest)}) for rest in (0.0, 1.0)]
    simulated = [(T[::2] + 0.005, {"th": swing(float(k % 2))[::2], "thdot": T[::2]}) for k in range(8)]
    rows = courses(real, simulated, UNITS, [0.0] * len(real))
    assert [r.episode for r in rows] == [0, 1]
    assert max(r.beside for r in rows) < 0.01
