"""Logs of one servo that holds another mass in each: C MuJoCo records models with that mass, and one model fits all."""

import mujoco
import numpy as np
import pytest
from recorded_on_c import play

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.identification.config import FitConfig
from sim2real.identification.fit import fit
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.log.importing.names import meaning
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig

STEP_S, PERIOD, DELAY, SECONDS, NOISE, KP, DAMPING = 0.002, 5, 2, 4.0, 2e-4, 12.0, 0.4
RIG = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="rod">
  <joint name="servo" axis="0 1 0" damping="0.4" armature="0.02"/>
  <inertial pos="0 0 -0.05" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>{held}</body></worldbody></mujoco>"""
FINE = 20
HELD = '<body pos="0 0 {at}"><inertial pos="0 0 0" mass="{kg}" diaginertia="1e-9 1e-9 1e-9"/></body>'
LOADS = ((0.5, 0.1), (1.3, 0.15))
COMMANDS = ("goal", "payload", "payload_reach")


def recorded(kg: float, reach: float) -> Episode:
    model = mujoco.MjModel.from_xml_string(RIG.format(held=HELD.format(at=-reach, kg=kg)))
    model.opt.timestep = STEP_S / FINE  # a robot has no time steps
    t = STEP_S * PERIOD * np.arange(round(SECONDS / STEP_S / PERIOD))
    goals = (0.8 * np.sin(3.1 * t) + 0.3 * np.sin(9.3 * t))[:, None]

    def push(k, step, data):  # goals act two time steps late
        return KP * (goals[max(k - 1, 0) if step < DELAY * FINE else k] - data.qpos)

    held = {"payload": np.full_like(goals, kg), "payload_reach": np.full_like(goals, reach)}
    return play(model, goals, push, PERIOD * FINE, NOISE, **held)


def robot(tmp_path, commands=COMMANDS, **changes) -> MjcfRobot:
    path = tmp_path / "rig.xml"
    path.write_text(RIG.format(held=""))
    terms = tuple(map(ParameterPattern, ("kp", "damping")))
    config = RobotConfig(path, ("servo",), commands, step_s=STEP_S, rate_hz=100.0, sigma_rad=NOISE, terms=terms)
    return MjcfRobot(RobotConfig(**{**vars(config), **changes}))


@pytest.mark.night
@pytest.mark.parametrize("engine", ["c", pytest.param("compiled", marks=pytest.mark.night)])
def test_logs_with_different_payloads_give_the_drive_of_all(tmp_path, engine):
    model = robot(tmp_path).identifiable(0.02)
    spans = [Span(r, begin) for r in (0, 1) for begin in np.arange(0.2, SECONDS - 0.8, 0.6)]
    config = FitConfig(generations=0, max_delay_s=0.02, engine=engine)
    found = fit(Problem(model, [recorded(*load) for load in LOADS], spans, 0.6, config))
    assert found.values["kp"] == pytest.approx(KP, rel=0.005)
    assert found.values["damping"] == pytest.approx(DAMPING, rel=0.01)
    assert found.loss < 0.6  # 0.5 is noise


def test_without_the_field_one_mass_fits_neither_log(tmp_path):
    problem = Problem(
        robot(tmp_path, ("goal",)).identifiable(0.02),
        [recorded(*load) for load in LOADS],
        [Span(0, 0.2), Span(1, 0.2)],
        0.6,
        FitConfig(max_delay_s=0.02, engine="c"),
    )
    assert problem.loss(problem.table.encode({"kp": KP, "damping": DAMPING, "delay": 0.0})) > 1000.0


def test_columns_of_a_payload_are_found_by_their_names():
    names = ("payload_kg", "payload_reach_m", "arm/payload", "reach")
    assert [meaning(name).quantity for name in names] == ["payload", "reach", "payload", ""]


def test_the_torque_that_a_limit_is_sought_from_includes_the_payload(tmp_path):
    model = robot(tmp_path).with_optional_terms("torque_limit").identifiable(0.02)
    empty = robot(tmp_path, ("goal",)).with_optional_terms("torque_limit").identifiable(0.02)
    heavy = recorded(*LOADS[1])
    assert model.reached([heavy])["torque"] > 1.0 + empty.reached([heavy])["torque"]  # weight: 1.9 N m


def test_a_payload_that_changes_within_a_log_is_refused(tmp_path):
    episode = recorded(*LOADS[0])
    episode.outputs["actuator"]["payload"][100:] = 0.7
    with pytest.raises(Sim2RealError, match=r"payload is 0.5, 0.7 kg: a log has one payload"):
        robot(tmp_path).doubts(episode.outputs)


def test_a_reach_without_a_payload_is_refused(tmp_path):
    with pytest.raises(Sim2RealError, match="has a payload_reach and no payload"):
        robot(tmp_path, ("goal", "payload_reach")).doubts(recorded(*LOADS[0]).outputs)


def test_a_body_that_cannot_hold_a_payload_is_refused(tmp_path):
    with pytest.raises(UsageError, match="no body 'hand' for the payload"):
        robot(tmp_path, payload_body="hand")
    path = tmp_path / "middle.xml"
    path.write_text(RIG.format(held="").replace("0 0 -0.05", "0 0 0"))
    with pytest.raises(UsageError, match="centre of mass of body 'rod' is at its origin"):
        robot(tmp_path, model=path)
