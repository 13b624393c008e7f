"""Joints that were not recorded: what is held changes no inertia and no force of the others."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.robots.model.drives import driven, joints_of
from sim2real.robots.model.held import apply, plan
from sim2real.robots.model.parameters import ParameterPattern
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.worlds.closing import Closing


def tree(rng: np.random.Generator) -> str:
    """Return a random tree of bodies with up to three joints each, in frames, with references and shifted anchors."""
    count = 0

    def numbers(n: int, scale: float = 1.0) -> str:
        return " ".join(f"{scale * x:.4f}" for x in rng.normal(size=n))

    def body(depth: int) -> str:
        nonlocal count
        kinds = ["ball"] if rng.random() < 0.15 else list(rng.choice(["hinge", "slide"], size=rng.integers(1, 4)))
        joints = ""
        for kind in kinds:
            ref = "" if kind == "ball" else f'ref="{rng.normal():.3f}" axis="{numbers(3)}"'
            joints += f'<joint name="j{count}" type="{kind}" pos="{numbers(3, 0.1)}" {ref}/>'
            count += 1
        below = "".join(body(depth + 1) for _ in range(rng.integers(0, 3) if depth < 3 else 0))
        geom = f'<geom size="0.05" pos="{numbers(3, 0.1)}" mass="0.3"/>'
        own = f'<body pos="{numbers(3, 0.2)}" euler="{numbers(3, 40)}">{joints}{geom}{below}</body>'
        return f'<frame pos="{numbers(3, 0.1)}" euler="{numbers(3, 40)}">{own}</frame>' if rng.random() < 0.5 else own

    return f"<mujoco><worldbody>{body(0)}{body(0)}</worldbody></mujoco>"


@pytest.mark.parametrize("seed", range(20))
def test_a_held_joint_changes_no_inertia_and_no_force_of_the_others(seed):
    """At random poses of random trees: the rows of the recorded joints are those of the whole model, to 1e-9."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec.from_string(tree(rng))
    whole = spec.compile()
    simple = joints_of(whole)
    recorded = [name for name in simple if rng.random() < 0.5] or list(simple[:1])
    hold = [f"{name}={rng.normal():.3f}" for name in simple if name not in recorded and rng.random() < 0.7]
    holding = plan(whole, recorded, hold, False, "tree.xml")
    apply(spec, whole, holding)
    made = spec.compile()
    assert [made.joint(i).name for i in range(made.njnt)] == [name for name in simple if name in recorded]
    a, b = mujoco.MjData(whole), mujoco.MjData(made)
    for held in holding.held:
        begin = whole.jnt_qposadr[held.joint]
        a.qpos[begin : begin + len(held.value)] = held.value
    at = [whole.joint(name).dofadr[0] for name in recorded]
    to = [made.joint(name).dofadr[0] for name in recorded]
    for name in recorded:
        a.qpos[whole.joint(name).qposadr[0]] = b.qpos[made.joint(name).qposadr[0]] = rng.normal()
        a.qvel[whole.joint(name).dofadr[0]] = b.qvel[made.joint(name).dofadr[0]] = rng.normal()
    masses = []
    for model, data in ((whole, a), (made, b)):
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        masses.append(full)
    np.testing.assert_allclose(masses[1][np.ix_(to, to)], masses[0][np.ix_(at, at)], atol=1e-9)
    np.testing.assert_allclose(b.qfrc_bias[to], a.qfrc_bias[at], atol=1e-9)


def arm(knee: str = "", rest: str = "") -> str:
    return f"""<mujoco><compiler angle="radian"/><worldbody><body name="upper"><joint name="hip" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.4"/><body name="lower" pos="0 0 -0.2">
    <joint name="knee" axis="0 1 0" {knee}/><geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.6"/>
    </body></body></worldbody>{rest}</mujoco>"""


def held(path, text, hold=(), fix_base=False, joints=("hip",)):
    path.write_text(text)
    config = RobotConfig(path, joints, ("torque",), hold=hold, fix_base=fix_base)
    return [str(h) for h in config.held().held], config.driven()


BENT = '<keyframe><key name="stand" qpos="0.7 -1.5"/></keyframe>'
TWO = '<keyframe><key name="stand" qpos="0.7 -1.5"/><key name="{}" qpos="0.1 -1.0"/></keyframe>'
MOTOR = '<actuator><motor joint="knee"/></actuator>'
LIMITED = 'range="-2.7 -0.8"'


BESIDE = f"""<mujoco><compiler angle="radian"/><worldbody><body><joint name="hip"/><geom size=".1"/></body>
<body><joint name="knee" {LIMITED}/><geom size=".1"/></body></worldbody></mujoco>"""
"""A knee of another leg, which changes nothing of the hip."""


