"""The physics is taken out of a world only where nothing that is set depends on it."""

import jax
import pytest
from small_robot import PairRobot, PairTask

from sim2real.errors import UsageError
from sim2real.identify.rollouts import choose_engine
from sim2real.robots.servo.parts import GOAL
from sim2real.robots.servo.simulated_world import ServoWorld
from sim2real.stages.pipeline.pipeline import load_pipeline
from sim2real.worlds.composed import ComposedWorld, Observations


class Steered(PairTask):
    def after_substep(self, physics, random_state):
        physics.variables[GOAL] = physics.variables[GOAL] - 0.01 * physics.velocity()


class Slowly(PairTask):
    """What is kept of the state reaches the controls only some steps later."""

    def initialize_episode(self, physics, random_state):
        physics.variables["fast"] = physics.variables["was_fast"] = physics.np.asarray(0.0)

    def before_substep(self, physics, action, random_state):
        physics.variables[GOAL] = physics.variables[GOAL] + 0.01 * physics.variables["was_fast"]

    def after_substep(self, physics, random_state):
        physics.variables["was_fast"] = physics.variables["fast"]
        physics.variables["fast"] = physics.np.sum(physics.velocity())


class Pushed(PairTask):
    def before_step(self, physics, action, random_state):
        super().before_step(physics, action, random_state)
        physics.bind(self.joints).qfrc_applied = physics.np.asarray(action)


class Elsewhere(PairTask):
    def initialize_episode(self, physics, random_state):
        physics.variables["height"] = physics.bind(self.robot.servos[0].horn).xpos[2]


class Watched(PairTask):
    """Looks at the state, for its reward alone."""

    def initialize_episode(self, physics, random_state):
        physics.variables["seen"] = physics.np.asarray(0.0)

    def after_step(self, physics, random_state):
        physics.variables["seen"] = physics.np.sum(physics.position())


@pytest.mark.parametrize(
    ("task", "match"),
    [
        (Steered, "its controls depend on the state"),
        (Slowly, "its controls depend on the state"),
        (Pushed, "hooks set .qfrc_applied in a step"),
        (Elsewhere, "height.* at the start"),
    ],
)
def test_hooks_that_need_the_state_are_refused(task, match):
    made = task()
    world = ServoWorld("world", made, PairRobot().model.fields(made))
    with pytest.raises(UsageError, match=match):
        world.open_loop()


def test_hooks_that_only_look_are_not():
    task = Watched()
    world = ServoWorld("world", task, PairRobot().model.fields(task), resumed=True)
    assert world.open_loop().nq == 2


class Tip(ComposedWorld):
    def output(self, state):
        return Observations({"height": state.data.xpos[1, 2]})


def test_a_message_that_says_more_is_refused():
    world = Tip("world", PairTask(), field="goal")
    with pytest.raises(UsageError, match="more than positions, velocities and accelerations"):
        world.open_loop()


@pytest.mark.parametrize("name", ["arm", "so101"])
def test_shipped_arms_whose_tasks_look_at_the_tip_run_on_c(name):
    model = load_pipeline(name).load().identifiable(0.06)
    assert choose_engine("auto", model.nodes(0.06), model.given).name == "c"


@pytest.fixture(scope="module")
def motor():
    """The nodes of a robot whose world is no MuJoCo's."""
    model = load_pipeline("disk").load().identifiable(0.06)
    return model.nodes(0.06), model.given


def test_a_world_that_is_not_of_mujoco_takes_the_compiled_engine(motor):
    taken = choose_engine("auto", *motor)
    assert taken.name == "compiled"
    assert "not one of MuJoCo's" in str(taken)
    with pytest.raises(UsageError, match="engine c: the world is not one of MuJoCo's"):
        choose_engine("c", *motor)


@pytest.mark.parametrize("backend", ["cpu", pytest.param("gpu", marks=pytest.mark.night)])
def test_auto_takes_c_where_it_can_beside_an_accelerator_too(pair, backend, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    model = pair.identifiable(0.03)
    for wanted, name in (("auto", "c"), ("compiled", "compiled")):
        assert choose_engine(wanted, model.nodes(0.03), model.given).name == name
