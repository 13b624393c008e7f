"""A chain of bodies in MJX: its cost on a CPU grows with its length, and its poses are MuJoCo's."""

import jax
import mujoco
import numpy as np
import pytest

from sim2real.composer.physics.mjx.import_mjx import held_links, mjx


def _chain(links: int) -> mujoco.MjModel:
    body = '<body pos="0.1 0 0"><joint axis="0 1 0"/><geom size="0.02" pos="0.05 0 0"/>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body * links}{'</body>' * links}</worldbody></mujoco>")


@pytest.fixture
def programs():
    """Return a function of a chain's length: its model and data, and the program of its kinematics for 8 copies."""

    def make(links: int):
        model = _chain(links)
        device, data = mjx.put_model(model), mjx.make_data(model)
        angles = np.linspace(-1.0, 1.0, 8 * links, dtype=np.float32).reshape(8, links)
        run = jax.jit(jax.vmap(lambda q: mjx.kinematics(device, data.replace(qpos=q)).xpos))
        with held_links():
            return model, angles, run.lower(angles).compile()

    return make


@pytest.mark.night
def test_cost_grows_with_the_length_of_a_chain(programs):
    if jax.default_backend() != "cpu":
        pytest.skip("elsewhere XLA itself weighs what it computes again")
    costs = [programs(links)[2].cost_analysis()["flops"] for links in (3, 6)]
    assert costs[1] < 3 * costs[0]  # 5 times where links are computed again for those beyond


def test_poses_are_those_of_mujoco(programs):
    model, angles, program = programs(6)
    data = mujoco.MjData(model)
    for row, xpos in zip(angles, program(angles), strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(xpos, data.xpos, atol=1e-5)