@pytest.mark.parametrize(
    ("text", "hold", "line"),
    [
        (arm(), (), "knee at 0 rad, the model's zero"),
        (arm(LIMITED, BENT), (), "knee at -1.5 rad, keyframe 'stand'"),
        (arm(LIMITED, TWO.format("home")), (), "knee at -1 rad, keyframe 'home'"),
        (arm(LIMITED, TWO.format("lie")), ("lie",), "knee at -1 rad, keyframe 'lie'"),
        (arm(LIMITED, BENT), ("knee=-2.0",), "knee at -2 rad, named"),
        (arm('range="-2.7 -1.5005"', BENT), (), "knee at -1.5 rad, keyframe 'stand', moved into its range"),
        (BESIDE, (), "knee at -0.8 rad, the model's zero, moved into its range"),
        (arm('type="slide"'), ("knee=0.1",), "knee at 0.1 m, named"),
        (arm("", '<actuator><motor joint="hip"/></actuator>'), (), "no actuator of the model drives it"),
        (arm("", MOTOR), (), "knee at 0 rad, the model's zero"),
    ],
)
def test_where_a_joint_that_was_not_recorded_is_held(tmp_path, text, hold, line):
    lines, model = held(tmp_path / "arm.xml", text, hold)
    assert len(lines) == 1
    assert line in lines[0]
    assert model.nv == 1


@pytest.mark.parametrize(
    ("text", "hold", "cause"),
    [
        (
            arm(LIMITED),
            (),
            r"(?s)knee at 0 rad \(the model's zero\), outside -2.7 to -0.8.*--hold knee=",
        ),
        (arm('range="-2.7 -2.0"', BENT), (), "keyframe 'stand'.*outside -2.7"),
        (arm(LIMITED, BENT), ("knee=0.1",), "named.*outside -2.7"),
        (arm(LIMITED, TWO.format("lie")), (), "2 keyframes with different values.*stand, lie"),
        (arm(), ("toe=0.1",), "no joint 'toe' to hold. Joints: hip, knee"),
        (arm(), ("knee",), r"(?s)no keyframe 'knee' to hold. Joints: hip, knee.*JOINT=VALUE"),
        (arm(), ("squat",), "no keyframe 'squat' to hold.*keyframes: none"),
        (arm(), ("hip=0.1",), "'hip' cannot be held: it was recorded"),
        (arm(), ("knee=bent",), "cannot be held at 'bent'"),
        (arm(), ("knee=inf",), "cannot be held at 'inf'"),
        (
            arm("", '<equality><joint joint1="knee" joint2="hip"/></equality>'),
            ("knee=0",),
            "'knee' cannot be held: an equality without a name moves it",
        ),
        (
            arm(
                "",
                '<tendon><fixed name="t"><joint joint="hip" coef="1"/><joint joint="knee" coef="1"/></fixed></tendon>'
                '<actuator><motor tendon="t"/></actuator>',
            ),
            (),
            "(?s)an actuator of tendon 't' moves joint 'knee'.*record it",
        ),
    ],
)
def test_a_joint_that_cannot_be_held_is_refused(tmp_path, text, hold, cause):
    with pytest.raises(UsageError, match=f"(?s){cause}"):
        held(tmp_path / "arm.xml", text, hold)


FINGERS = """<mujoco><compiler angle="radian"/><default><geom size=".01" pos="0 0 .1"/><joint axis="1 0 0"/>
  <site pos="0 0 .1"/></default><worldbody><body name="palm"><joint name="wrist" axis="0 0 1"/><geom size=".05"/>
  <body name="a" pos="0 .1 0"><joint name="a"/><geom/><site name="a"/></body>
  <body name="b" pos="0 -.1 0"><joint name="b"/><geom/><site name="b"/></body>
  <body name="c" pos=".1 0 0"><joint name="c"/><geom/></body>
  </body></worldbody>{}</mujoco>"""
CHAIN = '<equality><joint joint1="a" joint2="b"/><joint joint1="b" joint2="c"/></equality>'
FIXED = '<tendon><fixed name="t" {}><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>{}'
SPATIAL = '<tendon><spatial name="t" {}><site site="a"/><site site="b"/></spatial></tendon>{}'


