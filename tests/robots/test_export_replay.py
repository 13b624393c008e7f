"""The exported MJCF alone does in C MuJoCo what the identified graph predicts, and holds the posterior's intervals."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.artifacts.posterior import Posterior
from sim2real.graph.episode import Episode, Steps
from sim2real.identification.config import FitConfig
from sim2real.identification.export.targets import late_mjcf
from sim2real.identification.export.terms import find_terms
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig

STEP_S, SEGMENT_S, COUNT = 0.002, 1.2, 70
XML = f"""<mujoco><option timestep="{STEP_S}" integrator="implicitfast"/><worldbody><body name="arm">
  <joint name="hinge" axis="0 1 0" damping="0.05" armature="0.003" frictionloss="0.02"/>
  <geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.1" mass="0.3"/></body></worldbody>
  <actuator><position name="drive" joint="hinge" kp="4" forcerange="-1 1"/></actuator></mujoco>"""
FOUND = {"kp": 4.0, "damping": 0.08, "frictionloss": 0.05, "armature": 0.004, "payload": 0.05, "delay": 0.0131}
SPREAD = {"damping": 0.1, "frictionloss": 0.2, "armature": 0.05}
SENT = 20_000 * np.arange(COUNT)
GOALS = np.where(np.arange(COUNT) % 25 < 12, 0.6, -0.2) + 0.1 * np.sin(0.9 * np.arange(COUNT))


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "robot.xml"
    path.write_text(XML)
    terms = (ParameterPattern("kp", free=False), *map(ParameterPattern, (*SPREAD, "payload")))
    return MjcfRobot(RobotConfig(path, ("hinge",), ("goal",), step_s=STEP_S, rate_hz=100.0, terms=terms))


@pytest.fixture(scope="module")
def terms(robot):
    table = robot.identifiable(0.03).parameters
    values = {p.name: FOUND.get(p.name, p.nominal) for p in table}
    rows = [Estimate(p.name, p.unit, p.kind, "", p.nominal, values[p.name], "accepted") for p in table]
    scale = np.log([FOUND[n] for n in SPREAD])
    posterior = Posterior(tuple(SPREAD), ("log",) * 3, scale, np.diag(list(SPREAD.values())) ** 2, scale - 3, scale + 3)
    found = replace(Identification("hinge", (), Judgement("accepted", ()), tuple(rows)), posterior=posterior)
    return find_terms(found, lambda values: robot.exported(values).mjcf, {p.name: p.side for p in table})


def test_intervals_are_those_of_the_posterior_field_by_field(terms):
    hinge = terms.joints["hinge"]
    for name, sigma in SPREAD.items():
        ends = FOUND[name] * np.exp([-1.96 * sigma, 1.96 * sigma])
        assert hinge[name].estimate == pytest.approx(FOUND[name], rel=0.03)
        assert (hinge[name].low, hinge[name].high) == pytest.approx(tuple(ends), rel=1.5 * sigma)
    assert hinge["stiffness"].known
    assert (hinge["stiffness"].estimate, hinge["effort_limit"].estimate) == (4.0, 1.0)
    assert terms.bodies == {}, "the payload was not drawn"
    assert terms.unexpressed == ()
    assert terms.delays.command.estimate == FOUND["delay"]


def test_the_exported_file_alone_does_in_c_what_the_graph_predicts(robot, terms):
    """Off by less than 1 % of the motion: commands, delays of both sides, friction that sticks."""
    measured = 10_000 * np.arange(2 * COUNT)
    steps = {n: Steps(t, t, t, 0 * t - 1, t, 0 * t) for n, t in (("sensor", measured), ("actuator", SENT))}
    outputs = {"sensor": {"position": np.zeros((2 * COUNT, 1))}, "actuator": {"goal": GOALS[:, None]}}
    config = FitConfig(max_delay_s=0.03, initial_state="rest")
    episode = Episode(steps=steps, messages={}, outputs=outputs)
    problem = Problem(robot.identifiable(0.03), [episode], [Span(0, 0.0)], SEGMENT_S, config)
    values = {p.name: np.full(1, FOUND.get(p.name, p.nominal)) for p in problem.table}
    ts, error = problem.ts[0], problem.errors(values, np.array([0]), np.zeros((1, 2)))[0]
    ts, ours = ts[ts >= 0], error[: len(ts)][ts >= 0, 0] * problem.channels[0].position_sigma
    assert len(ts) > 80
    assert np.ptp(ours) > 0.5
    # The exported file, where the first command was before.
    exported = robot.exported({n: float(v[0]) for n, v in values.items()})
    model = mujoco.MjModel.from_xml_string(late_mjcf(exported.mjcf, terms, exported.late, []))
    data, rows, nsample = mujoco.MjData(model), [], int(model.actuator_history[0, 0])
    mujoco.mj_initCtrlHistory(model, data, 0, -STEP_S * np.arange(nsample, 0, -1), np.full(nsample, GOALS[0]))
    while data.time < SEGMENT_S + 2 * STEP_S:
        data.ctrl[:], now = GOALS[np.searchsorted(SENT, 1e6 * data.time + 1, side="right") - 1], data.time
        mujoco.mj_step(model, data)
        rows.append([now, data.sensor("sim2real/position/hinge").data[0]])
    off = lambda early_s: np.sqrt(np.mean((np.interp(ts - early_s, *np.array(rows).T) - ours) ** 2)) / np.std(ours)  # noqa: E731
    assert off(0.0) < 0.01
    assert off(0.002) > 0.01, f"2 ms of {FOUND['delay']} s would be seen"
