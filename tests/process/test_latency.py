"""The test of latency on the embedded robot: it moves and says what the device takes, or stays still and does not."""

import pytest
from live_robots import PATIENT, manifest_of

from sim2real import cli
from sim2real.artifacts.recording import Recording
from sim2real.stages.identify.true_values import true_values
from sim2real.stages.latency.result import Latency

pytestmark = pytest.mark.process


@pytest.fixture
def tested(tmp_path):
    """Run the test; return its folder."""

    def run(*flags):
        assert cli.main(["latency", "pendulum", *flags, "--runs", str(tmp_path), *PATIENT]) == 0
        (folder,) = tmp_path.glob("pendulum/*/latency")
        assert (folder / "latency.png").read_bytes().startswith(b"\x89PNG")
        return folder

    return run


@pytest.mark.night
def test_steps_tell_what_the_device_takes(tested, capsys):
    folder = tested("--duration-s", "10", "--identify.generations", "0")
    found = Latency.load(folder)
    truth = true_values(Recording.load(folder / "session.mcap"))
    assert found.hidden.estimate == pytest.approx(truth["round_trip_delay"], abs=0.005)
    assert {p.where for p in found.parts} == {"host", "bus"}
    assert found.transactions > 500
    said = capsys.readouterr().out
    assert "sensor_delay + actuator_delay, from the motion" in said
    assert manifest_of(folder)["status"] == "finished"


@pytest.mark.night
def test_a_dry_one_moves_nothing_and_knows_the_host_and_the_bus(tested, capsys):
    folder = tested("--duration-s", "2", "--dry-run")
    found = Latency.load(folder)
    assert found.hidden is None
    assert [p.name for p in found.parts if p.where == "bus"] == [
        "sensor on the bus, question and answer",
        "actuator on the bus",
    ]
    assert manifest_of(folder)["status"] == "dry run"
    assert "from the motion" not in capsys.readouterr().out
