"""Robots that their MJCF file alone describes: C MuJoCo records a joint whose drive hides a law; a fit finds it."""

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode, Steps
from sim2real.identification import held_out, residuals, terms
from sim2real.identification.config import FitConfig
from sim2real.identification.fit import fit, refine
from sim2real.identification.held_out import folds_of
from sim2real.identification.lacks import turned_gravity
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.identification.terms import TermSearch
from sim2real.identification.uncertainty import NOT_REACHED
from sim2real.log.importing.names import meaning
from sim2real.robots.model.parameters import ParameterPattern, like_joints, sharing, usual_patterns
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.identify.judgement import Findings, tilted
from sim2real.stages.shared.identification import offering, with_wanted_terms
from sim2real.worlds.drive_terms import NO_LIMIT

STEP_S, PERIOD, SECONDS, NOISE = 0.002, 5, 4.0, 2e-4
T_S = STEP_S * PERIOD * np.arange(round(SECONDS / STEP_S / PERIOD))
BEGINS_S = np.arange(0.2, SECONDS - 0.8, 0.6)
BODY = """<body name="{name}"><joint name="{name}" axis="0 1 0" damping="{damping}" armature="{armature}"/>
  <inertial pos="{at}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>{held}</body>"""
WORLD = '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>{}</worldbody></mujoco>'
BODY_OF_ONE = {
    "name": "link",
    "damping": 0.4,
    "armature": 0.02,
    "at": "0 0 -0.2",
    "mass": 1,
    "inertia": 1e-3,
    "held": "",
}


def link(**body):
    return WORLD.format(BODY.format(**{**BODY_OF_ONE, **body}))


def robot_of(folder, text, terms=("kp", "damping"), commands=("goal",), joints=("link",), **config):
    path = folder / "robot.xml"
    path.write_text(text)
    patterns = tuple(map(ParameterPattern, terms))
    return MjcfRobot(
        RobotConfig(path, joints, commands, step_s=STEP_S, rate_hz=100.0, sigma_rad=NOISE, terms=patterns, **config)
    )


def waves(fast=5.3, slow=2.1):
    return (0.8 * np.sin(slow * T_S) + 0.4 * np.sin(fast * T_S))[:, None]


def play(model, goals, push, every=PERIOD, **told):
    """Return what a position sensor saw, with noise.

    Args:
        model: A compiled model, in its time step.
        goals: Shape ``(T, n)`` [rad]: the goals of the samples; the joints start at the first.
        push: Returns the torques of a time step, given the sample's number, the step's number in it, and the data.
        every: Time steps of a sample.
        told: Further commands of the log, shape ``(T, n)`` each.
    """
    data, angles = mujoco.MjData(model), []
    data.qpos[:] = goals[0]
    for k in range(len(goals)):
        angles.append(data.qpos.copy())
        for step in range(every):
            data.qfrc_applied[:] = push(k, step, data)
            mujoco.mj_step(model, data)
    at = np.arange(len(goals)) * round(1e6 * model.opt.timestep * every)
    steps = Steps(at, at, at, 0 * at - 1, at + 10, 0 * at)
    measured = np.array(angles) + NOISE * np.random.default_rng(0).normal(size=goals.shape)
    outputs = {"sensor": {"position": measured}, "actuator": {"goal": goals, **told}}
    return Episode(steps={"sensor": steps, "actuator": steps}, messages={}, outputs=outputs)


def problem_of(robot, episodes, wanted="own", **config):
    """Return a problem with optional terms, whose bounds are from the recordings."""
    model = offering(robot, wanted).identifiable(0.02)
    table = with_wanted_terms(model.parameters.with_reached(model.reached(episodes)), wanted)
    spans = [Span(r, begin) for r in range(len(episodes)) for begin in BEGINS_S]
    return Problem(model, episodes, spans, 0.6, FitConfig(generations=0, max_delay_s=0.02, **config), table)


def offered(robot, wanted="auto"):
    """Return the parameters of optional terms, by quantity."""
    return {p.what: p.parameter for p in robot.with_optional_terms(wanted).placed}


# A controller that carries the arm's weight

