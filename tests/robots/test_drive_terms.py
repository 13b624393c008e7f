"""Optional terms of friction and drive: on both engines, and beside a simulation that is written by hand."""

import math
from dataclasses import fields
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode, Steps
from sim2real.identification.config import FitConfig
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.robots.model.drives import driven
from sim2real.robots.model.parameters import (
    LIMITS,
    QUANTITIES,
    TERMS,
    ParameterPattern,
    expand,
    tilted,
    usual_patterns,
    with_optional,
)
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.shared.identification import offering, with_wanted_terms
from sim2real.worlds.drive_terms import NO_LIMIT, DriveLaw, DriveTerms
from sim2real.worlds.rollouts import Rollouts, Start

MASS, LENGTH, STEP_S = 0.5, 0.12, 0.001
XML = f"""<mujoco><option timestep="{STEP_S}"/><worldbody><body>
  <joint name="servo" axis="0 1 0" damping="0.02" armature="0.004" frictionloss="{{friction}}"/>
  <inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="1e-4 1e-4 1e-4"/></body></worldbody>
  <actuator><motor joint="servo" forcerange="-3 3"/></actuator></mujoco>"""
OWN = {"damping": 0.02, "armature": 0.004, "frictionloss": 0.03, "kp": 9.0, "kd": 0.3, "limit": 3.0}
ON = {"load": 0.25, "static": 0.25, "stribeck_rad_s": 0.3, "drag": 0.02, "bias": 0.05, "back_emf": 0.12, "play": 0.04,
      "cogging_cos": 0.1, "cogging_sin": -0.2, "cogging_per_turn": 9.0, "eccentric_cos": 0.05, "eccentric_sin": 0.08,
      "damping_bias": -0.015, "tilt_x": 0.25, "tilt_y": -0.2, "gravcomp": 0.7,
      "torque": 1.2, "top_speed": 1.5}  # fmt: skip
OFF = dict.fromkeys(ON, 0.0) | {"stribeck_rad_s": 0.1, "cogging_per_turn": 9.0} | dict.fromkeys(LIMITS, NO_LIMIT)
LAWS = [name for name, quantity in QUANTITIES.items() if quantity.place == "law"]
ONLY_NAMED = [term for term, (first, *_) in TERMS.items() if QUANTITIES[first].named]
MECHANICAL = [name for name in TERMS if name != "voltage"]
"""Those that need no column of the log."""
PER_TURN = ParameterPattern("cogging_per_turn", nominal=9.0, free=False)


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
        error = goal - q - p["eccentric_cos"] * math.cos(q) - p["eccentric_sin"] * math.sin(q)
        answered = math.copysign(max(abs(error) - p["play"], 0.0), error)
        most = p["top_speed"] * (p["kd"] + p["damping"] + p["back_emf"])
        servo = enabled * (max(-most, min(most, p["kp"] * answered)) - p["kd"] * w)
        limit = min(p["limit"], p["torque"])
        cogging = p["cogging_cos"] * math.cos(9.0 * q) + p["cogging_sin"] * math.sin(9.0 * q)
        # Gravity, turned about x and then about y, in the plane of a joint about y.
        down, aside = 9.81 * math.cos(p["tilt_x"]), math.sin(p["tilt_y"])
        lever = (
            (1.0 - p["gravcomp"]) * MASS * LENGTH * down * (math.cos(p["tilt_y"]) * math.sin(q) - aside * math.cos(q))
        )
        drive = max(-limit, min(limit, servo)) - enabled * p["back_emf"] * w
        dry = p["frictionloss"] + p["static"] * math.exp(-abs(w) / p["stribeck_rad_s"]) + p["load"] * abs(drive)
        inside = drive + enabled * p["back_emf"] * w
        viscous = p["damping"] + math.copysign(1.0, w) * p["damping_bias"]
        brake = viscous + p["drag"] * abs(w) + enabled * p["back_emf"]
        pushed = w + STEP_S / inertia * (inside - p["bias"] - cogging - lever)
        stopped = math.copysign(max(abs(pushed) - STEP_S * dry / inertia, 0.0), pushed)
        w = stopped / (1 + STEP_S * brake / inertia)
        q += STEP_S * w
        out.append(q)
    return np.array(out)


