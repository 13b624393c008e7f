"""The identified MJCF: MuJoCo reads back what was found, and nothing else has changed."""

import mujoco
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.identify.inertia import from_log_cholesky, inertia_parameters
from sim2real.identify.mjcf import identified_mjcf
from sim2real.identify.parameters import Parameter, ParameterTable

XML = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="arm">
      <joint name="shoulder" axis="0 1 0" damping="0.1" armature="0.01" frictionloss="0.2"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="1"/>
      <body name="hand" pos="0 0 0.3">
        <joint name="elbow" axis="0 1 0" damping="0.3"/>
        <geom type="box" size="0.02 0.03 0.04" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator><position joint="shoulder" kp="3"/></actuator>
</mujoco>
"""
FOUND = {"damping": 0.5, "friction": 0.33, "armature": 0.02, "mass": 2.0, "kp": 7.0, "gain": 3.0}


@pytest.fixture
def spec():
    return mujoco.MjSpec.from_string(XML)


@pytest.fixture
def table():
    leaves = {
        "damping": "dof_damping[0]",
        "friction": "dof_frictionloss[0]",
        "armature": "dof_armature[0]",
        "mass": "body_mass[1]",
        "kp": "actuator_gainprm[0][0]",
    }
    own = [Parameter(n, "1", FOUND[n], 0.001, 100.0, leaf=f"world.model.{leaf}") for n, leaf in leaves.items()]
    return ParameterTable([*own, Parameter("gain", "1", 1.0, 0.1, 10.0, leaf="sensor.gain")])


def test_mujoco_reads_back_what_was_found(spec, table):
    before, after = spec.compile(), mujoco.MjModel.from_xml_string(identified_mjcf(spec, table, FOUND))
    np.testing.assert_allclose(after.dof_damping, [0.5, 0.3])
    np.testing.assert_allclose(after.dof_frictionloss, [0.33, 0.0])
    np.testing.assert_allclose(after.dof_armature, [0.02, 0.0])
    np.testing.assert_allclose(after.body_mass, [0.0, 2.0, 0.2])
    assert after.actuator_gainprm[0, 0] == pytest.approx(7.0)
    for field in ("jnt_axis", "body_pos", "geom_size", "body_inertia"):
        np.testing.assert_allclose(getattr(after, field), getattr(before, field), rtol=1e-5)  # six digits
    assert after.opt.timestep == before.opt.timestep
    assert spec.compile().dof_damping[0] == 0.1  # the nominal model is as it was


def one(leaf):
    return ParameterTable([Parameter("d", "1", 1.0, 0.1, 2.0, leaf=leaf)])


def test_leaves_that_are_no_fields_are_errors(spec):
    with pytest.raises(UsageError, match="no array 'dof_dampnig'"):
        identified_mjcf(
            spec, ParameterTable([Parameter("d", "1", 1.0, 0.1, 2.0, leaf="world.model.dof_dampnig[0]")]), {}
        )
    with pytest.raises(UsageError, match="the MJCF would stay as it is"):
        identified_mjcf(spec, one("sensor.gain"), {"d": 1.0})


def test_inertia_parameters_stand_around_the_nominal_body():
    mass, com, inertia = 1.3, np.array([0.01, -0.02, 0.1]), np.diag([0.012, 0.010, 0.004])
    rows = inertia_parameters("hand", mass, com, inertia, 0.7)
    assert [p.name for p in rows[:2]] == ["hand_alpha", "hand_d1"]
    m, c, I = from_log_cholesky(np.array([p.nominal for p in rows]))  # noqa: E741
    np.testing.assert_allclose(float(m), mass, rtol=1e-5)
    np.testing.assert_allclose(c, com, atol=1e-6)
    np.testing.assert_allclose(I, inertia, atol=1e-6)
    assert all(p.high - p.low == pytest.approx(1.4) for p in rows)
