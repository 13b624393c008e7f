"""Pushes, starts and a curriculum as the command shows them, and what of them is refused."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.stages.load import load_robot
from sim2real.stages.train.bundle import disturbance_rows
from sim2real.stages.train.setup import prepare
from sim2real.training.environment.variation import VariationConfig


@pytest.fixture(scope="module")
def prepared():
    """Prepare a tiny training of the pendulum's nominal model."""
    pipeline = load_robot("pendulum")

    def prepared(**vary):
        config = replace(
            pipeline.defaults.train, model="nominal", timelines=1, episode_s=0.5, vary=VariationConfig(**vary)
        )
        return prepare(pipeline, config)

    return prepared


def test_what_is_shown_is_what_is_drawn_at_the_end_of_the_training(prepared):
    made = prepared(uniform=0.2, push=3.0, push_hz=1.5, start_position=0.3, curriculum=(0.1, 0.5))
    rows = {row[0]: row for row in made.episodes.rows().rows}
    assert set(rows) == {"gain", "gravity", "damping", "friction", "start position", "push"}
    draws = made.episodes.draws
    for name, value, size in (("gain", made.values["gain"], 0.2), ("start position", 0.0, 0.3), ("push", 0.0, 3.0)):
        largest = 0.5 * size * (value or 1.0)
        assert np.abs(draws[name] - value).max() == pytest.approx(largest, rel=0.02)
    assert rows["push"][4] == "rad/s"
    told = disturbance_rows(made.episodes)
    assert told["pushes"] == "1.5 a second for each joint"
    assert told["curriculum"] == "0.1 of these differences at the first update, 0.5 at the last one"
    env = made.env
    assert (env.curriculum, env.pushes.sizes, env.task.start) == ((0.1, 0.5), (3.0,), (0.3, 0.0))


def test_a_curriculum_of_nothing_is_refused(prepared):
    with pytest.raises(UsageError, match="all episodes are equal"):
        prepared(curriculum=(0.0, 1.0))


def test_ranges_of_both_delays_give_a_data_sheet_delays_and_one_alone_is_refused(prepared):
    ranges = {"sensor_delay": (0.01, 0.02), "actuator_delay": (0.0, 0.03)}
    made = prepared(range=ranges)
    assert sum(made.values[name] for name in ranges) == pytest.approx(0.03)
    trip = made.episodes.draws["round_trip_delay"]
    assert 0.01 <= trip.min() < 0.015
    assert 0.045 < trip.max() <= 0.05
    with pytest.raises(UsageError, match="actuator_delay"):
        prepared(range={"sensor_delay": (0.01, 0.02)})