ARM, KP, SHARE = link(damping=0.5, armature=0.05, mass=3, inertia=0.02), 60.0, 0.9


@pytest.mark.night
def test_auto_finds_that_the_controller_carries_the_weight(tmp_path, monkeypatch):
    """Sets of terms are compared on fewer segments where all would take long: a part has as many errors as ever."""
    model = mujoco.MjModel.from_xml_string(ARM.replace('<body name="link"', f'<body gravcomp="{SHARE}" name="link"'))
    goals = waves()
    episode = play(model, goals, lambda k, _, data: KP * (goals[k] - data.qpos))
    widest = fit(problem_of(robot_of(tmp_path, ARM), [episode], "gravcomp"))
    table, sets, simulated, ahead = widest.problem.table, [], [], held_out._ahead
    of_segment = 0.6 / STEP_S * (residuals._BESIDE + 1) * len(table)
    monkeypatch.setattr(terms, "MOST_OF_SETS", 4 * of_segment + 1)
    search = TermSearch(widest, folds_of(widest.problem, 3), 0.3, 0.0, sets.append)
    monkeypatch.setattr(held_out, "_ahead", lambda w, *rest: (simulated.append(len(w.train)), ahead(w, *rest))[1])
    found = search.select()
    assert (search.segments, sets[:2], set(simulated)) == (4, ["no term", "gravcomp"], {5})
    assert found.chosen.names(table) == ("gravcomp",)
    values = table.decode(found.chosen.x, table.of_terms(found.chosen.present))
    assert float(values["gravcomp"]) == pytest.approx(SHARE, abs=0.02)
    assert float(values["kp"]) == pytest.approx(KP, rel=0.02)
    errors = {t.names(table): t.error for t in found.trials}
    assert errors["gravcomp",] < 0.1 * errors[()]


def test_the_share_is_the_models_own_unless_it_is_chosen_and_none_without_gravity(tmp_path):
    robot = robot_of(tmp_path, ARM)
    assert "gravcomp" not in {p.what for p in robot.placed}
    assert offered(robot)["gravcomp"].without == 0.0
    assert "gravcomp" not in offered(robot_of(tmp_path, ARM.replace("<option", '<option gravity="0 0 0"')))
    other = robot_of(tmp_path, ARM.replace("<body name", '<body gravcomp="1" name')).with_optional_terms("auto")
    assert {p.what: p.parameter for p in other.placed}["gravcomp"].without == 1.0
    text = other.exported({p.parameter.name: p.parameter.nominal for p in other.placed} | {"gravcomp": 0.6}).mjcf
    assert text.count('gravcomp="0.6"') == 1


# A base that is mounted at an angle, or hangs from a ceiling

BASE = link(damping=2, armature=0.1, mass=3, at="0.1 0 -0.2", inertia=0.02)


def turned(folder, angle, fix=None):
    """Return what is found of a base turned about the y axis, beside estimates that are right but for gravity."""
    model, goals, robot = mujoco.MjModel.from_xml_string(BASE), waves(), robot_of(folder, BASE)
    model.opt.gravity[:] = 9.81 * np.array([-np.sin(angle), 0.0, -np.cos(angle)])
    log = SimpleNamespace(episode=play(model, goals, lambda k, _, data: KP * (goals[k] - data.qpos)))
    values = {p.name: KP if p.name.startswith("kp") else p.nominal for p in robot.identifiable(0.02).parameters}
    config = IdentifyConfig(max_delay_s=0.02, settle_s=0.1, horizon_s=0.5, fix=fix or {})
    inputs = Inputs(robot, config, robot, None, None, (log,), ("",), 1, [Span(0, begin) for begin in BEGINS_S])
    found = SimpleNamespace(problem=SimpleNamespace(table=SimpleNamespace(terms=())), values=values)
    problem = tilted(inputs, found)
    return None if problem is None else turned_gravity(problem, values)


