"""Inertia: the log-Cholesky vector is one with physics, and MuJoCo moves alike."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco import mjx

from sim2real.errors import UsageError
from sim2real.identify.inertia import THETA, from_log_cholesky, inertia_parameters, set_inertia, to_log_cholesky

ARM = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint type="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 0.1" mass="1.2" diaginertia="0.01 0.02 0.015"/>
      <body name="tool" pos="0.05 0 0.3">
        <joint type="ball" damping="0.05"/>
        <inertial pos="{pos}" mass="{mass}" {inertia}/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
TOOL = 2


def points(rng, count=12):
    """Return mass, centre and inertia of random point masses, straight from the definition."""
    m, r = rng.uniform(0.05, 0.5, count), rng.normal(size=(count, 3)) * 0.1 + rng.normal(size=3) * 0.1
    com = m @ r / m.sum()
    d = r - com
    inertia = sum(mi * (di @ di * np.eye(3) - np.outer(di, di)) for mi, di in zip(m, d, strict=True))
    return m.sum(), com, inertia


def moves(model, rng, count=8):
    """Return random states of the arm and C MuJoCo's accelerations there."""
    data, rows = mujoco.MjData(model), []
    for _ in range(count):
        data.qpos[:] = rng.normal(size=model.nq)
        data.qpos[1:5] /= np.linalg.norm(data.qpos[1:5])
        data.qvel[:] = rng.normal(size=model.nv) * 2
        mujoco.mj_forward(model, data)
        rows.append((data.qpos.copy(), data.qvel.copy(), data.qacc.copy()))
    return (np.stack(r) for r in zip(*rows, strict=True))


def arm(mass=0.5, com=(0.0, 0.0, 0.0), inertia=None):
    if inertia is None:
        text = 'diaginertia="0.003 0.003 0.003"'
    else:
        entries = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        text = f'fullinertia="{" ".join(f"{v:.17g}" for v in entries)}"'
    return mujoco.MjModel.from_xml_string(
        ARM.format(pos=" ".join(f"{v:.17g}" for v in com), mass=f"{mass:.17g}", inertia=text)
    )


@pytest.fixture(scope="module")
def accelerations():
    """Return slopes and accelerations of the arm for a vector of its tool and eight states, by MJX: one program."""
    model = mjx.put_model(arm())

    def one(theta, qpos, qvel):
        own = set_inertia(model, TOOL, theta)
        qacc = mjx.forward(own, mjx.make_data(own).replace(qpos=qpos, qvel=qvel)).qacc
        return qacc, qacc

    return jax.jit(jax.vmap(jax.jacfwd(one, has_aux=True), in_axes=(None, 0, 0)))


@settings(max_examples=40)
@given(st.integers(0, 2**31))
def test_there_and_back(seed):
    mass, com, inertia = points(np.random.default_rng(seed))
    theta = to_log_cholesky(mass, com, inertia)
    assert theta.shape == (len(THETA),)
    back = from_log_cholesky(jnp.asarray(theta, jnp.float32))
    assert float(back[0]) == pytest.approx(mass, rel=1e-5)
    np.testing.assert_allclose(back[1], com, atol=1e-5)
    size = np.trace(inertia) + mass * com @ com
    np.testing.assert_allclose(back[2], inertia, atol=1e-5 * size)


VECTORS = st.lists(st.floats(-1.5, 1.5), min_size=10, max_size=10)


@settings(max_examples=60)
@given(VECTORS)
def test_every_vector_is_a_physical_body(theta):
    mass, com, inertia = (np.asarray(v, np.float64) for v in from_log_cholesky(jnp.asarray(theta, jnp.float32)))
    assert mass > 0
    small, middle, large = np.linalg.eigvalsh(inertia)
    room = 1e-5 * (large + mass * com @ com)
    assert small > -room
    assert small + middle >= large - room
    np.testing.assert_allclose(inertia, inertia.T, atol=1e-6 * large)


