"""A payload in the hand of a servo robot: a point mass at the tip, an optional term of its model."""

import jax
import jax.numpy as jnp
import mujoco as mj
import numpy as np
import pytest

from sim2real.emulation.plant import load_plant
from sim2real.robots.loop import WORLD
from sim2real.robots.messages import EpisodeStart
from sim2real.stages.pipeline.pipeline import load_pipeline
from sim2real.stages.shared.identification import with_wanted_terms


@pytest.fixture(scope="module")
def arm():
    return load_pipeline("arm").load()


def at_zero(robot, values):
    """Return the world's parameters of a robot at rest at 0."""
    still = np.zeros(len(robot.drive.servos.joints))
    return robot.model.params(values, EpisodeStart(still, still, np.zeros(len(robot.task.aim.entries))))


def free(table):
    """Names of what is identified."""
    return {p.name for p in table if p.free}


def test_a_payload_is_identified_where_it_is_asked_for_and_always_watched(arm):
    identified, watched = arm.identifiable(0.06).parameters, arm.watched(0.06).parameters
    assert free(watched) - free(identified) == {"payload"}
    assert free(with_wanted_terms(identified, "payload")) == free(watched)
    assert free(with_wanted_terms(identified, "none")) == free(identified)
    payload = watched["payload"]
    assert (payload.nominal, payload.unit) == (0.0, "kg")


def test_a_hand_weighs_something_whatever_it_holds(arm):
    for robot in (arm, load_pipeline("so101").load()):
        lightest = robot.model.place(
            robot.nominal() | {"payload": robot.model.hand.least_kg}, np.zeros(len(robot.task.aim.entries))
        )
        assert lightest["mass of the hand"][0] > 0.005


@pytest.mark.parametrize("name", ["arm", "so101"])
def test_it_is_the_point_mass_that_the_plant_carries(name):
    """The plant is a model of its own: with the same mass at its tip, the whole hand weighs and balances alike."""
    robot, carried_kg = load_pipeline(name).load(), 0.1
    model, start = robot.watched(0.06), jnp.zeros(2 * len(robot.drive.servos.joints))
    values = {p.name: jnp.float32(p.nominal) for p in model.parameters} | {"payload": jnp.float32(carried_kg)}
    world = model.nodes(0.06)[WORLD]
    found = world._model(model.params(values, start)[WORLD])
    plant = load_plant(robot.drive.embedded.plant, {"carried_kg": carried_kg}).model
    carried = plant.body("carried").id
    hand = int(plant.body_parentid[carried])
    total = plant.body_mass[hand] + carried_kg
    centre = plant.body_mass[hand] * plant.body_ipos[hand] + carried_kg * plant.body_pos[carried]
    assert plant.body_mass[carried] == pytest.approx(carried_kg)
    np.testing.assert_allclose(found.body_mass[hand], total, rtol=1e-5)
    np.testing.assert_allclose(found.body_ipos[hand], centre / total, atol=1e-6)


def test_without_a_payload_the_model_is_as_it_was_composed(arm):
    params = at_zero(arm, arm.nominal())
    model = arm.model.make_world()._model(params)
    own = mj.MjModel.from_xml_string(arm.model.task.root_entity.mjcf_model.root_model.to_xml_string())
    np.testing.assert_allclose(model.body_mass, own.body_mass, rtol=1e-6)
    np.testing.assert_allclose(model.body_ipos, own.body_ipos, atol=1e-7)


@pytest.mark.parametrize("name", ["arm", "so101"])
def test_the_exported_model_carries_it(name):
    robot = load_pipeline(name).load()
    values = robot.nominal() | {"payload": 0.1}
    model = robot.model.make_world()._model(at_zero(robot, values))
    laden, empty = (mj.MjModel.from_xml_string(robot.identified_mjcf(v)) for v in (values, values | {"payload": 0.0}))
    np.testing.assert_allclose(laden.body_mass, model.body_mass, rtol=1e-5)
    np.testing.assert_allclose(laden.body_ipos, model.body_ipos, atol=1e-6)
    np.testing.assert_allclose(laden.body_inertia, empty.body_inertia, rtol=1e-5)
    np.testing.assert_allclose(laden.body_mass.sum() - empty.body_mass.sum(), 0.1, rtol=1e-5)


def test_a_robot_that_is_first_asked_while_jax_traces_keeps_no_tracer():
    robot = type(load_pipeline("arm").load())()
    mass = jax.jit(lambda kg: robot.model.place(robot.nominal() | {"payload": kg}, jnp.zeros(3))["mass of the hand"])
    heavier = mass(0.1) - mass(0.0)
    again = robot.model.place(robot.nominal() | {"payload": 0.1}, np.zeros(3))["mass of the hand"]
    np.testing.assert_allclose([heavier[0], again[0] - mass(0.0)[0]], 0.1, rtol=1e-5)