@pytest.mark.night
@pytest.mark.parametrize("angle", [0.7, 3.1])
def test_the_turn_of_gravity_is_found(tmp_path, angle):
    share, turns = turned(tmp_path, angle)
    assert share > 0.9
    x, y = turns["tilt_x"], turns["tilt_y"]
    in_plane = np.array([np.sin(y), np.cos(y)]) * np.cos(x)  # a hinge about y does not see the rest
    np.testing.assert_allclose(in_plane, [np.sin(angle), np.cos(angle)], atol=0.05)


@pytest.mark.parametrize(
    ("angle", "fix"), [(0.7, {"tilt_x": 0.0, "tilt_y": 0.0}), pytest.param(0.0, None, marks=pytest.mark.night)]
)
def test_a_turn_that_is_held_or_not_there_is_not_doubted(tmp_path, angle, fix):
    assert turned(tmp_path, angle, fix) is None


# Limits of torque and speed

ELBOW, TORQUE = link(damping=0.05, armature=0.01, at="0 0 -0.15", mass=0.6), 2.0
BOTH = "torque_limit,speed_limit"


def stepped(folder, torque=np.inf, speed=np.inf):
    """Return a robot, and an episode of steps of a cascade of position and speed with two limits."""
    goals = np.repeat(np.random.default_rng(3).uniform(-1.2, 1.2, 8), 50)[: len(T_S), None]

    def push(k, _, data):
        wanted = np.clip(12.0 / 0.5 * (goals[k] - data.qpos), -speed, speed)
        return np.clip(0.5 * (wanted - data.qvel), -torque, torque)

    robot = robot_of(folder, ELBOW, ("kp", "kd", "armature"))
    return robot, play(mujoco.MjModel.from_xml_string(ELBOW), goals, push)


@pytest.mark.night
@pytest.mark.parametrize(
    ("offers", "limits", "chosen"),
    [
        ("torque_limit", {"torque": TORQUE}, ("torque_limit",)),
        (BOTH, {"torque": TORQUE}, ("torque_limit",)),
        (BOTH, {}, ()),
    ],
)
def test_auto_finds_a_limit_that_was_reached(tmp_path, offers, limits, chosen):
    robot, episode = stepped(tmp_path, **limits)
    widest = fit(problem_of(robot, [episode], offers))
    found, table = TermSearch(widest, folds_of(widest.problem, 3), 0.3, 0.0).select(), widest.problem.table
    assert found.chosen.names(table) == chosen
    values = table.decode(found.chosen.x, table.of_terms(found.chosen.present))
    expected = {n: limits.get(n, NO_LIMIT) for n in ("torque", "top_speed") if n in table.names} | {"kp": 12.0}
    assert {n: float(values[n]) for n in expected} == pytest.approx(expected, rel=0.05)
    if chosen:
        errors = {t.names(table): t.error for t in found.trials}
        assert errors[chosen] < 0.5 * errors[()]


@pytest.mark.night
def test_a_limit_that_is_named_and_was_not_reached_has_no_number(tmp_path):
    robot, episode = stepped(tmp_path)
    findings = Findings.of(fit(problem_of(robot, [episode], "torque_limit")))
    at = findings.fit.problem.table.names.index("torque")
    assert findings.spread.state[at] == NOT_REACHED
    assert findings.spread.low[at] > 1.0


def test_tables_omit_a_limit_that_the_model_does_not_have():
    torque = Estimate("torque", "N m", "dynamics", "", NO_LIMIT, NO_LIMIT, "fixed")
    held = replace(torque, nominal=2.0, estimate=2.0)
    found = Identification("arm", (), Judgement("accepted", ()), (torque, replace(held, name="limit")))
    assert "limit" in str(found.rows())
    assert "torque" not in str(found.rows())


def test_bounds_of_a_limit_are_around_what_the_recording_reaches(tmp_path):
    robot, episode = stepped(tmp_path, torque=TORQUE)
    model = offering(robot, "auto").identifiable(0.02)
    reached = model.reached([episode])
    assert reached["torque"] == pytest.approx(TORQUE, rel=0.5)
    fastest = np.abs(np.gradient(episode.outputs["sensor"]["position"][:, 0], 0.01)).max()
    assert 0.5 * fastest < reached["top_speed"] <= fastest
    table = model.parameters.with_reached(reached)
    assert table["torque"].low < reached["torque"] == table["torque"].begin < table["torque"].high
    given = model.parameters.with_bounds({"torque": (0.5, 3.0)}).with_reached(reached)
    assert (given["torque"].low, given["torque"].high) == (0.5, 3.0)


