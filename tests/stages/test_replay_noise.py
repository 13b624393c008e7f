"""A model that diverges on its own motion bounds no error: the more unstable, the wider, never the tighter."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.identification import Noise, Prediction
from sim2real.stages.deploy import replay


@pytest.mark.parametrize(("errors", "limit"), [([0.1] * 16, 0.1), ([0.1] * 14 + [math.nan, None], math.inf)])
def test_a_prediction_that_diverges_is_infinitely_wrong(monkeypatch, errors, limit):
    left = iter(errors)
    monkeypatch.setattr(replay.prediction, "samples", lambda *_: {})
    monkeypatch.setattr(
        replay.prediction, "errors", lambda *_: [Prediction("identified", 1.0, True, {"th": next(left)})]
    )
    problem = SimpleNamespace(ts=np.zeros((1, 3)), segments=1, readings={"th": np.zeros((1, 3))})
    problem.with_readings = lambda readings: problem
    noise = (Noise("th", "rad", 0.01, 0.0, 0.0),)
    found = replay._of_noise(problem, {"th_identified": np.zeros(3)}, noise, {}, 0.3, 1.0)
    assert found == {"th": pytest.approx(limit)}
