"""Exported files for mjlab and Isaac Lab: they call what is there with what it takes, and say the right numbers."""

import sys
from types import ModuleType, SimpleNamespace

import mujoco
import pytest

from sim2real.errors import UsageError
from sim2real.identification.export.targets import TARGETS, Late, late_mjcf, source_of
from sim2real.identification.export.terms import Delays, Term, Terms

NAMES = ("arm/pan/joint", "tilt.joint")
ABOUT = [("verdict", "accepted"), ("log", 'a "quoted" name'), ("not expressed", "eccentricity")]


def joint(**own):
    known = {n: Term(v, v, v) for n, v in {"damping": 0.05, "armature": 0.01, "actuator_damping": 0.0}.items()}
    return {**known, "frictionloss": Term(0.1, 0.08, 0.13), "stiffness": Term(4.0, 3.5, 4.4), **own}


@pytest.fixture
def terms():
    joints = {NAMES[0]: joint(effort_limit=Term(1.4, 1.2, 1.5)), NAMES[1]: joint(damping=Term(0.05, 0.04, 0.07))}
    delays = Delays(Term(0.012, 0.010, 0.014), Term(0.005, 0.0, 0.02), Term(0.017, 0.0163, 0.0177))
    return Terms(joints, {"hand": {"mass": Term(0.2, 0.18, 0.22)}}, delays, 0.0025, ("eccentricity",))


def record(name, allowed):
    """Return a stand-in for a class: it keeps what it was called with, and refuses what the real one would."""

    def made(*args, **options):
        assert set(options) <= set(allowed), f"{name} takes no {set(options) - set(allowed)}"
        return SimpleNamespace(kind=name, args=args, **options)

    made.__name__ = name
    return made


ACTUATOR = ("armature", "frictionloss", "delay_min_lag", "delay_max_lag", "target_names_expr", "transmission_type")
EVENT = ("func", "mode", "params", "min_step_count_between_reset", "interval_range_s", "is_global_time")
ISAAC = (
    *("joint_names_expr", "stiffness", "damping", "effort_limit", "armature", "friction", "dynamic_friction"),
    *("viscous_friction", "min_delay", "max_delay"),
)
RANDOMISE = {
    "joint_damping": {"asset_cfg", "ranges", "operation"},
    "joint_armature": {"asset_cfg", "ranges", "operation"},
    "joint_friction": {"asset_cfg", "ranges", "operation"},
    "body_mass": {"asset_cfg", "ranges", "operation"},
    "pd_gains": {"asset_cfg", "kp_range", "kd_range", "operation"},
    "effort_limits": {"asset_cfg", "effort_limit_range", "operation"},
    "randomize_actuator_gains": {
        "asset_cfg", "stiffness_distribution_params", "damping_distribution_params", "operation",
    },
    "randomize_joint_parameters": {
        "asset_cfg", "friction_distribution_params", "armature_distribution_params", "operation",
    },
}  # fmt: skip
"""Functions of mjlab 1.6 and Isaac Lab 2.3, and what each may be given."""


@pytest.fixture
def simulators(monkeypatch):
    """Modules with the names, and the parameters, that mjlab and Isaac Lab have."""
    functions = SimpleNamespace(**{n: n for n in RANDOMISE})
    position = record("position", (*ACTUATOR, "stiffness", "damping", "effort_limit"))
    entity = record("entity", ("joint_names", "body_names", "actuator_ids"))
    modules = {
        "mjlab.actuator": {"BuiltinPositionActuatorCfg": position},
        "mjlab.envs.mdp": {"dr": functions},
        "mjlab.managers.event_manager": {"EventTermCfg": record("event", EVENT)},
        "mjlab.managers.scene_entity_config": {"SceneEntityCfg": entity},
        "isaaclab.actuators": {
            "DelayedPDActuatorCfg": record("late", ISAAC),
            "ImplicitActuatorCfg": record("implicit", ISAAC[:-2]),
        },
        "isaaclab.envs": {"mdp": functions},
        "isaaclab.managers": {"EventTermCfg": record("event", EVENT), "SceneEntityCfg": entity},
        "isaaclab.utils": {"configclass": lambda kind: kind},
    }  # fmt: skip
    for name in modules:
        parts = name.split(".")
        for i in range(1, len(parts) + 1):
            monkeypatch.setitem(sys.modules, ".".join(parts[:i]), ModuleType(".".join(parts[:i])))
    for name, own in modules.items():
        vars(sys.modules[name]).update(own)


def executed(text):
    names = {}
    exec(compile(text, "exported.py", "exec"), names)
    assert "sim2real" not in "".join(line for line in text.splitlines() if "import" in line)
    return SimpleNamespace(**{n: v for n, v in names.items() if n != "__builtins__"})


def check_events(events):
    for event in events:
        assert set(event.params) <= RANDOMISE[event.func], event.func
    return {(e.func, str(e.params["asset_cfg"])): e.params for e in events}