@pytest.mark.parametrize(
    ("rest", "joints", "free", "left"),
    [
        ('<equality><joint joint1="a" joint2="b"/></equality>', ("a",), {"b"}, (1, 0)),
        (CHAIN, ("a",), {"b", "c"}, (2, 0)),
        ('<equality><joint joint1="a" joint2="b"/></equality>', ("wrist",), set(), (0, 0)),  # a hand that holds still
        ('<equality><joint joint1="a" joint2="b" active="false"/></equality>', ("a",), set(), (0, 0)),
        ('<equality><joint joint1="a"/></equality>', ("wrist",), {"a"}, (1, 0)),
        ('<equality><connect body1="a" body2="b" anchor="0 0 0"/></equality>', ("a",), {"b"}, (1, 0)),
        ('<equality><weld body1="a" body2="b"/></equality>', ("a",), {"b"}, (1, 0)),
        ('<equality><connect site1="a" site2="b"/></equality>', ("b",), {"a"}, (1, 0)),
        ('<equality><connect body1="a" anchor="0 0 0"/></equality>', ("wrist",), {"a"}, (1, 0)),
        ('<equality><connect body1="a" body2="b" anchor="0 0 0"/></equality>', ("c",), set(), (0, 0)),
        (FIXED.format('stiffness="3"', ""), ("a",), {"b"}, (0, 1)),
        (FIXED.format('damping="3"', ""), ("a",), {"b"}, (0, 1)),
        (FIXED.format('range="-1 1"', ""), ("a",), {"b"}, (0, 1)),
        (FIXED.format("", ""), ("a",), set(), (0, 0)),
        (FIXED.format("", '<equality><tendon tendon1="t"/></equality>'), ("a",), {"b"}, (1, 1)),
        (FIXED.format("", '<actuator><motor tendon="t"/></actuator>'), ("c",), set(), (0, 0)),
        (SPATIAL.format('stiffness="3"', ""), ("a",), {"b"}, (0, 1)),
        (SPATIAL.format('stiffness="3"', ""), ("wrist",), set(), (0, 0)),
    ],
)  # fmt: skip
def test_what_a_coupling_moves_is_never_held(tmp_path, rest, joints, free, left):
    path = tmp_path / "hand.xml"
    path.write_text(FINGERS.format(rest))
    model = driven(path, joints, 0.002, False, False)
    assert {model.joint(i).name for i in range(model.njnt)} == {*joints} | free
    assert (model.neq, model.ntendon) == left


def test_a_segment_of_a_mechanism_begins_with_its_loop_closed(tmp_path):
    path = tmp_path / "hand.xml"
    path.write_text(FINGERS.format('<equality><joint joint1="b" joint2="a" polycoef="0.1 -2 0 0 0"/></equality>'))
    terms = (ParameterPattern("frictionloss"), ParameterPattern("drag"))
    robot = MjcfRobot(RobotConfig(path, ("a",), ("torque",), terms=terms))
    model = robot.identifiable(0.02)
    params = model.params({p.name: p.nominal for p in model.parameters}, jnp.array([0.3, 1.0]))["world"]
    np.testing.assert_allclose(params.qpos, [0.3, -0.5], atol=1e-4)
    np.testing.assert_allclose(params.qvel, [1.0, -2.0], atol=1e-3)
    world = robot.make_nodes()[2]
    told, applied, rows = world.law(
        np, world.law_values(params), np.zeros(5), np.array(params.qpos), np.array(params.qvel)
    )
    assert (told.shape, applied.shape, rows["dof_damping"].shape) == ((3,), (2,), (2,))


COUPLER = '<body name="c" pos="0 0 .1">{}<geom fromto="0 0 0 .2 0 0" mass=".2"/><site name="e" pos=".2 0 0"/></body>'
LOOP = """<mujoco><default><geom type="capsule" size=".01"/><joint axis="0 1 0"/></default><worldbody>
<body name="crank"><joint name="crank"/><geom fromto="0 0 0 0 0 .1" mass=".1"/>{inner}</body>{outer}
<body name="rocker" pos=".2 0 0"><joint name="rocker"/><geom fromto="0 0 0 0 0 .1" mass=".1"/>
<site name="f" pos="0 0 .1"/></body></worldbody>{rest}</mujoco>"""
PIN = '<connect site1="e" site2="f"/>'
PINNED = '<connect body1="crank" body2="c" anchor="0 0 .1"/>'
FREED = COUPLER.format("<freejoint/>")
SUM = '<joint joint="crank" coef="1"/><joint joint="rocker" coef="-2"/>'


@pytest.mark.parametrize(
    ("inner", "outer", "rest", "rocker"),
    [
        pytest.param(
            COUPLER.format('<joint name="p" type="ball"/>'), "", f"<equality>{PIN}</equality>", 1.0,
            marks=pytest.mark.night,
        ),
        pytest.param("", FREED, f"<equality>{PIN}{PINNED}</equality>", 1.0, marks=pytest.mark.night),
        pytest.param(
            "", "", f'<tendon><fixed name="t">{SUM}</fixed></tendon><equality><tendon tendon1="t"/></equality>', 0.5,
            marks=pytest.mark.night,
        ),
        ("", "", '<equality><joint joint1="rocker" joint2="crank" polycoef="0 0 1 0 0"/></equality>', 0.4),
    ],
)  # fmt: skip
def test_every_kind_of_loop_is_closed(tmp_path, inner, outer, rest, rocker):
    """At 0.4 rad of the crank: errors of the equalities in C MuJoCo are below 0.1 mm, and the crank stands there."""
    path = tmp_path / "loop.xml"
    path.write_text(LOOP.format(inner=inner, outer=outer, rest=rest))
    model = driven(path, ("crank",), 0.002, False, False)
    at = np.array([model.joint("crank").qposadr[0]])
    qpos, qvel = Closing(model, at, np.array([model.joint("crank").dofadr[0]]))(jnp.array([0.4]), jnp.array([1.0]))
    assert qpos[at[0]] == pytest.approx(0.4)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-4
    ratio = qvel[model.joint("rocker").dofadr[0]]
    assert ratio == pytest.approx({1.0: 1.0, 0.5: 0.5, 0.4: 0.8}[rocker], abs=1e-3)
