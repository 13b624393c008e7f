"""Where the milliseconds go: what is on the way and what is beside it; the file gives back what it was given."""

import json

import numpy as np
import pytest

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, Messages, Steps
from sim2real.stages.latency.result import Latency, measured

CHAIN = ("sensor", "agent", "actuator")
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


def test_the_way_begins_at_the_sample_and_counts_nothing_twice(recording, identification):
    found = Latency.of(recording, CHAIN, identification)
    took = {p.name: (p.where, p.counted, round(1e6 * p.took.p50)) for p in found.parts}
    assert took == {
        "sensor, from the sample to its message": ("host", True, 300),
        "sensor on the bus, question and answer": ("bus", False, 800),
        "message from sensor to agent": ("host", True, 10),
        "agent wakes and computes": ("host", True, 200),
        "message from agent to actuator": ("host", True, 30),
        "actuator wakes and computes": ("host", True, 300),
        "actuator on the bus": ("bus", True, 600),
    }
    # From the sample at 700 us to the end of the actuator's step at 2140 us, and what the motion says.
    assert found.total_s == pytest.approx(1440e-6 + 0.025)
    assert (found.hidden.about, found.hidden.verdict) == ("late + early", "accepted")
    assert (found.transactions, found.lost, found.late) == (100, 2, 1)


def test_without_motion_the_devices_share_is_not_known(recording):
    found = Latency.of(recording, CHAIN, None)
    assert found.hidden is None
    assert found.total_s == pytest.approx(1440e-6)


def test_several_transactions_a_step_stay_together(recording):
    recording.timing.bus_s["actuator"] = np.full(2 * COUNT, 3e-4)
    names = [name for name, *_ in measured(recording, CHAIN)]
    assert "actuator, its transactions included" in names
    assert "actuator on the bus" not in names


def test_it_comes_back_from_its_file(recording, identification, tmp_path):
    found = Latency.of(recording, CHAIN, identification)
    assert found.save(tmp_path) == {"latency": "latency.json"}
    assert Latency.load(tmp_path) == found
    document = json.loads((tmp_path / "latency.json").read_text())
    (tmp_path / "latency.json").write_text(json.dumps(document | {"format": 9}))
    with pytest.raises(Sim2RealError, match="has format 9, this version reads 1"):
        Latency.load(tmp_path)
