"""Optional terms of friction and drive: on both engines, and beside a simulation that is written by hand."""

import math
from dataclasses import fields
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.composer.c.rollouts import Rollouts, Start
from sim2real.graph.episode import Episode, Steps
from sim2real.identify.config import FitConfig
from sim2real.identify.problem import Problem
from sim2real.identify.segments import Span
from sim2real.robots.mjcf import driven
from sim2real.robots.mjcf_parameters import LAWS, OPTIONAL, ParameterPattern, optional
from sim2real.robots.mjcf_robot import MjcfRobot, RobotConfig, usual_terms
from sim2real.stages import left_out
from sim2real.worlds.drive_terms import DriveLaw, DriveTerms

MASS, LENGTH, STEP_S = 0.5, 0.12, 0.001
XML = f"""<mujoco><option timestep="{STEP_S}"/><worldbody><body>
  <joint name="servo" axis="0 1 0" damping="0.02" armature="0.004" frictionloss="{{friction}}"/>
  <inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-4 1e-4 1e-4"/></body></worldbody>
  <actuator><motor joint="servo" forcerange="-3 3"/></actuator></mujoco>"""
OWN = {"damping": 0.02, "armature": 0.004, "frictionloss": 0.03, "kp": 9.0, "kd": 0.3, "limit": 3.0}
ON = {"load": 0.25, "static": 0.25, "stribeck_rad_s": 0.3, "drag": 0.02, "bias": 0.05, "back_emf": 0.12}
OFF = dict.fromkeys(ON, 0.0) | {"stribeck_rad_s": 0.1}


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(XML.format(friction=OWN["frictionloss"]))
    return path


def commands(count):
    """Return goals, and torque that is off in the last third."""
    t = STEP_S * np.arange(count)
    return 0.6 * np.sin(5.0 * t) + 0.3 * np.sin(9.0 * t), (t < 2 * t[-1] / 3).astype(float)


def by_hand(terms, goals, on, start):
    """Return angles after each step: semi-implicit Euler, implicit damping, friction that stops at most."""
    p = {**OWN, **terms}
    inertia = MASS * LENGTH**2 + 1e-4 + p["armature"]
    q, w, out = *start, []
    for goal, enabled in zip(goals, on, strict=True):
        servo = enabled * (p["kp"] * (goal - q) - p["kd"] * w)
        drive = max(-p["limit"], min(p["limit"], servo)) - enabled * p["back_emf"] * w
        dry = p["frictionloss"] + p["static"] * math.exp(-abs(w) / p["stribeck_rad_s"]) + p["load"] * abs(drive)
        inside = drive + enabled * p["back_emf"] * w
        brake = p["damping"] + p["drag"] * abs(w) + enabled * p["back_emf"]
        pushed = w + STEP_S / inertia * (inside - p["bias"] - MASS * 9.81 * LENGTH * math.sin(q))
        stopped = math.copysign(max(abs(pushed) - STEP_S * dry / inertia, 0.0), pushed)
        w = stopped / (1 + STEP_S * brake / inertia)
        q += STEP_S * w
        out.append(q)
    return np.array(out)


def in_c(model_file, terms, goals, on, start):
    model = driven(model_file, ("servo",), STEP_S, False, False)
    law = DriveLaw(np.array([0]), np.array([0]))
    kp = OWN["kp"] * on
    control = np.stack([kp * goals, kp, OWN["kd"] * on, on], axis=1)[:, None]
    values = {n: np.array([v]) for n, v in {**OWN, **terms}.items()}
    state = Start(np.array([start[0]]), np.array([start[1]]), np.zeros(1))
    return Rollouts(model, 1, (), law=law)({}, state, control, values)[0][1:, 0]


@pytest.mark.parametrize("one", [*OPTIONAL, "all"])
def test_terms_move_a_joint_as_a_simulation_by_hand(model_file, one):
    goals, on = commands(1500)
    own = ON if one == "all" else OFF | {what: ON[what] for what in OPTIONAL[one]}
    found, expected, without = (
        play(terms, goals, on, (0.4, -2.0))
        for play, terms in ((lambda *a: in_c(model_file, *a), own), (by_hand, own), (by_hand, OFF))
    )
    # MuJoCo's dry friction gives a little where a joint nearly sticks.
    rms = lambda x: np.sqrt(np.mean(x**2))  # noqa: E731
    assert rms(found - expected) < 0.008
    assert rms(found - expected) < 0.5 * rms(found - without)


