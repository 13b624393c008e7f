"""Random lines, in virtual time: each reading is right or the bus is lost, and the motors are off at the end."""

import logging
import random

import numpy as np
import pytest
from families import IDS, STS, VOLTS

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.safety import guardian

SPEED_RAD_S = {VOLTS: 40.0, STS: 10.0}
"""Of the plant, whatever is commanded: a position says when it was sampled. A count is 0.04 or 0.15 ms."""
EARLY_S, LATE_S = 0.0003, 0.0021
"""A sample is at most a count older than its instruction, and so much younger: the time of bytes on the wire."""


def draw(seed):
    """Return a family, the faults of its line, and a generator for the rest."""
    rng = random.Random(seed)
    family, faults = rng.choice((VOLTS, STS)), {"seed": seed}
    for name in ("reply_loss", "corrupt", "late", "cut", "wrong_id"):
        if rng.random() < 0.4:
            faults[name] = rng.choice([0.02, 0.1, 0.3, 0.6])
    if "late" in faults:
        faults["late_s"] = rng.choice([0.005, 0.009, 0.012, 0.03, 0.05, 0.2])
    return family, faults, rng


def play(seed):
    """Run one line; return how it ended, its readings, the wrong ones, and when it ended [ns]."""
    family, faults, rng = draw(seed)
    robot = family.robot("Ramp", speed_rad_s=SPEED_RAD_S[family])
    readings, wrong, ending = 0, [], rng.choice(("stop", "stop_quietly", "close", "kill", "stall", "hang"))
    gate = {"max_speed_rad_s": None, "freeze_rad_s": 1e6}
    rig = family.rig(robot, gate, max_silence_s=rng.choice([0.1, 0.5]))
    end = "fine"
    try:
        rig.start()
        robot.strike(**faults)
        for _ in range(rng.randrange(10, 20)):
            reading = rig.measure()
            readings += 1
            ahead_rad = reading.position_rad - SPEED_RAD_S[family] * 1e-9 * reading.transaction.t_sent_ns
            if family is STS:  # counts of one turn, 0 in its middle
                ahead_rad = ahead_rad % (2 * np.pi) - np.pi
            after_s = ahead_rad / SPEED_RAD_S[family]
            if not (np.all(after_s > -EARLY_S) and np.all(after_s < LATE_S)):
                wrong.append((family.name, faults, after_s.tolist()))
            rig.command(rig.gate.fallback, 0.0, 1e-9 * robot.now_ns())
            robot.sleep(rng.uniform(0.0, 0.01))
        if ending == "stall":
            robot.stall(0.3)
            rig.measure()
        elif ending == "hang":
            robot.sleep(0.3)
        elif ending != "kill":
            getattr(rig, ending)()
    except (HardwareLost, SafetyStop) as error:
        end = type(error).__name__
    if ending == "kill":
        robot.kill_host()
    rig.close()
    robot.sleep(0.05)
    on = family.on(robot)
    robot.stop()
    assert on == [], (seed, family.name, faults, ending)
    return end, readings, wrong, robot.now_ns()


def check(seeds):
    ends, readings = {}, 0
    for seed in seeds:
        end, count, wrong, end_ns = play(seed)
        assert not wrong, (seed, wrong[:3])
        ends[end], readings = ends.get(end, 0) + 1, readings + count
        if seed % 30 == 0:
            assert play(seed)[3] == end_ns, f"line {seed} ended at another time when it was played again"
    return ends, readings


@pytest.fixture(autouse=True)
def quiet_and_impatient(monkeypatch):
    monkeypatch.setattr(guardian, "GIVE_UP_S", 0.5)
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def test_random_lines():
    ends, readings = check(range(150))
    # The lines are of all kinds: most readings are made, and buses are lost.
    assert readings > 750
    assert min(ends["fine"], ends["HardwareLost"]) > 15
    assert len(IDS) == 3


@pytest.mark.night
@pytest.mark.parametrize("hundred", range(100))
def test_ten_thousand_random_lines(hundred):
    check(range(1000 + 100 * hundred, 1000 + 100 * hundred + 100))
