"""A payload in the hand of a servo robot: a point mass at the tip, in a model that is only tested with it."""

import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.hardware.plant import load_plant
from sim2real.stages.pipeline import load_pipeline


@pytest.fixture(scope="module")
def arm():
    return load_pipeline("arm").load()


def test_a_payload_is_not_identified_but_watched(arm):
    identified, watched = arm.identifiable(0.06).parameters, arm.watched(0.06).parameters
    assert set(watched.names) - set(identified.names) == {"payload"}
    payload = watched["payload"]
    assert (payload.nominal, payload.unit) == (0.0, "kg")
    assert -0.055 < payload.low < 0.0 < payload.high


@pytest.mark.parametrize("name", ["arm", "so101"])
def test_it_is_the_point_mass_that_the_plant_carries(name):
    """The plant is a model of its own: with the same mass at its tip, the whole hand weighs and balances alike."""
    robot, carried_kg = load_pipeline(name).load(), 0.1
    model, start = robot.watched(0.06), jnp.zeros(2 * len(robot.servos.joints))
    values = {p.name: jnp.float32(p.nominal) for p in model.parameters} | {"payload": jnp.float32(carried_kg)}
    world = model.nodes(0.06)[robot.roles.world]
    found = world._model(model.params(values, start)[robot.roles.world])
    plant = load_plant(robot.embedded.plant, {"carried_kg": carried_kg}).model
    carried = plant.body("carried").id
    hand = int(plant.body_parentid[carried])
    total = plant.body_mass[hand] + carried_kg
    centre = plant.body_mass[hand] * plant.body_ipos[hand] + carried_kg * plant.body_pos[carried]
    assert plant.body_mass[carried] == pytest.approx(carried_kg)
    np.testing.assert_allclose(found.body_mass[hand], total, rtol=1e-5)
    np.testing.assert_allclose(found.body_ipos[hand], centre / total, atol=1e-6)


def test_without_a_payload_the_model_is_the_robots_own(arm):
    model, plain = arm.watched(0.06), arm.identifiable(0.06)
    values, start = {p.name: jnp.float32(p.nominal) for p in model.parameters}, jnp.zeros(6)
    worlds = [m.nodes(0.06)["world"] for m in (model, plain)]
    loaded, own = (w._model(m.params(values, start)["world"]) for w, m in zip(worlds, (model, plain), strict=True))
    np.testing.assert_allclose(loaded.body_mass, own.body_mass, rtol=1e-6)
    np.testing.assert_allclose(loaded.body_ipos, own.body_ipos, atol=1e-7)