@pytest.fixture(scope="module")
def engines(tmp_path_factory):
    """Residuals of a segment as functions of the parameters, of both engines, in double precision."""
    path = tmp_path_factory.mktemp("model") / "robot.xml"
    path.write_text(XML.format(friction=0.0).replace(f'"{STEP_S}"', '"0.002"'))
    terms = (ParameterPattern("kp"), ParameterPattern("kd"), ParameterPattern("frictionloss"))
    robot = MjcfRobot(RobotConfig(path, ("servo",), ("goal", "enabled"), step_s=0.002, rate_hz=100.0, terms=terms))
    robot = robot.with_optional_terms()
    count, rng = 60, np.random.default_rng(1)
    sent = np.arange(count) * 10_000 + rng.integers(0, 4000, count)
    none = np.zeros_like(sent)
    steps = Steps(sent, sent, sent, none - 1, sent + 10, none)
    goals, on = (a[:: len(a) // count][:count, None] for a in commands(600))
    outputs = {"sensor": {"position": 0.0 * goals}, "actuator": {"goal": goals, "enabled": on}}
    episode = Episode(steps={"sensor": steps, "actuator": steps}, messages={}, outputs=outputs)
    jax.config.update("jax_enable_x64", True)  # everywhere: the thread that calls C has no context of ours
    try:
        programs = {}
        for engine in ("c", "compiled"):
            config = FitConfig(max_delay_s=0.02, initial_state="measured", engine=engine)
            problem = Problem(robot.identifiable(0.02), [episode], [Span(0, 0.1)], 0.4, config)
            assert problem.engine.name == engine
            programs[engine] = jax.jit(lambda v, p=problem: 0.002 * p.residuals(v, 0, jnp.array([0.3, -1.0]))[0])
        yield SimpleNamespace(**programs)
    finally:
        jax.config.update("jax_enable_x64", False)


def played(program, terms):
    values = {"kp": 9.0, "kd": 0.1, "frictionloss": 0.03, "delay": 0.0071, **terms}
    return np.asarray(program({n: jnp.asarray(v) for n, v in values.items()}))


@pytest.mark.parametrize("one", [*OPTIONAL, "all"])
def test_both_engines_say_the_same(engines, one):
    own = ON if one == "all" else OFF | {what: ON[what] for what in OPTIONAL[one]}
    found = played(engines.c, own)
    np.testing.assert_allclose(found, played(engines.compiled, own), rtol=0, atol=1e-6)
    assert np.abs(found - played(engines.c, OFF)).max() > 1e-3


def test_friction_acts_on_the_compiled_engine_although_the_file_has_none(engines):
    """MJX leaves friction out for good where a model is compiled without any."""
    with_it, without = (played(engines.compiled, OFF | {"frictionloss": v}) for v in (0.3, 0.0))
    assert np.abs(with_it - without).max() > 1e-2


def test_terms_are_offered_and_off_unless_they_are_chosen(model_file):
    config = RobotConfig(model_file, ("servo",), ("goal",), terms=usual_terms(("goal",)))
    robot = MjcfRobot(config)
    assert left_out.offering(robot, "own") is robot
    assert robot.make_nodes()[2].law is None
    table = left_out.offering(robot, "auto").identifiable(0.02).parameters
    assert {p.term for p in table} - {""} == set(OPTIONAL)
    assert table.terms == ()  # none is free by itself
    every = left_out.widest(table, "all")
    assert set(every.terms) == set(OPTIONAL)
    assert {p.name: p.without for p in every if p.term} == {**dict.fromkeys(LAWS, 0.0), "stribeck_rad_s": 0.1}
    values = every.decode(every.start())
    assert all(values[what] > 0.0 for what in LAWS if what != "bias")  # at a bound nothing would move
    assert left_out.widest(table, "load").terms == ("load",)


def test_parameters_of_a_term_bring_it_back(model_file):
    robot = MjcfRobot(RobotConfig(model_file, ("servo",), ("goal",), terms=usual_terms(("goal",))))
    assert left_out.having(robot, ["kp", "delay", "round_trip_delay"]) is robot
    assert left_out.having(robot, ["kp", "load"]).make_nodes()[2].law is not None


def test_a_term_of_the_users_own_is_one_of_those_to_choose_from():
    own = optional((ParameterPattern("load", each=True, high=0.5),))
    assert own[0] == ParameterPattern("load", each=True, high=0.5, term="load")
    assert sorted(t.what for t in own) == sorted(LAWS)


def test_every_coefficient_can_be_identified():
    assert {f.name for f in fields(DriveTerms)} == set(LAWS)
