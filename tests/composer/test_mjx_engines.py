"""What hooks write, on MJX as on C: options, masses, controls, places, and what is computed anew because of it."""

import copy
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.mjx_environment import is_unstable
from sim2real.composer.physics.mjx import constants, stepping
from sim2real.composer.physics.mjx.import_mjx import held_links

ENGINE = stepping.JaxEngine()

CHAIN = """
<mujoco model="chain"><compiler angle="radian"/><default><geom contype="0" conaffinity="0"/></default>
  <worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
      <body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/><site name="tip" pos=".2 0 0"/></body></body>
  </worldbody>
  <actuator><motor name="shoulder" joint="shoulder" gear="2"/><motor name="elbow" joint="elbow"/></actuator>
  <sensor><accelerometer name="felt" site="tip"/></sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def double():
    with jax.enable_x64(True):
        yield


BODIES = """
<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3" pos=".05 0 0"/><site name="one" pos=".1 0 0"/>
    <body name="ball" pos=".3 0 0"><joint type="ball"/><geom type="capsule" fromto="0 0 0 .2 .1 0" size=".02"/>
      <body name="hand" pos=".2 .1 0"><joint name="hinge" axis="0 1 1" armature=".01"/>
        <geom type="ellipsoid" size=".05 .03 .02"/><site name="two"/></body></body></body>
  <body name="cart" pos="1 0 0"><joint name="slide" type="slide" axis="0 0 1"/><geom type="cylinder" size=".05 .1"/>
    <camera pos="0 0 .3"/><camera mode="targetbody" target="hand" pos="0 .1 .3"/></body>
  <body pos="2 0 0"><geom size=".1"/></body></worldbody>
  <tendon><spatial name="rope" range="0 2" limited="true"><site site="one"/><site site="two"/></spatial>
    <fixed frictionloss=".1"><joint joint="hinge" coef="2"/><joint joint="slide" coef="-1"/></fixed></tendon>
  <equality><connect body1="hand" body2="cart" anchor=".1 0 0"/><weld body1="hand" body2="cart" anchor=".1 .2 .3"/>
    <weld body1="hand" body2="ball" relpose="0 0 1 .7 .7 0 0"/></equality>
  <actuator><motor joint="hinge" gear="3"/><motor tendon="rope" gear="2"/></actuator>
</mujoco>
"""
UNUSED = {"dof_length", "geom_aabb", "actuator_length0"}  # by MJX


@pytest.mark.night
def test_derived_constants_are_those_of_mj_set_const(double):
    model = mujoco.MjModel.from_xml_string(BODIES)
    varied, random = copy.copy(model), np.random.RandomState(0)
    for name in ("body_mass", "body_inertia", "geom_size", "actuator_gear"):
        field = getattr(varied, name)
        field[1:] *= random.uniform(0.5, 2.0, field[1:].shape)
    varied.dof_armature[:] += 0.1
    varied.body_pos[1:] += random.uniform(-0.1, 0.1, varied.body_pos[1:].shape)
    varied.body_quat[1:] += random.uniform(-0.2, 0.2, varied.body_quat[1:].shape)
    varied.body_quat /= np.linalg.norm(varied.body_quat, axis=1, keepdims=True)
    given = mjx.put_model(varied)
    before = copy.copy(varied)
    mujoco.mj_setConst(varied, mujoco.MjData(varied))
    found = jax.jit(lambda m: constants.derive(model, m))(given)
    changed = {f for f in vars(type(varied)) if not np.array_equal(getattr(before, f), getattr(varied, f))}
    floats = {f for f in changed if np.asarray(getattr(varied, f)).dtype == float}
    assert "body_invweight0" in floats
    assert floats - UNUSED <= set(found)
    for name, value in found.items():
        expected = getattr(varied, name)
        np.testing.assert_allclose(np.reshape(value, expected.shape), expected, rtol=1e-12, atol=1e-12, err_msg=name)
    # Which are derived is known before, with or without actuators, cameras and tendons.
    body = '<mujoco><worldbody>{}<body><joint name="one"/><geom size=".1"/></body></worldbody>{}</mujoco>'
    tendon = '<tendon><fixed><joint joint="one" coef="1"/></fixed></tendon>'
    for text in (
        BODIES, body.format("<camera/>", tendon), body.format("", '<actuator><motor joint="one"/></actuator>')
    ):  # fmt: skip
        model = mujoco.MjModel.from_xml_string(text)
        given = mjx.put_model(model)
        derived = jax.eval_shape(lambda m, model=model: constants.derive(model, m), given)
        assert constants.derived(model, given) == set(derived)


@pytest.mark.night
def test_mjx_is_traced_once_for_all_programs_that_a_model_is_in(monkeypatch):
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint type="slide"/><joint type="slide" axis="1 0 0"/><geom size=".1"/>
        <body><joint/><geom size=".07" pos="0 0 .3"/></body></body></worldbody></mujoco>"""
    )
    traced, known = [], mjx.fwd_position
    monkeypatch.setattr(stepping.mjx, "fwd_position", lambda m, d: traced.append(m) or known(m, d))
    given, data = mjx.put_model(model), mjx.make_data(model, impl="jax")

    def speeds(qvel, mass):
        heavier = stepping.with_fields(given, {"body_mass": given.body_mass * mass})
        return ENGINE.advance(heavier, ENGINE.advance(heavier, data.replace(qvel=qvel), True), True).qvel

    still = jnp.zeros((4, model.nv))
    jax.eval_shape(speeds, still[0], 2.0)
    jax.eval_shape(jax.vmap(speeds, (0, None)), still, 2.0)
    jax.eval_shape(lambda v: jax.jvp(lambda v: speeds(v, 2.0), (v,), (v,)), still[0])
    assert len(traced) == 1