@settings(max_examples=30)
@given(VECTORS)
def test_the_vector_of_a_vectors_body_is_that_vector(theta):
    mass, com, inertia = (np.asarray(v, np.float64) for v in from_log_cholesky(jnp.asarray(theta, jnp.float32)))
    again = from_log_cholesky(jnp.asarray(to_log_cholesky(float(mass), com, inertia), jnp.float32))
    assert float(again[0]) == pytest.approx(float(mass), rel=1e-4)
    np.testing.assert_allclose(again[1], com, atol=1e-4 * (1 + np.abs(com).max()))


@pytest.mark.parametrize(("mass", "moments"), [(1.0, (0.1, 0.1, 0.3)), (1.0, (0.1, 0.2, 0.3)), (-1.0, (0.1, 0.1, 0.1))])
def test_bodies_that_do_not_exist(mass, moments):
    with pytest.raises(UsageError, match=r"no body of .* kg has the principal moments 0\.1, "):
        to_log_cholesky(mass, np.zeros(3), np.diag(np.array(moments) * (1 + 1e-12 * np.arange(3))))


@pytest.mark.parametrize("seed", range(12))
def test_mjx_moves_as_mujoco_with_the_same_full_inertia(accelerations, seed):
    rng = np.random.default_rng(seed)
    mass, com, inertia = points(rng)
    qpos, qvel, expected = moves(arm(mass, com, inertia), rng)
    _, found = accelerations(jnp.asarray(to_log_cholesky(mass, com, inertia), jnp.float32), qpos, qvel)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())


def test_the_inertia_that_was_there_changes_nothing(accelerations):
    rng = np.random.default_rng(0)
    qpos, qvel, expected = moves(arm(), rng)
    theta = to_log_cholesky(0.5, np.zeros(3), 0.003 * np.eye(3))
    _, found = accelerations(jnp.asarray(theta, jnp.float32), qpos, qvel)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize("moments", [(1.0, 1.0, 1.0), (1.0, 1.0, 0.4)], ids=["ball", "cylinder"])
def test_equal_moments_can_be_differentiated(accelerations, moments):
    rng = np.random.default_rng(5)
    com = np.array([0.02, -0.03, 0.05])
    theta = to_log_cholesky(0.5, com, 0.003 * np.diag(moments))
    qpos, qvel, _ = moves(arm(), rng)
    slope = np.asarray(accelerations(jnp.asarray(theta, jnp.float32), qpos, qvel)[0])

    def by_mujoco(vector):
        with jax.enable_x64(True):
            mass, c, inertia = (np.asarray(v) for v in from_log_cholesky(jnp.asarray(vector, jnp.float64)))
        model = arm(float(mass), c, 0.5 * (inertia + inertia.T))
        data, rows = mujoco.MjData(model), []
        for q, v in zip(qpos, qvel, strict=True):
            data.qpos[:], data.qvel[:] = q, v
            mujoco.mj_forward(model, data)
            rows.append(data.qacc.copy())
        return np.stack(rows)

    for i in range(10):
        step = 1e-4 * np.eye(10)[i]
        expected = (by_mujoco(theta + step) - by_mujoco(theta - step)) / 2e-4
        np.testing.assert_allclose(slope[..., i], expected, atol=0.02 * np.abs(expected).max() + 0.02, err_msg=THETA[i])


def test_inertia_parameters_stand_around_the_nominal_body():
    mass, com, inertia = 1.3, np.array([0.01, -0.02, 0.1]), np.diag([0.012, 0.010, 0.004])
    rows = inertia_parameters("hand", mass, com, inertia, 0.7)
    assert [p.name for p in rows[:2]] == ["hand_alpha", "hand_d1"]
    m, c, I = from_log_cholesky(np.array([p.nominal for p in rows]))  # noqa: E741
    np.testing.assert_allclose(float(m), mass, rtol=1e-5)
    np.testing.assert_allclose(c, com, atol=1e-6)
    np.testing.assert_allclose(I, inertia, atol=1e-6)
    assert all(p.high - p.low == pytest.approx(1.4) for p in rows)
