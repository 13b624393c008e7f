"""Jitter of commands, found from the motion of a motor with a lag that is solved here by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import check_grad
from test_links import COMMAND_DELAY_S, COUNT_RAD, GAIN, GRID, NOISE_RAD, PERIOD_S, RATE, STEP_S, turned

from sim2real.graph.timeline import Timeline
from sim2real.graph.times import Vertex
from sim2real.identify.delays.jitter import LateCommands, Variances, deviation, one_later
from sim2real.identify.delays.likelihood import DelayEvidence
from sim2real.identify.delays.links import find, links

SENT_S, PART_S, LATER_S, DURATION_S = 0.02, 1.0, 0.002, 6.0


def log(duration_s, seed, late_s=0.0, disturbed=0.0):
    """Simulate a log: commands of 50 Hz that act after 4 ms, give or take, and measurements that are 6 ms old.

    While a command holds a voltage is added that the model does not know.
    """
    rng = np.random.default_rng(seed)
    sent = np.arange(0.0, duration_s, SENT_S)
    volts = 0.5 * np.sin(2 * np.pi * rng.uniform(0.5, 3.0, 6) * sent[:, None] + rng.uniform(0, 6, 6)).sum(axis=1)
    at = np.arange(round((duration_s + 0.1) / STEP_S)) * STEP_S
    arrived = np.maximum.accumulate(sent + COMMAND_DELAY_S + rng.normal(0.0, late_s, len(sent)))
    applied = volts + rng.normal(0.0, disturbed, len(sent))
    angles = turned(GAIN, RATE, acting(applied, arrived, at), STEP_S)
    stamps = np.arange(0.2, duration_s, PERIOD_S)
    took = 0.006 + rng.normal(0.0, 0.0008, len(stamps))
    seen = np.interp(stamps - took, at, angles) + rng.normal(0.0, NOISE_RAD, len(stamps))
    seen = np.round(seen / COUNT_RAD) * COUNT_RAD
    return SimpleNamespace(sent=sent, volts=volts, at=at, stamps=stamps, seen=seen)


def acting(volts, arrived, at):
    """Return the voltage that acts at each time."""
    return volts[np.maximum(np.searchsorted(arrived, at + 1e-9, "right") - 1, 0)]


def watch(log):
    """Return a model of the log in parts as ``find`` wants it, and what late commands do in each of them.

    Unknowns are the logarithms of gain and rate, and each part's speed and angle at its start.
    """
    nominal = log.sent + COMMAND_DELAY_S
    begins = np.arange(0.0, log.stamps[-1] - PART_S, PART_S)
    parts = [slice(round(b / STEP_S), round((b + PART_S) / STEP_S)) for b in begins]
    rows = [(log.stamps >= b + 0.03) & (log.stamps < b + PART_S) for b in begins]
    first = turned(GAIN, RATE, acting(log.volts, nominal, log.at), STEP_S)
    states = np.stack([np.gradient(first, STEP_S)[[p.start for p in parts]], first[[p.start for p in parts]]], axis=1)

    def angles(x, e, arrived=nominal):
        state = states[e] + x[2 + 2 * e : 4 + 2 * e]
        return turned(
            np.exp(x[0]), np.exp(x[1]), acting(log.volts, arrived, log.at[parts[e]]), STEP_S, state[0], state[1]
        )

    def columns(e, delay_s, change):
        return np.interp(log.stamps[rows[e]] - delay_s, log.at[parts[e]], change) / NOISE_RAD

    def linearise(x, delay_s):
        errors, J, stamps = [], [], []
        for e, own in enumerate(rows):
            motion = angles(x, e)
            at = log.stamps[own][:, None] - GRID
            errors.append((np.interp(at, log.at[parts[e]], motion) - log.seen[own][:, None]) / NOISE_RAD)
            J.append(np.stack([columns(e, delay_s, (angles(x + s, e) - motion) / 1e-3) for s in 1e-3 * np.eye(len(x))]))
            stamps.append(log.stamps[own])
        stamps, J = np.concatenate(stamps), np.concatenate(J, axis=1).T
        return DelayEvidence(
            stamps - stamps.mean(), GRID, np.concatenate(errors)[:, None], J[:, None], 1e-4 * np.eye(len(x))
        )

    def moved(x, delay_s):
        size = np.abs(np.diff(log.volts, prepend=log.volts[0]))
        found, begin, size = [], 0, size / size.mean()
        for e in range(len(parts)):
            arrivals = nominal + LATER_S * np.eye(len(nominal))
            late = np.stack([columns(e, delay_s, angles(x, e, a) - angles(x, e)) for a in arrivals], axis=1) / LATER_S
            felt = np.abs(late).max(axis=0) > 0
            found.append(LateCommands(begin + np.arange(len(late)), late[:, None, felt], size[felt]))
            begin += len(late)
        return found

    again = np.concatenate([[False], np.diff(log.seen) == 0.0])
    return linearise, moved, np.concatenate([again[own] for own in rows]), 2 + 2 * len(parts)


def jitter(log):
    """Find the link, then the jitter of the commands."""
    linearise, moved, again, unknowns = watch(log)
    start = np.concatenate([[np.log(GAIN) + 0.1, np.log(RATE) - 0.2], np.zeros(unknowns - 2)])
    own = find(linearise, start, 0.01, again).hidden
    delay_s = own.mean[0]
    seen, late = linearise(own.x, delay_s), moved(own.x, delay_s)
    return deviation(seen, np.full(len(seen.stamps), delay_s), own.deviation[0], own.noise, late)


@pytest.mark.night
@pytest.mark.parametrize("late_s", [1e-3, pytest.param(3e-3, marks=pytest.mark.night)])
def test_the_deviation_of_commands_is_found(late_s):
    found = jitter(log(10.0, 1, late_s))
    assert found.low95 <= late_s <= found.high95
    assert found.low95 > 0.2 * late_s
    assert found.high95 < 2.0 * late_s


def test_commands_on_time_have_none():
    found = jitter(log(DURATION_S, 1))
    assert found.low95 == 0.0
    assert found.high95 < 0.5e-3


def test_what_the_model_does_not_know_is_no_jitter():
    found = jitter(log(DURATION_S, 2, disturbed=0.03))
    assert found.low95 == 0.0


def test_the_gradient_is_that_of_the_likelihood():
    record = log(3.0, 0, 2e-3)
    linearise, moved, _, unknowns = watch(record)
    seen, late = linearise(np.zeros(unknowns) + 0.01, 0.006), moved(np.zeros(unknowns) + 0.01, 0.006)
    likelihood = Variances(seen, np.full(len(seen.stamps), 0.006), np.ones(1), late)
    for p in (np.log([1.0, 1e-3, 1e-3, 1e-3]), np.log([2.0, 1e-4, 5e-3, 2e-4])):
        slope = likelihood(p)[1]
        assert check_grad(lambda x: likelihood(x)[0], lambda x: likelihood(x)[1], p) < 1e-4 * np.abs(slope).max()


def test_without_commands_that_act_nothing_is_known():
    linearise, _, _, unknowns = watch(log(3.0, 0))
    seen = linearise(np.zeros(unknowns), 0.006)
    none = LateCommands(np.arange(3), np.zeros((3, 1, 0)), np.zeros(0))
    assert deviation(seen, np.full(len(seen.stamps), 0.006), 1e-3, np.ones(1), [none]).value is None


@pytest.mark.night  # `make test` finds it in the logs above, and links of the same problem in test_links.py
def test_a_problem_knows_the_jitter_of_its_commands(fitted, late_problem):
    (link,) = links(late_problem, fitted.found.z)
    assert link.jitter.low95 <= 0.004 <= link.jitter.high95
    assert link.jitter.low95 > 0.001
    rows = {row[0]: row for row in link.rows().rows}
    assert rows["actuator_delay, deviation"][1] == 1e3 * link.jitter.value


def test_a_command_is_moved_no_further_than_to_the_next():
    start = np.array([[0, 20_000, 20_500, 40_000]] * 5)  # [us]; the second and third in a burst
    vertex = Vertex(start, start + 450, np.full(5, 4))
    later_s = np.zeros(5)
    moved = one_later(Timeline({"actuator": vertex}, {}), ("actuator",), 4, later_s).vertices["actuator"]
    assert later_s == pytest.approx([0.002, 0.0, 0.002, 0.002, 0.0])
    assert (moved.start - start == 2000 * np.eye(5, 4) * (later_s > 0)[:, None]).all()
    assert (moved.end[:, :-1] <= moved.start[:, 1:]).all()


def test_where_commands_tell_nothing_their_deviation_is_not_known():
    record = log(3.0, 0, 1e-3)
    linearise, moved, _, unknowns = watch(record)
    x = np.zeros(unknowns)
    seen, late = linearise(x, 0.006), moved(x, 0.006)
    weak = [LateCommands(own.rows, 1e-6 * own.slopes, own.sizes) for own in late]
    assert deviation(seen, np.full(len(seen.stamps), 0.006), 1e-3, np.ones(1), weak).value is None
