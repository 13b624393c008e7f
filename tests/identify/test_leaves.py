"""Leaves: what a path finds, what replacing one leaves alone, and what is said where it leads nowhere."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct
from mujoco import mjx

from sim2real.errors import UsageError
from sim2real.identification.parameter_paths import get_leaf, set_leaf

ARM = """
<mujoco>
  <worldbody>
    <body><joint type="hinge" axis="0 1 0" damping="0.1"/><geom size="0.1" mass="1"/>
      <body pos="0 0 0.3"><joint type="hinge" axis="0 1 0" damping="0.2"/><geom size="0.1" mass="1"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@struct.dataclass
class Joint:
    """One level of nesting."""

    friction: float
    table: jax.Array


@struct.dataclass
class World:
    """The level above."""

    joint: Joint
    gains: jax.Array


@pytest.fixture
def tree():
    """Mappings, dataclasses and arrays."""
    return {
        "world": World(Joint(0.5, jnp.arange(6.0).reshape(2, 3)), jnp.array([1.0, 2.0, 3.0])),
        "sensor": {"delay": 0.01},
    }


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("sensor.delay", 0.01),
        ("world.joint.friction", 0.5),
        ("world.gains[1]", 2.0),
        ("world.gains[-1]", 3.0),
        ("world.joint.table[1][2]", 5.0),
    ],
)
def test_what_a_path_finds_can_be_replaced_alone(tree, path, value):
    assert float(get_leaf(tree, path)) == value
    changed = set_leaf(tree, path, 7.5)
    assert float(get_leaf(changed, path)) == 7.5
    assert float(get_leaf(tree, path)) == value
    before, after = (np.concatenate([np.ravel(v) for v in jax.tree_util.tree_leaves(t)]) for t in (tree, changed))
    assert (before != after).sum() == 1


def test_a_leaf_of_an_mjx_model():
    model = mjx.put_model(mujoco.MjModel.from_xml_string(ARM))
    changed = set_leaf({"world": {"model": model}}, "world.model.dof_damping[0]", 0.7)["world"]["model"]
    np.testing.assert_allclose(changed.dof_damping, [0.7, 0.2], rtol=1e-6)
    np.testing.assert_allclose(model.dof_damping, [0.1, 0.2], rtol=1e-6)
    assert float(get_leaf({"m": changed}, "m.dof_damping[0]")) == pytest.approx(0.7)
    slower = set_leaf({"m": model}, "m.opt.timestep", jnp.float32(0.01))["m"]
    assert float(slower.opt.timestep) == pytest.approx(0.01)


@pytest.mark.parametrize("act", [get_leaf, lambda t, p: set_leaf(t, p, 1.0)], ids=["get", "set"])
@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("wrld.gains", "finds no 'wrld'. Available: world, sensor"),
        ("world.gain", "finds no 'gain'. Available: joint, gains"),
        ("world.joint.frction", "finds no 'frction'. Available: friction, table"),
        ("sensor.delay.x", "finds no 'x'. Available: nothing"),
        ("world.gains[3]", r"needs an index into shape \(3,\), got \[3\]"),
        ("world.gains[-4]", r"needs an index into shape \(3,\), got \[-4\]"),
        ("world.gains[0][0]", r"needs an index into shape \(3,\), got \[0, 0\]"),
        ("world.joint.table[0]", r"needs an index into shape \(2, 3\), got \[0\]"),
        ("world..gains", "is no path"),
        ("world.gains[x]", "is no path"),
        ("", "is no path"),
    ],
)
def test_paths_that_lead_nowhere(tree, act, path, message):
    with pytest.raises(UsageError, match=message):
        act(tree, path)


def test_a_path_ends_at_its_index(tree):
    with pytest.raises(UsageError, match="only the last name may have one"):
        set_leaf({"a": [tree]}, "a[0].sensor", 1.0)
