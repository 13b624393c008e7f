"""Rollouts of many copies on C MuJoCo: each is what a loop over one ``MjData`` makes of it."""

import mujoco
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.worlds import rollouts
from sim2real.worlds.rollouts import Rollouts, Start

XML = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="upper"><joint name="a" axis="0 1 0" damping="0.1" frictionloss="0.05" armature="0.01"/>
      <inertial pos="0 0 {com}" mass="{mass}" diaginertia="0.01 0.02 0.03"/>
      <body name="lower" pos="0 0 -0.3"><joint name="b" axis="1 0 0" damping="{damping}"/>
        <inertial pos="0 0 -0.1" mass="0.4" diaginertia="0.001 0.002 0.003"/></body></body>
  </worldbody>
  <actuator><motor joint="a"/><position joint="b" kp="5"/></actuator>
</mujoco>
"""
SLED = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody><body name="sled"><joint type="slide" axis="1 0 0"/><geom size="0.1"/></body></worldbody></mujoco>
""")
TICKS, SUBSTEPS = 30, 3


def model(com=-0.1, mass=1.0, damping=0.1):
    return mujoco.MjModel.from_xml_string(XML.format(com=com, mass=mass, damping=damping))


def start(count, qpos=0.3):
    return Start(np.full((count, 2), qpos), np.ones((count, 2)), np.zeros((count, 2)))


def loop(own, controls):
    """Play controls ``(ticks, substeps, nu)`` on one model; return what ``Rollouts`` does."""
    data = mujoco.MjData(own)
    data.qpos[:], data.qvel[:] = 0.3, 1.0
    own.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    mujoco.mj_forward(own, data)
    own.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    rows = [(data.qpos.copy(), data.qvel.copy(), data.qacc.copy())]
    data.qacc_warmstart[:] = 0.0
    for tick in controls:
        for control in tick:
            data.ctrl[:] = control
            mujoco.mj_step(own, data)
        rows.append((data.qpos.copy(), data.qvel.copy(), data.qacc.copy()))
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize("most", [1, 2**26], ids=["in parts", "at once"])
def test_each_copy_is_what_a_loop_makes_of_it(monkeypatch, most):
    monkeypatch.setattr(rollouts, "_LARGEST_BYTES", most)
    rng = np.random.default_rng(0)
    masses, dampings = rng.uniform(0.5, 2.0, 13), rng.uniform(0.1, 0.5, (13, 2))
    controls = rng.uniform(-1, 1, (13, TICKS, SUBSTEPS, 2))
    engine = Rollouts(model(), SUBSTEPS, ("body_mass", "body_ipos", "dof_damping"), derives=True)
    compiled = engine._model
    fields = {
        "body_mass": np.stack([[0.0, m, 0.4] for m in masses]),
        "body_ipos": np.stack([[[0, 0, 0], [0, 0, -0.2 * m], [0, 0, -0.1]] for m in masses]),
        "dof_damping": dampings,
    }
    found = engine(fields, start(1), controls)
    for i in range(13):
        own = model(com=-0.2 * masses[i], mass=masses[i])
        own.dof_damping[:] = dampings[i]
        own.opt.disableflags = compiled.opt.disableflags
        for have, want in zip(found, loop(own, controls[i]), strict=True):
            np.testing.assert_allclose(have[i], want, rtol=0, atol=1e-9)


def test_axes_that_copies_share_are_given_once():
    controls = np.random.default_rng(1).uniform(-1, 1, (4, TICKS, SUBSTEPS, 2))
    damping = np.linspace(0.1, 0.5, 3)[:, None, None] * np.ones((1, 1, 2))
    qpos, qvel, qacc = Rollouts(model(), SUBSTEPS, ("dof_damping",))({"dof_damping": damping}, start(1), controls[None])
    assert [a.shape for a in (qpos, qvel, qacc)] == [(3, 4, 1 + TICKS, 2)] * 3
    alone = Rollouts(model(), SUBSTEPS, ("dof_damping",))({"dof_damping": damping[1, 0]}, start(1)[:], controls[2])[0]
    np.testing.assert_array_equal(qpos[1, 2], alone[0])


def test_what_diverges_is_no_number_and_says_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    damping = np.array([[0.1, 0.1], [-1e9, 0.1]])
    controls = np.zeros((1, TICKS, SUBSTEPS, 2))
    qpos, *_ = Rollouts(model(), SUBSTEPS, ("dof_damping",))({"dof_damping": damping}, start(1), controls)
    assert np.isfinite(qpos[0]).all()
    assert np.isnan(qpos[1]).all()
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("own", "names", "match"),
    [
        (model(), ("no_such",), "no field 'no_such'"),
        (SLED, ("body_ipos",), "inertia of body 'sled' as compiled"),
    ],
)
def test_what_c_would_not_look_at_is_refused(own, names, match):
    with pytest.raises(UsageError, match=match):
        Rollouts(own, SUBSTEPS, names)


@pytest.mark.parametrize(
    ("joint", "field"), [("slide", "dof_armature"), ("hinge", "dof_armature"), ("slide", "body_mass")]
)
def test_balanced_joints_follow_what_their_inertia_follows_from(joint, field):
    """C takes the inertia of a wheel or of a carriage on a rail as compiled, unless it is renewed."""
    balanced = mujoco.MjModel.from_xml_string(f"""
    <mujoco><option integrator="implicitfast" gravity="0 0 0"/><worldbody><body name="b">
      <joint name="j" type="{joint}" axis="1 0 0" armature="0.05"/>
      <inertial pos="0 0 0" mass="0.05" diaginertia="0.05 0.05 0.05"/></body></worldbody>
      <actuator><motor joint="j"/></actuator></mujoco>""")
    values = np.array([0.05, 0.15, 0.35])
    rows = np.stack([np.zeros_like(values), values], axis=1) if field == "body_mass" else values[:, None]
    at_rest = Start(*(np.zeros((1, 1)) for _ in range(3)))
    *_, qacc = Rollouts(balanced, 1, (field,))({field: rows}, at_rest, np.ones((1, 1, 1, 1)))
    np.testing.assert_allclose(qacc[:, -1, 0], 1.0 / (values + 0.05), rtol=1e-6)
