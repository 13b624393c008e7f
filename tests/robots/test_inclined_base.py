"""An arm on a base that is mounted at an angle, or hangs from a ceiling: the direction of gravity is found."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from recorded_on_c import play

from sim2real.identification.lacks import turned_gravity
from sim2real.identification.segments import Span
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.identify.judgement import tilted

STEP_S, PERIOD, SECONDS, KP = 0.002, 5, 4.0, 60.0
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="upper">
  <joint name="shoulder" axis="0 1 0" damping="2" armature="0.1"/>
  <inertial pos="0.1 0 -0.2" mass="3" diaginertia="0.02 0.02 0.02"/></body></worldbody></mujoco>"""


def found(tmp_path, angle, fix=None):
    """Return what is found of a base turned about the y axis, beside estimates that are right but for gravity."""
    (tmp_path / "arm.xml").write_text(XML)
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.gravity[:] = 9.81 * np.array([-np.sin(angle), 0.0, -np.cos(angle)])
    t = STEP_S * PERIOD * np.arange(round(SECONDS / STEP_S / PERIOD))
    goals = (0.8 * np.sin(2.1 * t) + 0.4 * np.sin(5.3 * t))[:, None]
    episode = play(model, goals, lambda k, _, data: KP * (goals[k] - data.qpos), PERIOD, 2e-4)
    patterns = (ParameterPattern("kp"), ParameterPattern("damping"))
    rig = RobotConfig(tmp_path / "arm.xml", ("shoulder",), ("goal",), step_s=STEP_S, rate_hz=100.0, terms=patterns)
    robot = MjcfRobot(rig)
    values = {p.name: KP if p.name.startswith("kp") else p.nominal for p in robot.identifiable(0.02).parameters}
    config = IdentifyConfig(max_delay_s=0.02, settle_s=0.1, horizon_s=0.5, fix=fix or {})
    windows = [Span(0, begin) for begin in np.arange(0.2, SECONDS - 0.8, 0.6)]
    logs = (SimpleNamespace(episode=episode),)
    inputs = Inputs(robot, config, robot, None, None, logs, ("",), 1, windows)
    fit = SimpleNamespace(problem=SimpleNamespace(table=SimpleNamespace(terms=())), values=values)
    problem = tilted(inputs, fit)
    return None if problem is None else turned_gravity(problem, values)


@pytest.mark.night
@pytest.mark.parametrize("angle", [0.7, 3.1])
def test_the_turn_of_gravity_is_found(tmp_path, angle):
    share, turns = found(tmp_path, angle)
    assert share > 0.9
    x, y = turns["tilt_x"], turns["tilt_y"]
    in_plane = np.array([np.sin(y), np.cos(y)]) * np.cos(x)  # a hinge about y does not see the rest
    np.testing.assert_allclose(in_plane, [np.sin(angle), np.cos(angle)], atol=0.05)


def test_a_turn_that_is_held_is_not_doubted(tmp_path):
    assert found(tmp_path, 0.7, {"tilt_x": 0.0, "tilt_y": 0.0}) is None


@pytest.mark.night
def test_an_upright_base_is_not_doubted(tmp_path):
    assert found(tmp_path, 0.0) is None
