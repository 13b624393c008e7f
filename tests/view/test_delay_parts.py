"""Where the milliseconds go: what is on the way, what is beside it, and what is said of servos and of lateness."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic_run

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.artifacts.recording import Recording
from sim2real.graph.episode import Episode, Messages, Steps
from sim2real.log.reader import read_log
from sim2real.view.sections import record_banner
from sim2real.view.timing import delay_blocks, parts_of, schedule, timing_tiles

COUNT = 50


def steps(begin_us, took_us, sampled_us=None):
    start = np.arange(COUNT) * 20_000 + begin_us
    stamp = np.full(COUNT, -1) if sampled_us is None else start + sampled_us
    return Steps(scheduled=start, start=start, woken=start, ts_overwrite=stamp, end=start + took_us, drift=0 * start)


def messages(sent_us, took_us):
    sent = np.arange(COUNT) * 20_000 + sent_us
    return Messages(seq_out=np.arange(COUNT), seq_in=np.arange(COUNT), sent=sent, received=sent + took_us)


@pytest.fixture
def recording(tmp_path):
    """A loop whose every part takes a time of its own; the sample is taken 700 us into the sensor's step of 1000."""
    session = {
        "transactions": 100,
        "lost_replies": 2,
        "late_replies": 1,
        "bus": {
            "sensor": {"transfer_us": [800.0] * COUNT, "wait_us": [0.0] * COUNT},
            "actuator": {"transfer_us": [600.0] * COUNT, "wait_us": [0.0] * COUNT},
        },
    }
    episode = Episode(
        steps={"sensor": steps(0, 1000, 700), "agent": steps(1010, 200), "actuator": steps(1240, 900)},
        messages={("agent", "sensor"): messages(1000, 10), ("actuator", "agent"): messages(1210, 30)},
        outputs={},
        metadata={"log": {"session_end": session}},
    )
    return Recording(tmp_path / "session.mcap", episode)


@pytest.fixture
def identification():
    return Identification(
        "robot",
        (),
        Judgement("accepted", ()),
        (
            Estimate("late", "s", "delay", "", 0.0, 0.012, "not identifiable", 0.01, 0.0, 0.02),
            Estimate("early", "s", "delay", "", 0.0, 0.013, "not identifiable", 0.01, 0.0, 0.02),
            Estimate("round_trip_delay", "s", "derived", "late + early", 0.0, 0.025, "accepted", 1e-4, 0.0248, 0.0252),
        ),
    )


def times(blocks):
    """Return part -> where, and its median [us]."""
    (table,) = blocks
    return {part: (where, round(1e3 * float(p50))) for part, where, p50, *_ in table.rows}


def test_the_way_begins_at_the_sample_and_counts_nothing_twice(recording, identification):
    assert times(delay_blocks(recording, identification)) == {
        "sensor, from the sample to its message": ("host", 300),
        "sensor on the bus, question and answer": ("(bus)", 800),
        "message from sensor to agent": ("host", 10),
        "agent wakes and computes": ("host", 200),
        "message from agent to actuator": ("host", 30),
        "actuator wakes and computes": ("host", 300),
        "actuator on the bus": ("bus", 600),
        "late + early, from the motion": ("device", 25_000),
        # From the sample at 700 us to the end of the actuator's step at 2140 us, and what the motion says.
        "sum of the medians, without parts in ()": ("", 26_440),
    }


def test_without_an_identification_the_devices_share_is_not_in_the_sum(recording):
    *_, (whole, (_, total)) = times(delay_blocks(recording, None)).items()
    assert "without the device" in whole
    assert total == 1440


def test_several_transactions_a_step_stay_together(recording):
    recording.timing.bus_s["actuator"] = np.full(2 * COUNT, 3e-4)
    names = [name for name, *_ in parts_of(recording)]
    assert "actuator, its transactions included" in names
    assert "actuator on the bus" not in names


def banner(port, late):
    end = {"transactions": 100, "late_replies": late, "lost_replies": 0}
    episode = SimpleNamespace(metadata={"port": port, "log": {"session_end": end}}, duration_s=1.0)
    return str(record_banner(SimpleNamespace(episode=episode, dry=False, warnings=())))


def test_late_answers_of_an_emulated_robot_are_not_those_of_an_adapter():
    assert "close what else runs" not in banner("/dev/ttyUSB0", 0)
    advised = [banner(port, 30) for port in ("/dev/ttyUSB0", "embedded")]
    assert ["latency timer" in text for text in advised] == [True, False]
    assert all("close what else runs" in text for text in advised)


@pytest.mark.parametrize(("port", "value", "late"), [("/dev/ttyUSB0", " ms", True), ("embedded", "none", False)])
def test_lateness_is_shown_only_where_it_was_measured(tmp_path, port, value, late):
    synthetic_run.write_log(tmp_path / "session.mcap")
    episode = read_log(tmp_path / "session.mcap")
    episode = replace(episode, metadata={**episode.metadata, "port": port})
    tile = next(iter(timing_tiles([episode])))
    assert tile.value.endswith(value)
    assert ("latest wake-up" in schedule(episode, "record")) is late
