"""Links found from the motion of a motor with a lag that is solved here by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from sim2real.artifacts.identification import Identification, Judgement, Link, Ranged
from sim2real.errors import UsageError
from sim2real.identification.delays import DelayEvidence, _losses, find, links, lost_share, measured
from sim2real.stages.identify.stage import show

GAIN, RATE = 5.0, 8.0  # speed [rad/s] of a volt in the end, and how fast it gets there [1/s]
COMMAND_DELAY_S, NOISE_RAD, COUNT_RAD = 0.004, 1e-3, 1e-3
STEP_S, PERIOD_S = 2e-4, 0.0101
GRID = np.arange(0.0, 0.0405, 0.001)


def turned(gain, rate, volts, step_s, speed=0.0, angle=0.0):
    """Solve ``q'' = rate * (gain * u - q')`` for voltages that hold for a step each; return the angles."""
    fade, goal = np.exp(-rate * step_s), gain * volts
    # What the speed lacks decays, and is renewed by each change of the goal.
    late = lfilter([1.0], [1.0, -fade], np.concatenate([[speed - goal[0]], -np.diff(goal)]))
    moved = goal * step_s + late * (1 - fade) / rate
    return angle + np.concatenate([[0.0], np.cumsum(moved)[:-1]])


def lag(kind, n, rng):
    """Return how long messages take [s], and which are lost."""
    lost = np.zeros(n, bool)
    if kind == "gamma":
        return 0.003 + rng.gamma(2.5, 0.002, n), lost
    if kind == "bimodal":
        return np.where(rng.random(n) < 0.3, 0.017, 0.005) + rng.normal(0, 0.0007, n), lost
    if kind == "usb":
        return 0.001 + 0.016 * ((0.37 - PERIOD_S / 0.016 * np.arange(n) + 0.1 * rng.random(n)) % 1.0), lost
    if kind == "held":  # the device measures each 16 ms, and a message has its newest value
        return 0.001 + PERIOD_S * np.arange(n) % 0.016, lost
    if kind == "bursts":
        for i in range(1, n):
            lost[i] = rng.random() < (0.7 if lost[i - 1] else 0.04)
    return 0.006 + rng.normal(0, 0.0008, n), lost


def log(kind, duration_s, seed):
    """Simulate a log: commands of 50 Hz, and measurements older than their stamps say."""
    rng = np.random.default_rng(seed)
    sent = np.arange(0.0, duration_s, 0.02)
    volts = 0.5 * np.sin(2 * np.pi * rng.uniform(0.5, 3.0, 6) * sent[:, None] + rng.uniform(0, 6, 6)).sum(axis=1)
    at = np.arange(round((duration_s + 0.1) / STEP_S)) * STEP_S
    acting = volts[np.maximum(np.searchsorted(sent, at - COMMAND_DELAY_S + 1e-9, "right") - 1, 0)]
    angles = turned(GAIN, RATE, acting, STEP_S)
    t = np.arange(0.2, duration_s, PERIOD_S) + rng.uniform(0, 0.002, len(np.arange(0.2, duration_s, PERIOD_S)))
    took, lost = lag(kind, len(t), rng)
    if kind == "held":
        t = 0.2 + PERIOD_S * np.arange(len(t)) - took
    seen = np.round((np.interp(t, at, angles) + rng.normal(0, NOISE_RAD, len(t))) / COUNT_RAD) * COUNT_RAD
    same = np.append(False, np.diff(t) < 1e-9) if kind == "held" else lost
    for i in np.flatnonzero(same):
        seen[i] = seen[i - 1]
    drift = 200e-6 if kind == "drift" else 0.0
    stamps = t + took + drift * (t - t.mean())
    return SimpleNamespace(acting=acting, at=at, stamps=stamps, seen=seen, took=took, lost=lost, drift=drift)


def identify(log):
    """Find the link with a model of the same form, from a wrong start; the commands' delay is held."""
    again = np.concatenate([[False], np.diff(log.seen) == 0.0])
    start = np.array([np.log(GAIN) + 0.1, np.log(RATE) - 0.2, 0.0, 0.0])

    def angles(x):
        return turned(np.exp(x[0]), np.exp(x[1]), log.acting, STEP_S, x[2], x[3])

    def linearise(x, delay_s):
        own = angles(x)
        errors = np.interp(log.stamps[:, None] - GRID, log.at, own) - log.seen[:, None]
        slopes = [np.interp(log.stamps - delay_s, log.at, angles(x + s) - own) / 1e-3 for s in 1e-3 * np.eye(4)]
        J = np.stack(slopes, axis=1)[:, None] / NOISE_RAD
        return DelayEvidence(GRID, errors[:, None] / NOISE_RAD, J, 1e-4 * np.eye(4))

    found = find(linearise, start, 0.01, again)
    ranged = found.ranged()
    low, high = (np.array([getattr(r, end) for r in ranged]) for end in ("low95", "high95"))
    return np.array([r.value for r in ranged]), low, high, found


@pytest.mark.parametrize(
    "kind",
    ["gamma", *(pytest.param(k, marks=pytest.mark.night) for k in ("bimodal", "usb", "bursts"))],
)
def test_a_link_is_found_with_the_dynamics(kind):
    record = log(kind, 12.0, 3)
    (mean, deviation, p95), low, high, found = identify(record)
    arrived = record.took[~record.lost]
    assert mean == pytest.approx(arrived.mean(), abs=0.5e-3)
    assert deviation == pytest.approx(arrived.std(), abs=0.6e-3)
    assert p95 == pytest.approx(np.quantile(arrived, 0.95), abs=1.5e-3)
    assert lost_share(found.lost).value == pytest.approx(record.lost.mean(), rel=0.2, abs=2e-3)
    assert found.share.sum() == pytest.approx(1.0)
    assert np.all(low < [mean, deviation, p95])
    assert np.all(high > [mean, deviation, p95])


@pytest.mark.night
def test_intervals_hold_the_truth():
    took = lag("gamma", 200_000, np.random.default_rng(0))[0]
    truth, held = np.array([took.mean(), took.std(), np.quantile(took, 0.95)]), np.zeros(3)
    for seed in range(24):
        _, low, high, _ = identify(log("gamma", 3.0, seed))
        held += (low <= truth) & (truth <= high)
    assert held.min() >= 19, held  # 24 intervals of 95 % hold fewer than 20 once in 200 times


def test_a_constant_delay_has_no_jitter():
    record = log("constant", 6.0, 1)
    record.stamps += 0.006 - record.took
    mean, deviation, _ = identify(record)[0]
    assert mean == pytest.approx(0.006, abs=0.3e-3)
    assert deviation < 0.5e-3


def test_what_repeats_at_rest_is_no_loss():
    again = np.arange(1000) % 2 == 1
    assert _losses(again, np.ones(1000)).mean() < 0.1
    assert _losses(again, np.full(1000, 1e-6)).mean() == pytest.approx(0.5, abs=0.01)
    none = lost_share(_losses(np.zeros(500, bool), np.ones(500)))
    assert (none.value, none.low95) == (0.0, 0.0)
    assert 0.0 < none.high95 < 0.02


@pytest.mark.night
def test_a_problem_knows_its_links(fitted):
    (link,) = links(fitted.problem, fitted.found.x)
    delay_s = fitted.truth["sensor_delay"] + fitted.truth["actuator_delay"]
    assert link.name == "sensor_delay + actuator_delay"
    assert link.mean.value == pytest.approx(delay_s, abs=0.5e-3)
    assert link.deviation.value < 0.7e-3


def test_without_a_delay_of_the_measurements_there_is_no_link(fitted):
    with pytest.raises(UsageError, match="an identified delay"):
        measured(fitted.problem.table.with_fixed({"actuator_delay": 0.02}))


def test_links_are_kept_and_shown(tmp_path, capsys):
    number = Ranged(0.012, 0.01, 0.014)
    link = Link(
        "late + commands",
        number,
        number,
        number,
        Ranged(0.02, 0.01, 0.03),
        np.arange(3.0),
        np.full(3, 1 / 3),
    )
    found = Identification("robot", (), Judgement("accepted", ()), (), links=(link,))
    found.save(tmp_path)
    (kept,) = Identification.load(tmp_path).links
    assert (kept.mean, kept.name) == (link.mean, link.name)
    assert kept.share == pytest.approx(link.share)
    show(found)
    assert "late + commands, mean" in capsys.readouterr().out
