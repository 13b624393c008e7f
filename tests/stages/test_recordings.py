"""Whose logs, and in which units, a stage takes."""

from pathlib import Path

import numpy as np
import pytest

from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.stages.load import load_robot
from sim2real.stages.shared.arguments import open_recording, require_units

DATASET = Path(__file__).parents[2] / "datasets" / "pendulum" / "steps.mcap"


def recording(units, metadata=None):
    return Recording(Path("a.mcap"), Episode({}, {}, {}, metadata or {}, units=units))


@pytest.fixture(scope="module")
def pendulum():
    return load_robot("pendulum")


def test_units_come_from_the_channels_and_of_older_logs_from_the_session(pendulum):
    assert recording({"sensor": {"th": "rad"}, "actuator": {"action": "V"}}).units == {"th": "rad", "action": "V"}
    assert recording({"a": {"x": "m", "y": "s"}, "b": {"x": "mm"}}).units == {"y": "s"}
    assert recording({}, {"units": {"th": "rad"}}).units == {"th": "rad"}
    old = open_recording(DATASET, pendulum)  # of a session before anything had units
    assert not old.units
    assert np.isfinite(old.episode.outputs["sensor"]["th"]).all()


@pytest.mark.parametrize(
    ("units", "metadata", "said"),
    [
        ({"sensor": {"th": "deg"}}, {}, "'th' of 'sensor' is in deg in the log a.mcap, the robot computes in rad"),
        ({"actuator": {"action": "mV"}}, {}, "'action' of 'actuator' is in mV"),
        ({}, {"units": {"th": "deg"}}, "'th' of 'sensor' is in deg"),
    ],
)
def test_a_log_in_other_units_is_refused(pendulum, units, metadata, said):
    with pytest.raises(Sim2RealError, match=f"{said}(.|\n)*scale"):
        require_units(recording(units, metadata), pendulum)
    require_units(recording({"sensor": {"th": "rad", "temperature": "K"}, "camera": {"th": "px"}}), pendulum)