def in_c(model_file, terms, goals, on, start, kind=DriveLaw):
    model = driven(model_file, ("servo",), STEP_S, False, False, True, (), True)
    law = kind(np.array([0]), np.array([0]), np.zeros(0, int))
    kp = OWN["kp"] * on
    control = np.stack([kp * goals, kp, OWN["kd"] * on, on, goals], axis=1)[:, None]
    limit = min(OWN["limit"], terms["torque"])
    values = {n: np.array([v]) for n, v in {**OWN, **terms, "limit": limit}.items()}
    values |= {"other_damping": np.zeros(0), "other_frictionloss": np.zeros(0)}  # no joint is without a drive
    state = Start(np.array([start[0]]), np.array([start[1]]), np.zeros(1))
    tilt = expand([ParameterPattern("tilt_x"), ParameterPattern("tilt_y")], ["servo"], model, model)
    fields = {"opt.gravity": np.asarray(tilted(tilt, terms, model.opt.gravity))}
    fields["body_gravcomp"] = np.array([0.0, terms["gravcomp"]])
    fields["jnt_actfrcrange"] = np.array([[-limit, limit]])
    return Rollouts(model, 1, tuple(fields), law=law)(fields, state, control, values)[0][1:, 0]


@pytest.mark.parametrize("one", [*MECHANICAL, "all"])
def test_terms_move_a_joint_as_a_simulation_by_hand(model_file, one):
    goals, on = commands(1500)
    own = ON if one == "all" else OFF | {what: ON[what] for what in TERMS[one]}
    found, expected, without = (
        play(terms, goals, on, (0.4, -2.0))
        for play, terms in ((lambda *a: in_c(model_file, *a), own), (by_hand, own), (by_hand, OFF))
    )
    # MuJoCo's dry friction gives a little where a joint nearly sticks.
    rms = lambda x: np.sqrt(np.mean(x**2))  # noqa: E731
    assert rms(found - expected) < 0.008
    assert rms(found - expected) < 0.5 * rms(found - without)


@pytest.mark.parametrize("one", [*MECHANICAL, "all", "none"])
def test_a_law_without_absent_terms_returns_what_the_whole_law_does(one):
    law, rng = DriveLaw(np.array([1, 0]), np.array([1, 0]), np.array([2])), np.random.default_rng(0)
    own = {"all": ON, "none": OFF}.get(one) or OFF | {what: ON[what] for what in TERMS[one]}
    values = {n: np.full((4, 2), v) for n, v in {**OWN, **own}.items()}
    values |= {"other_damping": np.full((4, 1), 0.3), "other_frictionloss": np.full((4, 1), 0.2)}
    control, qpos, qvel = (rng.uniform(-1.0, 1.0, (4, n)) for n in (10, 3, 3))
    whole, short = (kind(np, values, control, qpos, qvel) for kind in (law, law.among(values)))
    for some, other in zip((*whole[:2], *whole[2].values()), (*short[:2], *short[2].values()), strict=True):
        np.testing.assert_allclose(other, some, atol=1e-15)


