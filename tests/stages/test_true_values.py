"""The true delay of a sensor beside the estimate: of a bus, and of a robot that publishes its state."""

import numpy as np
import pytest

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.emulation.truth import Kind, TruthLog, read_truth
from sim2real.graph.episode import Steps
from sim2real.stages.identify.stage import show
from sim2real.stages.identify.true_values import sensing_delay_s

MS = 1_000_000
AGE_NS = 5 * MS


@pytest.mark.parametrize(("servo_ids", "way_ns"), [([], 400_000), ([], 1_500_000), ([], -1_000), ([1], -300_000)])
def test_the_sample_is_the_one_that_was_read(tmp_path, servo_ids, way_ns):
    """A published state comes by a way of up to its period of 2 ms; a bus gets its request after the stamp.

    In virtual time a state is read in the instant in which it is sent, and the stamp is a tick before it: a Go2's true
    round trip was 2 ms too long.
    """
    log = TruthLog(tmp_path / "truth.bin", {"state_names": [], "truth": {}, "servo_ids": servo_ids})
    period = 2 * MS if not servo_ids else 20 * MS
    for k in range(500):
        log.write(Kind.SAMPLE, 0, k * period, k * period - AGE_NS, k * period, 0, (0.0, 0.0, 0.0))
    log.close()
    stamps = (np.arange(20, 40) * 20 * MS + way_ns) // 1000
    steps = Steps(stamps, stamps, stamps, np.full(20, -1), stamps + 100, np.zeros(20, np.int64))
    found = sensing_delay_s(read_truth(tmp_path / "truth.bin"), steps, 0)
    assert found == pytest.approx((AGE_NS + way_ns) * 1e-9, abs=2e-6)


@pytest.mark.parametrize(
    ("estimate", "truth", "off"), [(1.1, 1.0, "+10.0 %"), (0.004, 0.0, "+0.004 kg"), (0.0, 0.0, "+0 kg")]
)
def test_how_far_an_estimate_is_off_where_nothing_is_true_too(estimate, truth, off, capsys):
    """An empty hand holds 0 kg."""
    p = Estimate("payload", "kg", "dynamics", "", 0.0, estimate, "accepted", truth=truth)
    show(Identification("arm", (), Judgement("accepted", ()), (p,)))
    assert off in capsys.readouterr().out
