"""The seed of a search decides neither estimates nor intervals: five identifications of the log that is shipped."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real.stages.identify.stage import identify
from sim2real.stages.load import load_robot
from sim2real.stages.shared.arguments import open_recording

LOG = Path(__file__).parents[2] / "datasets" / "pendulum" / "chirp.mcap"
SEEDS = range(5)

pytestmark = pytest.mark.night  # five whole identifications, with five refits each


def test_estimates_and_intervals_do_not_depend_on_the_seed():
    pendulum = load_robot("pendulum")
    recording = open_recording(LOG, pendulum)
    found = [
        identify(pendulum, recording, replace(pendulum.defaults.identify, seed=seed, free_run_s=0.0)) for seed in SEEDS
    ]
    # The pendulum turns over in the held-out end alone, 2.7 times beyond the fitted motion, where this model is wrong.
    assert {own.verdict.status for own in found} == {"change the model"}
    # The log does not tell the two delays apart, only their sum.
    names = [p.name for p in found[0].parameters if p.name not in ("sensor_delay", "actuator_delay")]
    rows = [{p.name: p for p in own.parameters} for own in found]
    for name in names:
        widths = np.array([row[name].high95 - row[name].low95 for row in rows])
        assert widths.max() / widths.min() < 1.1, name
        estimates = np.array([row[name].estimate for row in rows])
        assert np.ptp(estimates) < 0.2 * rows[0][name].standard_error, name