# A strength that follows the supply voltage


@pytest.mark.night
@pytest.mark.parametrize("share", [1.0, 0.0])
def test_the_share_that_follows_the_voltage_is_found(tmp_path, share):
    goals, volts = waves(9.3, 3.1), (7.4 * (1.0 - 0.15 * np.sin(1.9 * T_S) ** 2))[:, None]
    strength = 1.0 + share * (volts / 7.4 - 1.0)
    push = lambda k, _, data: 12.0 * strength[k] * (goals[k] - data.qpos)  # noqa: E731
    episode = play(mujoco.MjModel.from_xml_string(link()), goals, push, volts=volts)
    robot = robot_of(tmp_path, link(), ("kp", "damping", "voltage"), ("goal", "volts"), volts_unit=7.4)
    found = fit(problem_of(robot, [episode])).values
    assert found["voltage"] == pytest.approx(share, abs=0.05)
    assert found["kp"] == pytest.approx(12.0, rel=0.02)


@pytest.mark.parametrize(("commands", "there"), [(("goal",), False), (("goal", "volts"), True)])
def test_the_term_is_offered_for_a_log_with_a_voltage_alone(tmp_path, commands, there):
    assert ("voltage" in offered(robot_of(tmp_path, link(), ("kp",), commands))) == there


# Another payload in each log

HELD = '<body pos="0 0 {at}"><inertial pos="0 0 0" mass="{kg}" diaginertia="1e-9 1e-9 1e-9"/></body>'
ROD = {"at": "0 0 -0.05", "mass": 0.1, "inertia": 1e-4}
LOADS = ((0.5, 0.1), (1.3, 0.15))
FINE, DELAY = 20, 2


def carrying(kg, reach):
    model = mujoco.MjModel.from_xml_string(link(**ROD, held=HELD.format(at=-reach, kg=kg)))
    model.opt.timestep = STEP_S / FINE  # a robot has no time steps
    goals = waves(9.3, 3.1)

    def push(k, step, data):  # goals act two time steps late
        return 12.0 * (goals[max(k - 1, 0) if step < DELAY * FINE else k] - data.qpos)

    held = {"payload": np.full_like(goals, kg), "payload_reach": np.full_like(goals, reach)}
    return play(model, goals, push, PERIOD * FINE, **held)


def loaded(folder, commands=("goal", "payload", "payload_reach"), text=None, **config):
    return robot_of(folder, text or link(**ROD), commands=commands, **config)


@pytest.mark.night
@pytest.mark.parametrize("engine", ["c", "compiled"])
def test_logs_with_different_payloads_give_the_drive_of_all(tmp_path, engine):
    found = fit(problem_of(loaded(tmp_path), [carrying(*load) for load in LOADS], engine=engine))
    assert found.values["kp"] == pytest.approx(12.0, rel=0.005)
    assert found.values["damping"] == pytest.approx(0.4, rel=0.01)
    assert found.loss < 0.6  # 0.5 is noise


def test_without_the_field_one_mass_fits_neither_log(tmp_path):
    problem = problem_of(loaded(tmp_path, ("goal",)), [carrying(*load) for load in LOADS], engine="c")
    assert problem.loss(problem.table.encode({"kp": 12.0, "damping": 0.4, "delay": 0.0})) > 500.0  # 0.5 is noise


def test_columns_of_a_payload_are_found_by_their_names():
    names = ("payload_kg", "payload_reach_m", "arm/payload", "reach")
    assert [meaning(name).quantity for name in names] == ["payload", "reach", "payload", ""]


def test_the_torque_that_a_limit_is_sought_from_includes_the_payload(tmp_path):
    heavy = carrying(*LOADS[1])
    robots = (loaded(tmp_path, commands) for commands in (("goal", "payload", "payload_reach"), ("goal",)))
    with_it, without = (r.with_optional_terms("torque_limit").identifiable(0.02).reached([heavy]) for r in robots)
    assert with_it["torque"] > 1.0 + without["torque"]  # weight: 1.9 N m


