"""A servo whose strength follows its supply voltage: C MuJoCo records, and the share has to be found."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from recorded_on_c import play

from sim2real.identification.config import FitConfig
from sim2real.identification.fit import fit
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.shared.identification import offering

STEP_S, PERIOD, SECONDS, NOISE, KP, VOLTS = 0.002, 5, 4.0, 2e-4, 12.0, 7.4
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
  <joint name="servo" axis="0 1 0" damping="0.4" armature="0.02"/>
  <inertial pos="0 0 -0.2" mass="1" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>"""


@pytest.mark.night
@pytest.mark.parametrize("share", [1.0, pytest.param(0.0, marks=pytest.mark.night)])
def test_the_share_that_follows_the_voltage_is_found(tmp_path, share):
    path = tmp_path / "arm.xml"
    path.write_text(XML)
    model = mujoco.MjModel.from_xml_string(XML)
    t = STEP_S * PERIOD * np.arange(round(SECONDS / STEP_S / PERIOD))
    goals = (0.8 * np.sin(3.1 * t) + 0.3 * np.sin(9.3 * t))[:, None]
    volts = (VOLTS * (1.0 - 0.15 * np.sin(1.9 * t) ** 2))[:, None]
    strength = 1.0 + share * (volts / VOLTS - 1.0)
    push = lambda k, _, data: KP * strength[k] * (goals[k] - data.qpos)  # noqa: E731
    episode = play(model, goals, push, PERIOD, NOISE, volts=volts)
    terms = tuple(map(ParameterPattern, ("kp", "damping", "voltage")))
    config = RobotConfig(path, ("servo",), ("goal", "volts"), step_s=STEP_S, rate_hz=100.0, terms=terms)
    model = MjcfRobot(replace(config, sigma_rad=NOISE, volts_unit=VOLTS)).identifiable(0.02)
    spans = [Span(0, begin) for begin in np.arange(0.2, SECONDS - 0.8, 0.6)]
    found = fit(Problem(model, [episode], spans, 0.6, FitConfig(generations=0, max_delay_s=0.02))).values
    assert found["voltage"] == pytest.approx(share, abs=0.05)
    assert found["kp"] == pytest.approx(KP, rel=0.02)


def test_the_term_is_offered_for_a_log_with_a_voltage_alone(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(XML)
    for commands, there in ((("goal",), False), (("goal", "volts"), True)):
        robot = MjcfRobot(RobotConfig(path, ("servo",), commands, terms=(ParameterPattern("kp"),)))
        offered = offering(robot, "auto").identifiable(0.02).parameters
        assert ("voltage" in {p.term for p in offered}) == there
