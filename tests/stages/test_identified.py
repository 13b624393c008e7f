"""What identify prints."""

import pytest

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.stages.identify.stage import show


@pytest.mark.parametrize(
    ("estimate", "truth", "off"), [(1.1, 1.0, "+10.0 %"), (0.004, 0.0, "+0.004 kg"), (0.0, 0.0, "+0 kg")]
)
def test_how_far_an_estimate_is_off_where_nothing_is_true_too(estimate, truth, off, capsys):
    """An empty hand holds 0 kg."""
    p = Estimate("payload", "kg", "dynamics", "", 0.0, estimate, "accepted", truth=truth)
    show(Identification("arm", (), Judgement("accepted", ()), (p,)))
    assert off in capsys.readouterr().out