@pytest.fixture(scope="module")
def engines(tmp_path_factory):
    """Residuals of a segment on both engines."""
    path = tmp_path_factory.mktemp("model") / "robot.xml"
    path.write_text(XML.format(friction=0.0).replace(f'"{STEP_S}"', '"0.002"'))
    terms = (ParameterPattern("kp"), ParameterPattern("kd"), ParameterPattern("frictionloss"), PER_TURN)
    robot = MjcfRobot(RobotConfig(path, ("servo",), ("goal", "enabled"), step_s=0.002, rate_hz=100.0, terms=terms))
    robot = robot.with_optional_terms()
    count, rng = 60, np.random.default_rng(1)
    sent = np.arange(count) * 10_000 + rng.integers(0, 4000, count)
    none = np.zeros_like(sent)
    steps = Steps(sent, sent, sent, none - 1, sent + 10, none)
    goals, on = (a[:: len(a) // count][:count, None] for a in commands(600))
    outputs = {"sensor": {"position": 0.0 * goals}, "actuator": {"goal": goals, "enabled": on}}
    episode = Episode(steps={"sensor": steps, "actuator": steps}, messages={}, outputs=outputs)
    made = {}
    for engine in ("c", "compiled"):
        config = FitConfig(max_delay_s=0.02, initial_state="measured", engine=engine)
        made[engine] = Problem(robot.identifiable(0.02), [episode], [Span(0, 0.1)], 0.4, config)
        assert made[engine].engine.name == engine
    return SimpleNamespace(**made)


def played(problem, terms):
    values = {"kp": 9.0, "kd": 0.1, "frictionloss": 0.03, "delay": 0.0071, **terms}
    rows = {p.name: np.full(1, values.get(p.name, p.nominal)) for p in problem.table}
    return 0.002 * problem.errors(rows, np.array([0]), np.array([[0.3, -1.0]]) / problem.rollouts.prior)[0]


@pytest.mark.night
@pytest.mark.parametrize("one", [*MECHANICAL, "all"])
def test_both_engines_say_the_same(engines, one):
    own = ON if one == "all" else OFF | {what: ON[what] for what in TERMS[one]}
    found = played(engines.c, own)
    np.testing.assert_allclose(found, played(engines.compiled, own), rtol=0, atol=3e-6)  # float32
    assert np.abs(found - played(engines.c, OFF)).max() > 1e-3


@pytest.mark.night
def test_friction_acts_on_the_compiled_engine_although_the_file_has_none(engines):
    """MJX leaves friction out for good where a model is compiled without any."""
    with_it, without = (played(engines.compiled, OFF | {"frictionloss": v}) for v in (0.3, 0.0))
    assert np.abs(with_it - without).max() > 1e-2


@pytest.fixture(scope="module")
def by_hands_log(tmp_path_factory):
    """Residuals of a recording made by hand: 100 measurements a second of 6 s, with counts of half a milliradian."""
    path = tmp_path_factory.mktemp("model") / "robot.xml"
    path.write_text(XML.format(friction=OWN["frictionloss"]))
    goals = np.repeat(commands(6000)[0][::10], 10)
    angle = np.concatenate([[0.0], by_hand(OFF | PLAY, goals, np.ones(6000), (0.0, 0.0))])[:6000:10]
    at = np.arange(600) * 10_000
    steps = Steps(at, at, at, 0 * at - 1, at + 10, 0 * at)
    outputs = {"sensor": {"position": 5e-4 * np.round(angle / 5e-4)[:, None]}, "actuator": {"goal": goals[::10, None]}}
    episode = Episode(steps={"sensor": steps, "actuator": steps}, messages={}, outputs=outputs)
    held = [ParameterPattern(what, nominal=OWN[what], free=False) for what in ("kp", "kd", "frictionloss")]
    sought = [ParameterPattern(what) for what in PLAY]
    config = RobotConfig(path, ("servo",), ("goal",), step_s=STEP_S, rate_hz=100.0, terms=(*held, *sought))
    model = MjcfRobot(config).identifiable(0.02)
    spans = [Span(0, 0.1 + 0.5 * i) for i in range(4)]
    return Problem(model, [episode], spans, 0.5, FitConfig(max_delay_s=0.02, engine="c"))


PLAY = {"play": 0.03, "tilt_y": 0.15}


@pytest.mark.night
@pytest.mark.parametrize("share", [1e-4, 1e-6, 1e-9])
def test_what_a_delay_of_nothing_would_change_is_known(by_hands_log, share):
    """At a bound the search's own unknown changes nothing, and the delay does: 10 ms of it would be seen."""
    table = by_hands_log.table
    x, late = table.start(), table.names.index("delay")

    def column(share):
        at = by_hands_log.linearise(np.where(np.arange(len(x)) == late, table.low + share * table.span, x))
        return at.jacobian[..., late]

    known = column(0.02)
    assert np.abs(column(share) - known).max() < 0.15 * np.abs(known).max()


def test_terms_are_offered_and_off_unless_they_are_chosen(model_file):
    terms = (*usual_patterns(("goal",)), PER_TURN)
    robot = MjcfRobot(RobotConfig(model_file, ("servo",), ("goal",), terms=terms[:-1]))
    assert offering(robot, "own") is robot
    assert robot.make_nodes()[2].law is None
    table = offering(robot, "auto").identifiable(0.02).parameters
    assert {p.term for p in table} - {""} == set(MECHANICAL) - set(ONLY_NAMED)
    assert table.terms == ()  # none is free by itself
    robot = MjcfRobot(RobotConfig(model_file, ("servo",), ("goal",), terms=terms))
    every = with_wanted_terms(offering(robot, "all").identifiable(0.02).parameters, "all")
    assert set(every.terms) == set(MECHANICAL)
    off = {p.name: p.without for p in every if p.term}
    assert off == {name: OFF[name] for name in set(ON) - {"cogging_per_turn"}}
    values = every.decode(every.start())
    either = {"bias", "damping_bias", "tilt_x", "tilt_y"}
    either |= {"cogging_cos", "cogging_sin", "eccentric_cos", "eccentric_sin"}
    assert all(values[what] > 0.0 for what in set(off) - either)  # at a bound nothing would move
    assert with_wanted_terms(table, "load").terms == ("load",)


@pytest.mark.parametrize("one", ONLY_NAMED)
def test_terms_that_few_robots_tell_are_offered_where_they_are_asked_for(model_file, one):
    robot = MjcfRobot(RobotConfig(model_file, ("servo",), ("goal",), terms=(*usual_patterns(("goal",)), PER_TURN)))
    table = offering(robot, f"load,{one}").identifiable(0.02).parameters
    assert with_wanted_terms(table, f"load,{one}").terms == ("load", one)
    own = with_optional((ParameterPattern(TERMS[one][0]),), "auto")
    assert {t.term for t in own} == set(TERMS) - set(ONLY_NAMED) | {one}
    assert [t.what for t in own if t.term == one] == [TERMS[one][0]], "a robot may feel tilt_y and not tilt_x"


def test_cogging_is_refused_without_how_often_it_repeats(model_file):
    robot = MjcfRobot(RobotConfig(model_file, ("servo",), ("goal",), terms=usual_patterns(("goal",))))
    with pytest.raises(UsageError, match="number of its periods"):
        offering(robot, "cogging")
    with pytest.raises(UsageError, match="counted"):
        ParameterPattern("cogging_per_turn")
    with pytest.raises(UsageError, match="whole robot"):
        ParameterPattern("tilt_x", each=True)


def test_an_encoder_off_its_axis_is_read_back():
    terms = DriveTerms(eccentric_cos=jnp.array([0.05]), eccentric_sin=jnp.array([-0.1]))
    angle = jnp.linspace(-3.0, 3.0, 41)
    np.testing.assert_allclose(terms.angle(terms.read(angle)), angle, atol=2e-4)
    np.testing.assert_allclose(terms.rate(angle, 2.0), 2.0 * jax.vmap(jax.grad(lambda a: terms.read(a)[0]))(angle),
                               rtol=1e-5)  # fmt: skip


def test_a_term_of_the_users_own_is_one_of_those_to_choose_from():
    own = with_optional((ParameterPattern("load", each=True, high=0.5),))
    assert own[0] == ParameterPattern("load", each=True, high=0.5, term="load")
    assert sorted(t.what for t in own) == sorted(
        {*LAWS, "torque", "voltage", "tilt_x", "tilt_y", "gravcomp"} - {w for w in LAWS if "cogging" in w}
    )


def test_every_coefficient_can_be_identified():
    assert {f.name for f in fields(DriveTerms)} == set(LAWS)
