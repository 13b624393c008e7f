import weakref

import dm_env
import numpy as np
import pytest
from dm_env import specs

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation import observable
from sim2real.errors import UsageError

PENDULUM = """
<mujoco model="pendulum"><option timestep="0.01"/>
  <worldbody><body>
    <joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/>
  </body></worldbody>
  <actuator><motor name="torque" joint="hinge" ctrlrange="-1 2" ctrllimited="true"/><motor joint="hinge"/></actuator>
</mujoco>
"""


class Swing(composer.Task):
    def __init__(self, failures=0, control=0.02):
        self._root_entity = composer.ModelWrapperEntity(mjcf.from_xml_string(PENDULUM))
        self.hinge = self._root_entity.mjcf_model.find("joint", "hinge")
        self.control_timestep = control
        self.failures, self.attempts, self.starts = failures, 0, []

    @property
    def root_entity(self):
        return self._root_entity

    @property
    def task_observables(self):
        angle = observable.MJCFFeature("qpos", self.hinge)
        angle.enabled = True
        return {"angle": angle}

    def initialize_episode(self, physics, random_state):
        self.attempts += 1
        if self.attempts <= self.failures:
            raise composer.EpisodeInitializationError("not this time")
        self.starts.append(random_state.uniform(-1, 1))
        physics.bind(self.hinge).qpos = self.starts[-1]

    def get_reward(self, physics):
        return float(np.cos(physics.bind(self.hinge).qpos[0]))


@pytest.mark.parametrize("legacy", [True, False])
def test_time_steps_follow_dm_env(legacy):
    """A step without an episode starts one and ignores the action; legacy steps keep positions beside the state."""
    env = composer.Environment(Swing(), time_limit=0.04, random_state=0, legacy_step=legacy)
    first = env.step(None)
    assert (first.step_type, first.reward, first.discount) == (dm_env.StepType.FIRST, None, None)
    step = env.step(np.array([1.0, 0.0]))
    assert (step.step_type, step.discount, env.control_timestep()) == (dm_env.StepType.MID, 1.0, 0.02)
    assert step.reward == pytest.approx(np.cos(env.physics.data.qpos[0]))
    assert env.physics.time() == pytest.approx(0.02)
    np.testing.assert_array_equal(step.observation["angle"], [env.physics.data.qpos])
    body = env.physics.data.xquat[1].copy()
    env.physics.forward()
    assert np.allclose(body, env.physics.data.xquat[1], atol=0) == legacy
    assert [env.step(np.zeros(2)).step_type for _ in range(2)] == [dm_env.StepType.LAST, dm_env.StepType.FIRST]


@pytest.mark.parametrize(
    ("limit", "control", "physics", "steps"),
    [(5.0, 0.05, 0.005, 100), (1.0, 0.02, 0.002, 50), (0.05, 0.02, 0.01, 3)],
)
def test_the_time_limit_counts_steps(limit, control, physics, steps):
    task = Swing()
    task.set_timesteps(control, physics)
    env = composer.Environment(task, time_limit=limit)
    env.reset()
    count, step = 0, None
    while step is None or not step.last():
        step, count = env.step(np.zeros(2)), count + 1
    assert count == steps
    assert step.discount == 1.0


def test_a_failed_reset_is_repeated_and_other_errors_are_not():
    env = composer.Environment(Swing(failures=1))
    with pytest.raises(composer.EpisodeInitializationError):
        env.step(np.zeros(2))  # which does not run the physics unprepared
    assert env.step(np.zeros(2)).first()
    task = Swing(failures=2)
    assert composer.Environment(task, max_reset_attempts=3).reset().first()
    assert task.attempts == 3
    task.initialize_episode = lambda physics, random_state: 1 / 0
    with pytest.raises(ZeroDivisionError):
        composer.Environment(task, max_reset_attempts=5).reset()


