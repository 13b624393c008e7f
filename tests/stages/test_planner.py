"""A design for the pendulum: what it promises, its limits, what it refuses, and how it is played."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real import cli
from sim2real.artifacts.design import COMMANDS, Design
from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError, UsageError
from sim2real.hardware.config import GateLimits
from sim2real.identify.design import choose
from sim2real.identify.problem import Problem
from sim2real.identify.segments import Span
from sim2real.identify.uncertainty import linearise
from sim2real.stages.config import RecordConfig
from sim2real.stages.design import design
from sim2real.stages.design_config import DesignConfig
from sim2real.stages.excitation import excitation
from sim2real.stages.pipeline import load_pipeline
from sim2real.stages.planner import Planner
from sim2real.view.design import picture

LOG = Path(__file__).parents[2] / "datasets" / "pendulum" / "multisine.mcap"


@pytest.fixture(scope="module")
def pipeline():
    """The pendulum with starts that are read off the log: half as much to compile."""
    own = load_pipeline("pendulum")
    return replace(own, identify=replace(own.identify, initial_state="measured", jacobian="forward"))


@pytest.fixture(scope="module")
def config(pipeline):
    return replace(pipeline.design, duration_s=12.0, motion_s=6.0, motions=60)


@pytest.fixture(scope="module")
def planner(pipeline, config):
    return Planner.of(pipeline, None, config)


@pytest.fixture(scope="module")
def usually(planner, config):
    return planner.told(planner.rest + planner.usual(config.duration_s, 1))


@pytest.fixture(scope="module")
def pool(planner, usually):
    return planner.pool(usually)


@pytest.fixture(scope="module")
def made(pipeline, config):
    return design(pipeline, None, config)


def test_a_design_tells_more_than_the_usual_excitation(made):
    assert made.gain < 0.9
    assert all(e.after < e.now for e in made.expected)
    assert [e.name for e in made.expected] == ["gain", "gravity", "damping", "friction", "round_trip_delay"]


def test_it_keeps_to_the_limits_with_a_margin(made, config):
    assert made.commands.shape == (600, 1)
    assert np.abs(made.commands).max() <= config.record.gate.limit
    assert 1.0 < made.speed["th"] <= 0.9 * config.record.gate.max_speed_rad_s


def test_the_same_seed_designs_the_same(planner, pool, made):
    again, _ = planner.composed(*pool)
    np.testing.assert_array_equal(again, made.commands)


def test_a_motion_is_chosen_for_the_parameter_that_alone_is_unknown(pool):
    _, each, variance = pool
    for unknown in range(each.shape[1]):
        known = 1e9 * np.diag(np.einsum("mqq->q", each))
        known[unknown, unknown] = 1e-9
        (first,) = choose(known, each, variance, 1)
        assert first == np.argmax(each[:, unknown, unknown] / variance)


def test_what_is_predicted_is_what_a_log_of_the_robot_says(planner):
    """The embedded robot's log, with its own timing, latencies and encoder, against a simulation of its commands."""
    episode = Recording.load(LOG).episode
    truth = load_pipeline("pendulum").load("plant").PendulumPlant().truth()
    planner = replace(planner, values={**planner.values, **truth, "sensor_delay": 0.02, "actuator_delay": 0.025})
    begins = np.arange(0.0, episode.duration_s - planner.segment_s, planner.segment_s)
    spans = [Span(0, float(b)) for b in begins]
    problem = Problem(planner.model, [episode], spans, planner.segment_s, planner.fitting, planner.table)
    at = linearise(problem, problem.table.encode(planner.values))
    J = at.jacobian.reshape(-1, len(at.x))[:, planner.known.rest]
    predicted = planner.told(episode.outputs["actuator"]["action"].reshape(-1, 1)).information / planner.share
    ratio = planner.known.deviations(predicted) / planner.known.deviations(J.T @ J)
    np.testing.assert_allclose(ratio, 1.0, atol=0.3)


@pytest.mark.parametrize(
    ("gate", "amplitude", "said"),
    [
        (GateLimits(max_speed_rad_s=1e-3, freeze_rad_s=0.5), 2.0, "0 stay within 90%"),
        (GateLimits(limit=1e-4, freeze_rad_s=0.5), 1e-4, "no command moves the model"),
    ],
)
def test_what_cannot_move_is_refused(pipeline, config, usually, gate, amplitude, said):
    record = replace(config.record, gate=gate, amplitude=amplitude)
    with pytest.raises(Sim2RealError, match=said):
        Planner.of(pipeline, None, replace(config, record=record)).pool(usually)


def test_a_robot_that_others_record_is_refused(capsys):
    assert cli.main(["design", "disk"]) == 2
    assert "recordings that somebody else made" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({"motions": 3}, "too few"),
        ({"motion_s": 50.0}, "motion_s"),
        ({"margin": 2.0}, "margin"),
        ({"record": RecordConfig(excitation="designed")}, "that is none"),
    ],
)
def test_flags_that_make_no_sense_are_refused(told, said):
    with pytest.raises(UsageError, match=said):
        DesignConfig(**told)


def test_a_design_is_saved_drawn_and_played(made, tmp_path):
    made.save(tmp_path)
    again = Design.load(tmp_path)
    assert again.expected == made.expected
    played = excitation(RecordConfig(excitation="designed", design=tmp_path / COMMANDS), 50.0)
    np.testing.assert_array_equal(played, made.commands[:, 0])
    picture(tmp_path / "design.png", again)
    assert (tmp_path / "design.png").stat().st_size > 10_000
    with pytest.raises(UsageError, match="1 commands at 50 Hz, this robot takes 2"):
        excitation(RecordConfig(excitation="designed", design=tmp_path), 50.0, commands=2)
    with pytest.raises(UsageError, match="needs its design"):
        excitation(RecordConfig(excitation="designed"), 50.0)
    (tmp_path / COMMANDS).write_bytes(b"no zip")
    with pytest.raises(Sim2RealError, match="malformed"):
        Design.load(tmp_path)


def test_record_finds_the_newest_design(tmp_path, capsys):
    assert cli.main(["record", "pendulum", "--excitation", "designed", "--runs", str(tmp_path)]) == 1
    assert "no finished 'design'" in capsys.readouterr().err
