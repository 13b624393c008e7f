"""What hooks may call on MJX as on C: keyframes, states, random order, colours. Nothing is compiled."""

import colorsys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from sim2real.composer.mjx.physics import MjxPhysics
from sim2real.composer.mjx.random import JaxRandomState
from sim2real.composer.variation import colors, distributions
from sim2real.errors import UsageError

HINGE = """
<mujoco>
  <worldbody><body><joint/><geom size=".1"/></body></worldbody>
  <keyframe><key time="2" qpos=".5" qvel="-1"/></keyframe>
</mujoco>
"""


@pytest.fixture
def physics():
    model = mujoco.MjModel.from_xml_string(HINGE)
    found = MjxPhysics(model, mjx.put_model(model), mjx.make_data(model), {"kept": 1})
    found.dry = True  # steps and forward computations compute nothing
    return found


def test_a_keyframe_and_a_state_can_be_set(physics):
    physics.set_state(jnp.array([0.1, 0.2]))
    assert physics.get_state().tolist() == pytest.approx([0.1, 0.2])
    physics.reset(0)
    assert (physics.get_state().tolist(), float(physics.time()), physics.variables) == ([0.5, -1.0], 2.0, {})
    physics.reset()
    assert (physics.get_state().tolist(), float(physics.time())) == ([0.0, 0.0], 0.0)
    with pytest.raises(UsageError, match="must be between 0 and 0 inclusive, got: 1"):
        physics.reset(1)
    with pytest.raises(UsageError, match=r"has shape \(3,\)\. Expected \(2,\)"):
        physics.set_state(jnp.zeros(3))


def test_choices_with_probabilities_and_random_order():
    random_state = JaxRandomState(jax.random.key(0))
    drawn = random_state.choice([1.0, 2.0, 3.0], 100, p=[0.0, 1.0, 0.0])
    assert set(drawn.tolist()) == {2.0}
    items = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    random_state.shuffle(items)
    assert sorted(map(float, items)) == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    with pytest.raises(UsageError, match=r"cannot shuffle a ndarray(.|\n)*permutation"):
        random_state.shuffle(np.arange(3))


def test_colours_are_those_of_colorsys():
    random_state = JaxRandomState(jax.random.key(1))
    for hue in (0.0, 0.2, 0.5, 0.7, 0.95):
        varied = colors.HsvVariation(distributions.Uniform(hue, hue), 0.6, 0.8, 0.5)(random_state=random_state)
        assert isinstance(varied, jax.Array)
        np.testing.assert_allclose(varied, [*colorsys.hsv_to_rgb(hue, 0.6, 0.8), 0.5], atol=1e-5)
    gray = colors.GrayVariation(distributions.Uniform(0.4, 0.4))(random_state=random_state)
    np.testing.assert_allclose(gray, [0.4, 0.4, 0.4, 1.0], atol=1e-6)
