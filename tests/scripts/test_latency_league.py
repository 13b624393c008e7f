"""The latency league: its servo, its links, its methods, and its rows and table."""

import argparse
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches.latency import bench, links, methods
from page_tables.latency import latency


def test_the_servo_follows_a_step_as_a_second_order_system_that_starts_late():
    """Without friction, against the solution of ``J q'' = kp (goal - q) - d q'``, underdamped."""
    kp, damping, inertia = 20.0, 0.9, 0.021
    servo = {"kp": kp, "damping": damping, "armature": inertia - 0.001, "friction": 1e-9}
    for step_s in (2.5e-4, 1e-3):
        angles = links.motion(np.array([0.0, 0.1]), np.array([0.0, 0.3]), 0.5, step_s, **servo)
        t = np.maximum(step_s * np.arange(len(angles)) - 0.1, 0.0)
        a, b = np.roots([inertia, damping, kp])
        expected = (0.3 * (1 - (b * np.exp(a * t) - a * np.exp(b * t)) / (b - a))).real
        speed = np.abs(np.gradient(expected, step_s)).max()
        assert np.abs(angles - expected).max() < 0.02 * step_s * speed, f"off by 2 % of a step of {step_s} s"


@pytest.mark.parametrize("kind", links.KINDS)
def test_delays_of_a_link_have_the_mean_and_percentile_of_its_truth(kind):
    rng, t = np.random.default_rng(5), np.arange(0.0, 60.0, 0.01)
    took, lost = links.delays(kind, t, rng)
    true = links.truth(kind, 60.0)
    assert took.min() >= 0.0
    assert took[~lost].mean() + links.COMMAND_DELAY_S == pytest.approx(true.mean, abs=0.3e-3)
    assert np.quantile(took[~lost], 0.95) + links.COMMAND_DELAY_S == pytest.approx(true.p95, abs=1e-3)
    assert lost.mean() == pytest.approx(true.lost, abs=5e-3)


def test_a_lost_measurement_repeats_the_one_before():
    log = links.log("losses", 3.0, 0)
    at = np.flatnonzero(log.lost)
    assert len(at) > 0
    assert (log.position[at] == log.position[at - 1]).all()


@pytest.mark.night
def test_ours_finds_a_distribution_and_a_correlation_measures_the_lag_of_the_servo_too():
    log, true = links.log("gaussian", 6.0, 1), links.truth("gaussian", 6.0)
    ours, peak = methods.ours(log, 0), methods.correlation(log, 0)
    assert ours.mean == pytest.approx(true.mean, abs=0.5e-3)
    assert ours.p95 == pytest.approx(true.p95, abs=1.5e-3)
    assert peak.mean > true.mean + 0.02


@pytest.mark.night
@pytest.mark.parametrize(("kind", "seed"), [("tail", 101), ("steps", 200), ("usb", 107)])
def test_ours_finds_the_mean_from_a_start_far_from_it(kind, seed):
    """From one start the first ended 4 ms away and the third 2.5, and the first estimate of the second diverged."""
    assert methods.ours(links.log(kind, 8.0, seed), 0).mean == pytest.approx(links.truth(kind, 8.0).mean, abs=1.5e-3)


@pytest.mark.night  # `make test` runs the other methods
def test_sysid_finds_a_constant_delay_and_paces_is_a_multiple_of_its_step(monkeypatch):
    log, true = links.log("fixed", 3.0, 1), links.truth("fixed", 3.0)
    monkeypatch.setattr(methods, "PACE_S", 2.0)
    sysid = methods.sysid(log, 0)
    assert sysid.mean == pytest.approx(true.mean, abs=0.7e-3)
    assert sysid.p95 == sysid.mean
    steps = methods.pace(log, 0).mean / methods.PACE_STEP_S - 0.5
    assert steps == pytest.approx(round(steps), abs=1e-6)


def test_rows_and_table_show_errors_coverage_and_who_is_better():
    def record(method, seed, off_s, held):
        errors, both = {"mean": off_s, "p95": 2 * off_s, "lost": 0.01}, {"mean": held, "p95": held}
        about = {"link": "losses", "seed": seed, "method": method, "seconds": 3.0}
        return {**about, "estimate": {}, "errors": errors, "held": both}

    records = [record("ours", 0, 3e-4, True), record("ours", 1, -4e-4, False), record("pace", 0, 1e-4, None)]
    rows = {r["name"]: r for r in bench.rows(records)}
    assert rows["latency/losses/ours/mean"]["value"] == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 2), rel=1e-3)
    assert rows["latency/all/ours/held_p95"]["yardstick"] == "1 of 2, 95 % interval 0.01 to 0.99"
    assert "latency/all/pace/held_mean" not in rows
    text = latency({"rows": list(rows.values()), "truth": {"losses": {"mean": 0.012, "p95": 0.013, "lost": 0.02}}})
    assert "| losses | 12.0 / 13.0 | 0.35 / 0.71 | 0.10 / 0.20 |" in text
    assert "| losses: share of lost messages [%] | 2.0 | 1.00 | 1.00 |" in text
    assert "1 of 2; 1 of 2 | - |" in text
    assert "Better than sim2real: PACE on losses (mean), PACE on losses (95th percentile)." in text


def test_the_bench_reports_every_recording():
    options = argparse.Namespace(**{**bench.QUICK, "jobs": 1, "seed": 3, "length_s": 2.0})
    report = bench.run(options)
    assert [(r["link"], r["seed"], r["method"]) for r in report["records"]] == [
        ("losses", 3, "ours"), ("losses", 3, "correlation"),
    ]  # fmt: skip
    assert {r["name"] for r in report["rows"]} >= {"latency/losses/ours/p95", "latency/all/ours/held_mean"}