def test_payloads_that_cannot_be_are_refused(tmp_path):
    episode = carrying(*LOADS[0])
    with pytest.raises(Sim2RealError, match="has a payload_reach and no payload"):
        loaded(tmp_path, ("goal", "payload_reach")).doubts(episode.outputs)
    episode.outputs["actuator"]["payload"][100:] = 0.7
    with pytest.raises(Sim2RealError, match=r"payload is 0.5, 0.7 kg: a log has one payload"):
        loaded(tmp_path).doubts(episode.outputs)
    with pytest.raises(UsageError, match="no body 'hand' for the payload"):
        loaded(tmp_path, payload_body="hand")
    with pytest.raises(UsageError, match="centre of mass of body 'link' is at its origin"):
        loaded(tmp_path, text=link(**{**ROD, "at": "0 0 0"}))


# Groups of joints with values other than the shared one

GO2 = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "gripper"]


def test_joints_with_like_names_form_a_group():
    assert like_joints(GO2) == [GO2[0::3], GO2[1::3], GO2[2::3]]
    assert like_joints(["leftKnee", "left_ankle", "rightKnee", "right_ankle"])[0] == ["leftKnee", "rightKnee"]
    assert like_joints(JOINTS) == [[name] for name in JOINTS]
    assert like_joints(["joint1", "joint2", "joint3"]) == [["joint1", "joint2", "joint3"]]


@pytest.mark.parametrize(
    ("joints", "wanted", "by"),
    [
        (GO2, "auto", {"kp_by_group", "damping_by_group", "armature_by_group"}),
        (JOINTS, "auto", {"kp_by_joint", "damping_by_joint", "armature_by_joint"}),
        (GO2, "load,kp_by_joint", {"kp_by_joint"}),
        (["joint1"], "auto", set()),
    ],
)
def test_groups_are_offered_where_there_are_some_and_single_joints_where_there_are_few(joints, wanted, by):
    usual = (*usual_patterns(("goal",)), ParameterPattern("kd", free=False))
    found = {t.name: t for t in sharing(usual, joints, wanted)}
    assert {t.term for t in found.values()} == by
    assert joints is not GO2 or wanted != "auto" or found["kp_of_calf_joint"].joints.count("|") == 3
    assert "kp_by_joint" in {t.term for t in sharing(usual, GO2, "all")}, "`validate` finds it again"


@pytest.mark.night
def test_a_joint_with_another_stiffness_gets_a_factor(tmp_path):
    pair = {**BODY_OF_ONE, "at": "0 0 -0.1", "mass": 0.5}
    text = WORLD.format("".join(BODY.format(**{**pair, "name": name}) for name in ("pan", "lift")))
    goals, kp = np.hstack([waves(9.3, 3.1), 0.7 * np.sin(4.0 * T_S + 1.0)[:, None]]), np.array([12.0, 24.0])
    model = mujoco.MjModel.from_xml_string(text)
    episode = play(model, goals, lambda k, _, data: kp * (goals[k] - data.qpos))
    robot = robot_of(tmp_path, text, joints=("pan", "lift"))
    found = fit(problem_of(robot, [episode], "kp_by_joint"))
    # Without the factor, in the same programs.
    problem, shared = found.problem, np.array([name != "kp_of_lift_alone" for name in found.problem.table.names])
    assert not shared.all()
    assert found.loss < 0.01 * refine(problem, problem.table.start()[None], problem.part(present=shared)).loss
    expected = {"kp": 12.0, "kp_of_lift_alone": 2.0, "damping": 0.4}
    assert {n: found.values[n] for n in expected} == pytest.approx(expected, rel=0.05)
    # The model with these values has both stiffnesses.
    made = mujoco.MjModel.from_xml_string(offering(robot, "kp_by_joint").exported(found.values).mjcf)
    assert made.actuator_gainprm[:, 0] == pytest.approx(kp, rel=0.06)
