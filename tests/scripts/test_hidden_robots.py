"""Tests of the hidden robots: one of them on the wall clock moves as it does on its own clock."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from sim2real.hardware.plant import load_plant
from sim2real.stages.pipeline.pipeline import load_pipeline

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches.hidden import robots as hidden_robots
from benches.hidden import wall_clock as hidden_wall

STEP_S = hidden_robots.STEP_S


@pytest.fixture
def robot() -> hidden_robots.Hidden:
    """Return a robot with play, whose commands act at once."""
    drawn = hidden_robots.Hidden.draw(3)
    return dataclasses.replace(drawn, sensing=0.0, acting=0.0, jitter=0.0, lost=0.0, play=0.02)


def test_on_the_bus_it_moves_as_on_its_own_clock(robot: hidden_robots.Hidden) -> None:
    """The plant of the emulator and the simulation are the same robot."""
    pipeline = load_pipeline("pendulum")
    before = pipeline.load().drive.embedded
    try:
        hidden_wall.put_on_the_bus(robot, pipeline)
        embedded = pipeline.load().drive.embedded
        plant = load_plant(embedded.plant, embedded.plant_args)
    finally:
        pipeline.load().drive.embedded = before
    played = hidden_robots.play(robot, lambda angle, speed: 1.5, 1.0, 0)
    start = int(np.flatnonzero(played.speed)[0]) - 1
    plant.command(1, 16, 1.5 / 5.0)
    angles = []
    for k in range(200):
        plant.advance((k + 1) * STEP_S)
        angles.append(plant.state()["th"])
    assert np.ptp(angles) > 0.05
    np.testing.assert_allclose(angles, played.angle[start + 1 : start + 201], atol=1e-12)
    assert plant.measure(1)[0] != plant.state()["th"], "the encoder has play"


def test_a_robot_far_from_ideal_is_the_same_pendulum() -> None:
    """Wear changes what is measured and when, not the dynamics: results with other wear are of the same robots."""
    plain, worn = hidden_robots.Hidden.draw(5), hidden_robots.Hidden.draw(5, hidden_robots.Wear(noise_rad=0.05))
    assert worn.noise > 0.0 == plain.noise
    assert dataclasses.replace(worn, noise=0.0) == plain


def test_pauses_of_the_computer_make_later_steps_wait() -> None:
    """A step begins after the node's last one has ended, and after its input."""
    robot = hidden_robots.Hidden.draw(5, hidden_robots.Wear(hiccups_hz=5.0, hiccup_s=0.05))
    played = hidden_robots.play(robot, lambda angle, speed: 0.0, 4.0, 0)
    assert (played.ends["agent"] - played.starts["agent"]).max() > 0.03
    for node, sender in (("agent", "sensor"), ("actuator", "agent")):
        assert (played.starts[node] >= played.ends[sender] - 1e-12).all()
        assert (played.starts[node][1:] >= played.ends[node][:-1] - 1e-12).all()