@pytest.mark.parametrize("integrator", ["Euler", pytest.param("RK4", marks=pytest.mark.night)])
def test_a_step_is_that_of_mj_step_with_all_sensors(double, integrator):
    """``mjx.step`` leaves accelerometers at 0 where nothing is constrained, and RK4's sensors in its last stage."""
    model = mujoco.MjModel.from_xml_string(CHAIN)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    data = mujoco.MjData(model)
    data.qvel[:] = 1.0
    start = mjx.put_data(model, data)
    found = jax.jit(lambda m, d: ENGINE.advance(m, d, False))(mjx.put_model(model), start)
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(found.sensordata, data.sensordata, rtol=1e-9)
    np.testing.assert_allclose(found.qvel, data.qvel, rtol=1e-12)


def test_the_state_at_the_start_of_an_episode_is_that_of_c(double):
    """MJX normalizes quaternions that a hook left, and has velocities and forces of actuators that are switched off."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="j" type="ball"/><geom size=".1"/></body></worldbody>
        <actuator><velocity name="v" joint="j"/></actuator><sensor><actuatorvel actuator="v"/></sensor></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[0], data.ctrl[:] = [1.02, 0.02, 0.02, 0.02], 0.5, 1.0
    mujoco.mj_forward(model, data)  # as a hook that reads something has it computed
    given = mjx.put_model(model), mjx.put_data(model, data)
    found = jax.jit(lambda m, d: ENGINE.forward(m, d, False))(*given)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    mujoco.mj_forward(model, data)
    assert found.sensordata[0] == data.sensordata[0]
    assert found.actuator_force[0] == data.actuator_force[0] == 0.0
    np.testing.assert_array_equal(found.qpos, data.qpos)


def test_an_episode_ends_where_mujoco_warns():
    def unstable(value):
        return bool(
            is_unstable(SimpleNamespace(**dict.fromkeys(("qpos", "qvel"), np.zeros(2)), qacc=np.array([value])))
        )

    assert [unstable(v) for v in (1e9, -1e11, np.inf, np.nan)] == [False, True, True, True]


@pytest.mark.night
def test_an_episode_ends_though_a_hook_hides_that_it_diverged():
    class Thrown(composer.NullTask):
        def after_step(self, physics, random_state):
            physics.set_control(physics.np.zeros(1))
            physics.set_state(physics.np.zeros(2))
            physics.mark_as_dirty()
            physics.forward()

    rod = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
        <actuator><motor joint="j"/></actuator></mujoco>"""
    task = Thrown(composer.ModelWrapperEntity(mjcf.from_xml_string(rod)))
    task.set_timesteps(0.002, 0.002)
    env = composer.MjxEnvironment(task)
    play = jax.jit(lambda key, action: env.step(env.reset(key), action))
    assert play(jax.random.key(0), np.array([1e12])).done


@pytest.mark.night
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="elsewhere XLA itself weighs what it computes again")
def test_cost_grows_with_the_length_of_a_chain():
    def flops(links):
        body = '<body pos="0.1 0 0"><joint axis="0 1 0"/><geom size="0.02" pos="0.05 0 0"/>'
        text = f"<mujoco><worldbody>{body * links}{'</body>' * links}</worldbody></mujoco>"
        model = mujoco.MjModel.from_xml_string(text)
        device, data = mjx.put_model(model), mjx.make_data(model)
        run = jax.jit(jax.vmap(lambda q: mjx.kinematics(device, data.replace(qpos=q)).xpos))
        with held_links():
            return run.lower(jnp.zeros((8, links))).compile().cost_analysis()["flops"]

    assert flops(6) < 3 * flops(3)  # 5 times where links are computed again for those beyond