def test_the_physics_is_a_weak_reference_that_dies_with_its_model():
    env = composer.Environment(Swing())
    before = env.physics
    assert isinstance(before, weakref.ProxyType)
    env.reset()
    with pytest.raises(ReferenceError):
        before.time()
    env.close()
    with pytest.raises(ReferenceError):
        env.physics.time()


def test_a_changed_model_is_compiled_and_a_changed_physics_is_forgotten():
    task = Swing()
    env = composer.Environment(task)
    geom = task.root_entity.mjcf_model.find_all("geom")[0]
    env.physics.bind(geom).rgba = [0, 0, 1, 1]
    env.reset()
    np.testing.assert_array_equal(env.physics.bind(geom).rgba, np.float32([0.5, 0.5, 0.5, 1]))
    task.initialize_episode_mjcf = lambda random_state: geom.set_attributes(rgba=[1, 0, 0, 1])
    env.reset()
    np.testing.assert_array_equal(env.physics.bind(geom).rgba, [1, 0, 0, 1])
    geom.rgba[:] = [0, 1, 0, 1]  # in the array that it holds
    task.initialize_episode_mjcf = lambda random_state: None
    env.reset()
    np.testing.assert_array_equal(env.physics.bind(geom).rgba, [0, 1, 0, 1])


KEPT = {
    "accessor": lambda physics: physics.data.ptr.joint(0).qpos,
    "contacts": lambda physics: physics.data.contact.pos,
    "constraints": lambda physics: physics.data.efc_force,
    "field": lambda physics: physics.data.sensordata,
    "state": lambda physics: physics.data.qpos,
    "mass": lambda physics: physics.model.body_mass[1:],
}


@pytest.mark.parametrize("keep", KEPT.values(), ids=KEPT)
def test_a_kept_array_keeps_its_numbers(keep):
    env = composer.Environment(Swing(), random_state=0)
    env.reset()
    env.step([1.0, 0.0])
    kept = keep(env.physics)
    before = np.array(kept)
    env.reset()
    for _ in range(20):
        env.step([-1.0, 0.3])
    env.physics.model.body_mass[1:] = 7.0
    np.testing.assert_array_equal(kept, before)


def test_an_episode_in_a_used_state_is_that_of_a_new_one():
    used, fresh = (composer.Environment(Swing(), fixed_initial_state=True, random_state=0) for _ in range(2))
    used.reset()
    for _ in range(20):
        used.step([1.0, -0.3])
    for env in (used, fresh):
        env.reset()
    for _ in range(20):
        for env in (used, fresh):
            env.step([0.7, 0.1])
        for name in ("time", "qpos", "qvel", "qacc", "xpos", "qfrc_constraint", "sensordata", "ctrl", "qacc_warmstart"):
            np.testing.assert_array_equal(getattr(used.physics.data, name), getattr(fresh.physics.data, name))
    used.physics.model.opt.gravity[:] = 0
    used.reset()
    assert used.physics.model.opt.gravity[2] == -9.81


def test_divergence_raises_or_ends_the_episode():
    env = composer.Environment(Swing())
    env.reset()
    with pytest.raises(composer.PhysicsError, match="mjWARN_BADCTRL"):
        env.step([np.nan, 0.0])
    env = composer.Environment(Swing(), raise_exception_on_physics_error=False)
    env.reset()
    step = env.step([np.nan, 0.0])
    assert (step.last(), step.reward, step.discount) == (True, 0.0, 0.0)
    assert env.step([0.0, 0.0]).first()


def test_specs():
    env = composer.Environment(Swing(), strip_singleton_obs_buffer_dim=True)
    action = env.action_spec()
    assert (action.shape, action.dtype) == ((2,), float)
    assert action.name == "torque\t//unnamed_actuator_1"
    np.testing.assert_array_equal(action.minimum, [-1, -1e10])
    np.testing.assert_array_equal(action.maximum, [2, 1e10])
    assert env.observation_spec() == {"angle": specs.Array((1,), float, "angle")}
    assert env.reward_spec() == specs.Array((), float, "reward")
    assert env.discount_spec() == specs.BoundedArray((), float, 0.0, 1.0, "discount")
    env.task.get_reward_spec = lambda: specs.Array((2,), float)
    assert env.reward_spec().shape == (2,)
    assert env.reset().observation["angle"].shape == (1,)