def test_mjlab_takes_the_file(terms, simulators):
    made = executed(source_of("mjlab", terms, "An arm.", ABOUT))
    first, second = made.ACTUATORS
    assert (first.stiffness, first.armature, first.effort_limit) == (4.0, 0.01, 1.4)
    assert not hasattr(second, "effort_limit")
    assert (first.delay_min_lag, first.delay_max_lag) == (6, 8)  # 16.3 and 17.7 ms in steps of 2.5
    assert second.target_names_expr == (r"tilt\.joint",)
    check_events(made.EVENTS.values())
    assert made.EVENTS["joint_damping"].params["ranges"] == {r"tilt\.joint": (0.04, 0.07)}
    assert set(made.EVENTS["joint_friction"].params["ranges"]) == {NAMES[0], r"tilt\.joint"}
    assert "joint_armature" not in made.EVENTS, "it was not identified"
    assert made.EVENTS["pd_gains_1"].params["kp_range"] == (3.5, 4.4)
    assert made.EVENTS["mass_hand"].params["ranges"] == (0.18, 0.22)


def test_isaac_lab_takes_the_file(terms, simulators):
    made = executed(source_of("isaaclab", terms, "An arm.", ABOUT))
    own = made.ACTUATORS["identified"]
    assert (own.kind, own.min_delay, own.max_delay) == ("late", 6, 8)
    assert own.viscous_friction == {NAMES[0]: 0.05, r"tilt\.joint": 0.05}
    assert own.friction == own.dynamic_friction == {NAMES[0]: 0.1, r"tilt\.joint": 0.1}
    assert own.effort_limit == {NAMES[0]: 1.4}
    events = {n: e for n, e in vars(made.IdentifiedEvents).items() if not n.startswith("_")}
    check_events(events.values())
    assert events["gains_tilt_joint"].params["stiffness_distribution_params"] == (3.5, 4.4)
    scaled = events["joint_arm_pan_joint"].params
    assert scaled["operation"] == "scale"
    assert scaled["friction_distribution_params"] == (0.8, 1.3)
    assert "armature_distribution_params" not in scaled


def test_without_delays_and_intervals_there_is_nothing_to_randomise(terms, simulators):
    known = {
        n: {k: Term(t.estimate, t.estimate, t.estimate) for k, t in own.items()} for n, own in terms.joints.items()
    }
    bare = Terms(known, {}, Delays(), 0.0025, ())
    assert executed(source_of("mjlab", bare, "", ABOUT)).EVENTS == {}
    made = executed(source_of("isaaclab", bare, "", ABOUT))
    assert made.ACTUATORS["identified"].kind == "implicit"


@pytest.mark.parametrize("target", TARGETS)
def test_motors_are_refused_by_name(terms, target):
    motor = {"wheel": {"damping": Term(0, 0, 0), "gain": Term(1, 1, 1)}}
    with pytest.raises(UsageError, match="the actuators of wheel take other commands"):
        source_of(target, Terms({**terms.joints, **motor}, {}, Delays(), 0.01, ()), "", ABOUT)


XML = """
<mujoco>
  <option timestep="0.0025"/>
  <worldbody><body name="hand"><joint name="tilt.joint"/><geom size="0.1"/></body></worldbody>
  <actuator><position name="drive" joint="tilt.joint" kp="4" kv="0.1" forcerange="-1 1"/></actuator>
</mujoco>
"""


def test_mjcf_has_delays_profile_and_intervals_in_mujocos_terms(terms):
    own = Terms({NAMES[1]: terms.joints[NAMES[1]]}, terms.bodies, terms.delays, 0.0025, ())
    model = mujoco.MjModel.from_xml_string(late_mjcf(XML, own, Late(0.001, 5.0), ABOUT))
    assert model.actuator_delay[0] == pytest.approx(0.013)
    assert model.actuator_history[0, 0] >= 0.013 / 0.0025 + 1, "as many samples as the delay is long"
    np_sensors = {model.sensor(i).name: model.sensor_delay[i] for i in range(model.nsensor)}
    assert np_sensors[f"sim2real/position/{NAMES[1]}"] == pytest.approx(0.005)
    assert np_sensors[f"sim2real/velocity/{NAMES[1]}"] == pytest.approx(0.005 - 0.00125)
    assert model.actuator_dynprm[0, 1] == 5.0, "how fast setpoints move"
    assert model.actuator_forcerange[0].tolist() == [-1, 1]
    assert -model.actuator_biasprm[0, 1] == pytest.approx(4.0)
    assert -model.actuator_biasprm[0, 2] == pytest.approx(0.1)
    assert model.nu == 1, "it is still told a position alone"
    assert model.numeric(f"sim2real/joint/{NAMES[1]}/damping").data.tolist() == [0.05, 0.04, 0.07]
    assert model.numeric("sim2real/delay/round_trip").data.tolist() == [0.017, 0.0163, 0.0177]
    names = {model.numeric(i).name for i in range(model.nnumeric)}
    assert f"sim2real/joint/{NAMES[1]}/armature" not in names, "it was not identified"
    assert b"eccentricity" in model.text_data


def test_without_delays_the_model_stays_as_it_is(terms):
    model = mujoco.MjModel.from_xml_string(late_mjcf(XML, Terms({}, {}, Delays(), 0.0025, ()), Late(), []))
    assert model.nhistory == 0
    assert model.na == 0
