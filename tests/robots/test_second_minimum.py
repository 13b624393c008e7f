"""A delay that is 8 ms too long imitates an inertia: the loss of an arm has a second minimum there."""

import numpy as np
import pytest

from sim2real.identification.config import FitConfig
from sim2real.identification.fit import Refined, _at_other_delays
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.stages.config import RecordConfig
from sim2real.stages.load import load_robot
from sim2real.stages.session.excitation import excitation
from sim2real.stages.session.simulated_log import simulate

TRUTH = {"actuator_delay": 0.02, "gain": 2.8, "damping": 0.252, "armature": 0.0056,
         "friction_pan": 0.045, "friction_shoulder": 0.057, "friction_elbow": 0.036}  # fmt: skip
SECOND = {"actuator_delay": 0.028, "gain": 2.84, "damping": 0.241, "armature": 0.0034,
          "friction_pan": 0.0416, "friction_shoulder": 0.0625, "friction_elbow": 0.0314}  # fmt: skip
"""The best estimates beside such a delay, as a fit that holds it finds them."""
COUNT_RAD = 2 * np.pi / 4096


def test_a_fit_that_ends_in_the_second_minimum_goes_on_to_the_first():
    robot = load_robot("arm")
    model = robot.identifiable(0.06)
    signal = excitation(RecordConfig(duration_s=12.0, amplitude=0.8), robot.drive.rate_hz, 3) + robot.drive.centre
    config = FitConfig(max_delay_s=0.06)
    values = {p.name: p.nominal for p in model.parameters} | TRUTH | {"sensor_delay": 0.0}
    episode = simulate(model, robot, signal, values, config)
    readings = episode.outputs["sensor"]
    readings["position"] = np.round(readings["position"] / COUNT_RAD) * COUNT_RAD
    table = model.parameters.with_fixed({"sensor_delay": 0.0, "payload": 0.0})
    spans = [Span(0, begin_s) for begin_s in (2.6, 7.8)]
    problem = Problem(model, [episode], spans, 1.3, config, table)
    x = table.encode(values | SECOND)
    second = Refined(x, problem.loss(x), np.nan, False)
    found = table.decode(_at_other_delays(problem, second, None, takes_long=False).x)
    assert found["actuator_delay"] == pytest.approx(TRUTH["actuator_delay"], abs=1.5e-3)
    assert found["armature"] == pytest.approx(TRUTH["armature"], rel=0.1)