@pytest.mark.parametrize("padding", composer.ObservationPadding)
def test_what_is_late_is_padded(padding):
    late = observable.Generic(lambda physics: 7.0, delay=4, buffer_size=2)
    late.enabled = True
    task = type("Late", (Swing,), {"task_observables": {"late": late}})()
    env = composer.Environment(task, delayed_observation_padding=padding)
    first = 7.0 * (padding is composer.ObservationPadding.INITIAL_VALUE)
    seen = [env.reset(), *(env.step([0.0, 0.0]) for _ in range(4))]
    assert seen[0].observation["late"].ravel().tolist() == [first] * 2
    assert seen[-1].observation["late"].ravel().tolist() == [7.0] * 2


def test_wrong_arguments_are_named():
    with pytest.raises(UsageError, match="ObservationPadding"):
        composer.Environment(Swing(), delayed_observation_padding="zero")
    with pytest.warns(DeprecationWarning, match="n_sub_steps"):
        env = composer.Environment(Swing(), n_sub_steps=5)
    assert env.control_timestep() == pytest.approx(0.05)
    with pytest.raises(UsageError, match="Available: initialize_episode_mjcf"):
        env.add_extra_hook("before_lunch", print)
    with pytest.raises(UsageError, match="not a callable"):
        env.add_extra_hook("before_step", 3)


def test_timesteps_must_divide():
    task = Swing()
    with pytest.raises(UsageError, match="integer multiple"):
        task.control_timestep = 0.015
    with pytest.raises(UsageError, match="integer multiple"):
        task.physics_timestep = 0.03
    with pytest.raises(UsageError, match="shorter than"):
        task.set_timesteps(1e-9, 0.01)
    task.set_timesteps(0.03, 0.003)
    assert (task.control_timestep, task.physics_timestep, task.physics_steps_per_control_step) == (0.03, 0.003, 10)
    rootless = type("Rootless", (composer.Task,), {"get_reward": lambda self, physics: 0.0})()
    with pytest.raises(NotImplementedError, match="root_entity") as error:
        _ = rootless.control_timestep
    assert "before `root_entity` is available" in str(error.value.__cause__)


def test_a_corruptor_changes_nothing_but_its_own_observable(oracle, ours):
    """Controls that are bound make the next read of a place compute accelerations anew; it must not come earlier."""

    def felt(kit, corruptor):
        model = kit.mjcf.from_xml_string(
            '<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".1" pos=".2 0 0"/>'
            '<site name="tip" pos=".3 0 0"/></body></worldbody>'
            '<actuator><motor name="m" joint="j" gear="5"/></actuator>'
            '<sensor><accelerometer site="tip"/></sensor></mujoco>'
        )

        found = {
            "felt": kit.observable.MJCFFeature("sensordata", model.sensor.all_children()),
            "tip": kit.observable.MJCFFeature("xpos", model.find("site", "tip"), corruptor=corruptor),
        }

        class Shake(kit.composer.NullTask):
            @property
            def task_observables(self):
                return found

            def before_step(self, physics, action, random_state):
                physics.bind(model.find("actuator", "m")).ctrl = action[0]

        task = Shake(kit.composer.ModelWrapperEntity(model))
        task.set_timesteps(0.02, 0.005)
        for value in found.values():
            value.enabled = True
        env = kit.composer.Environment(task)
        env.reset()
        return [env.step([a]).observation["felt"].tolist() for a in (1.0, -1.0)]

    expected = felt(oracle, None)
    assert felt(ours, None) == felt(ours, lambda value, random_state: value) == expected
