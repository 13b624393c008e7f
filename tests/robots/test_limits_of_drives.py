"""Servos with a limit of torque or speed: C MuJoCo records, and ``auto`` has to find the limit, or none."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from recorded_on_c import play

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.identification.config import FitConfig
from sim2real.identification.fit import fit
from sim2real.identification.held_out import folds_of
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.identification.terms import TermSearch
from sim2real.identification.uncertainty import NOT_REACHED
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.identify.judgement import Findings
from sim2real.stages.shared.identification import offering, with_wanted_terms
from sim2real.worlds.drive_terms import NO_LIMIT

STEP_S, PERIOD, SECONDS, NOISE = 0.005, 2, 4.0, 5e-4
XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody><body name="link">
  <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01"/>
  <inertial pos="0 0 -0.15" mass="0.6" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>"""
KP, KD, TORQUE = 12.0, 0.5, 2.0


def recorded(tmp_path, torque=np.inf, speed=np.inf):
    """Return the robot from its MJCF, and an episode of steps of a cascade of position and speed with two limits."""
    path = tmp_path / "arm.xml"
    path.write_text(XML)
    model = mujoco.MjModel.from_xml_string(XML)
    count = round(SECONDS / STEP_S / PERIOD)
    goals = np.repeat(np.random.default_rng(3).uniform(-1.2, 1.2, 1 + count // 50), 50)[:count, None]

    def push(k, _, data):
        wanted = np.clip(KP / KD * (goals[k] - data.qpos), -speed, speed)
        return np.clip(KD * (wanted - data.qvel), -torque, torque)

    episode = play(model, goals, push, PERIOD, NOISE)
    terms = tuple(map(ParameterPattern, ("kp", "kd", "armature")))
    config = RobotConfig(path, ("elbow",), ("goal",), step_s=STEP_S, rate_hz=100.0, terms=terms, sigma_rad=NOISE)
    return MjcfRobot(config), episode


def fitted(robot, episode, terms):
    """Return the fit with optional terms, whose bounds are from the recording."""
    model = offering(robot, terms).identifiable(0.02)
    table = with_wanted_terms(model.parameters.with_reached(model.reached([episode])), terms)
    spans = [Span(0, begin) for begin in np.arange(0.2, SECONDS - 0.8, 0.6)]
    return fit(Problem(model, [episode], spans, 0.6, FitConfig(generations=0, max_delay_s=0.02), table))


BOTH = "torque_limit,speed_limit"


@pytest.mark.night
@pytest.mark.parametrize(
    ("offered", "limits", "chosen", "name", "truth"),
    [
        ("torque_limit", {"torque": TORQUE}, "torque_limit", "torque", TORQUE),
        pytest.param(BOTH, {"torque": TORQUE}, "torque_limit", "torque", TORQUE, marks=pytest.mark.night),
        pytest.param(BOTH, {}, None, "", 0.0, marks=pytest.mark.night),
    ],
)
def test_auto_finds_a_limit_that_was_reached(tmp_path, offered, limits, chosen, name, truth):
    robot, episode = recorded(tmp_path, **limits)
    widest = fitted(robot, episode, offered)
    found, table = TermSearch(widest, folds_of(widest.problem, 3), 0.3, 0.0).select(), widest.problem.table
    assert found.chosen.names(table) == ((chosen,) if chosen else ())
    values = table.decode(found.chosen.x, table.of_terms(found.chosen.present))
    assert all(float(values[n]) == NO_LIMIT for n in {"torque", "top_speed"}.intersection(table.names) - {name})
    assert float(values["kp"]) == pytest.approx(KP, rel=0.05)
    if chosen:
        assert float(values[name]) == pytest.approx(truth, rel=0.05)
        errors = {t.names(table): t.error for t in found.trials}
        assert errors[chosen,] < 0.5 * errors[()]


@pytest.mark.night
def test_a_limit_that_is_named_and_was_not_reached_has_no_number(tmp_path):
    robot, episode = recorded(tmp_path)
    findings = Findings.of(fitted(robot, episode, "torque_limit"))
    table = findings.fit.problem.table
    verdicts = dict(zip(table.names, findings.spread.verdict, strict=True))
    assert verdicts["torque"] == NOT_REACHED
    assert findings.spread.low[table.names.index("torque")] > 1.0


def test_tables_omit_a_limit_that_the_model_does_not_have():
    torque = Estimate("torque", "N m", "dynamics", "", NO_LIMIT, NO_LIMIT, "fixed")
    held = replace(torque, nominal=2.0, estimate=2.0)
    found = Identification("arm", (), Judgement("accepted", ()), (torque, replace(held, name="limit")))
    assert "limit" in str(found.rows())
    assert "torque" not in str(found.rows())


def test_bounds_of_a_limit_are_around_what_the_recording_reaches(tmp_path):
    robot, episode = recorded(tmp_path, torque=TORQUE)
    model = offering(robot, "auto").identifiable(0.02)
    reached = model.reached([episode])
    assert reached["torque"] == pytest.approx(TORQUE, rel=0.5)
    fastest = np.abs(np.gradient(episode.outputs["sensor"]["position"][:, 0], 0.01)).max()
    assert 0.5 * fastest < reached["top_speed"] <= fastest
    table = model.parameters.with_reached(reached)
    assert table["torque"].low < reached["torque"] == table["torque"].begin < table["torque"].high
    given = model.parameters.with_bounds({"torque": (0.5, 3.0)}).with_reached(reached)
    assert (given["torque"].low, given["torque"].high) == (0.5, 3.0)
