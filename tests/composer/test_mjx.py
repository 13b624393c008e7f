"""The same task on both engines: MJX against C in float64."""

from collections import OrderedDict

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import Generic, MJCFFeature
from sim2real.composer.variation import deterministic, distributions, noises

PENDULUM = """
<mujoco model="pendulum"><option timestep="0.01"/>
  <worldbody>
    <body name="rod"><joint name="hinge" axis="0 1 0" damping=".05"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 .3" size=".02"/>
      <site name="tip" pos="0 0 .3" euler="0 30 0"/></body>
  </worldbody>
  <actuator><motor name="torque" joint="hinge"/></actuator>
  <sensor><accelerometer site="tip"/><jointvel joint="hinge"/></sensor>
</mujoco>
"""
STEPS, SUBSTEPS = 100, 3


class Swing(composer.Task):
    """Every hook does something, in calls that both engines know."""

    def __init__(self):
        self._root_entity = composer.ModelWrapperEntity(mjcf.from_xml_string(PENDULUM))
        model = self._root_entity.mjcf_model
        self.hinge, self.tip, self.sensors = (
            model.find("joint", "hinge"),
            model.find("site", "tip"),
            model.sensor.sensor,
        )
        self.control_timestep = SUBSTEPS * 0.01

    @property
    def task_observables(self):
        found = OrderedDict(
            sensors=MJCFFeature("sensordata", self.sensors),
            angle=MJCFFeature("qpos", self.hinge, buffer_size=3, delay=4, update_interval=2),
            smooth=MJCFFeature("qvel", self.hinge, buffer_size=5, aggregator="mean"),
            jitter=MJCFFeature(
                "qpos", self.hinge, buffer_size=2, delay=deterministic.Sequence([0, 5, 1]), update_interval=2
            ),
            turn=MJCFFeature("xmat", self.tip),
            pushed=Generic(lambda physics: physics.variables["pushed"]),
        )
        for value in found.values():
            value.enabled = True
        return found

    def initialize_episode(self, physics, random_state):
        physics.bind(self.hinge).qpos = 0.5
        physics.variables["pushed"] = physics.np.zeros(2)

    def before_step(self, physics, action, random_state):
        physics.set_control(0.3 * action)

    def before_substep(self, physics, action, random_state):
        physics.variables["pushed"] = physics.variables["pushed"] + 1.0

    def after_step(self, physics, random_state):
        physics.set(self.hinge, "qfrc_applied", 0.1 * physics.get(self.hinge, "qpos"))

    def get_reward(self, physics):
        return -physics.np.sum(physics.bind(self.tip).xpos ** 2)

    def should_terminate_episode(self, physics):
        return physics.bind(self.hinge).qpos[0] > 100.0


@pytest.fixture(scope="module")
def double():
    with jax.enable_x64(True):
        yield


def rollout(environment, actions):
    """Return the first state and, in one program, all that follow."""

    def play(key, actions):
        start = environment.reset(key)
        return start, jax.lax.scan(lambda s, a: (environment.step(s, a),) * 2, start, actions)[1]

    return jax.jit(play)(jax.random.key(0), actions)


@pytest.fixture(scope="module")
def played(double):
    environment = composer.MjxEnvironment(Swing(), time_limit=2.0)
    actions = np.random.RandomState(0).uniform(-1, 1, (STEPS, 1))
    return rollout(environment, jnp.asarray(actions)), actions


def test_a_task_without_contacts_is_that_of_the_c_engine(played):
    (start, states), actions = played
    env = composer.Environment(Swing())
    step = env.reset()
    for name, value in step.observation.items():
        np.testing.assert_allclose(start.observation[name], value, atol=1e-10, err_msg=name)
    for i, action in enumerate(actions):
        step = env.step(action)
        pairs = {n: (states.observation[n], value) for n, value in step.observation.items()}
        for name in ("qpos", "qvel", "sensordata", "site_xpos", "qacc"):
            pairs[name] = getattr(states.data, name), getattr(env.physics.data, name)
        for name, (found, value) in (pairs | {"reward": (states.reward, step.reward)}).items():
            np.testing.assert_allclose(found[i], value, atol=1e-10, err_msg=f"{name} at {i}")


def test_the_time_limit_truncates(played):
    (_, states), _ = played
    assert np.flatnonzero(states.done).tolist() == list(range(66, STEPS))  # 2 s are 66.7 steps of 30 ms
    assert np.asarray(states.truncated)[66]
    assert np.asarray(states.discount)[66] == 1.0


class Bounce(composer.NullTask):
    def __init__(self):
        arena, self.ball = composer.Arena(), mjcf.RootElement(model="ball")
        arena.mjcf_model.option.timestep = 0.004
        arena.mjcf_model.worldbody.add("geom", type="plane", size=[1, 1, 0.1])
        self.ball.worldbody.add("geom", type="sphere", size=[0.1])
        frame = arena.add_free_entity(composer.ModelWrapperEntity(self.ball))
        frame.pos = [0, 0, 0.2]
        super().__init__(arena)

    def initialize_episode(self, physics, random_state):
        physics.bind(mjcf.get_frame_freejoint(self.ball)).qvel = np.array([0.5, 0, 0, 0, 0, 0])


def test_random_walks_keep_their_state_in_each_copy():
    task = Swing()
    walk = Generic(lambda physics: physics.np.zeros(2), corruptor=noises.Additive(distributions.BiasedRandomWalk()))
    task.root_entity.observables.add_observable("walk", walk)
    state = jax.eval_shape(composer.MjxEnvironment(task).reset, jax.random.key(0))
    assert "BiasedRandomWalk_1" in state.memory


class Placed(Bounce):
    def __init__(self, high):
        super().__init__()
        other = mjcf.RootElement(model="other")
        other.worldbody.add("geom", type="sphere", size=[0.1])
        props = [composer.ModelWrapperEntity(other), next(self.root_entity.iter_entities(exclude_self=True))]
        self.root_entity.add_free_entity(props[0])
        self.props = props
        self.placer = composer.PropPlacer(props, distributions.Uniform([-0.2, -0.2, 0.15], [0.2, 0.2, high]))

    def initialize_episode(self, physics, random_state):
        self.placer(physics, random_state)


@pytest.mark.night  # `make test` places props with C in test_prop_placer.py
def test_props_are_placed_apart_in_every_copy():
    environment = composer.MjxEnvironment(Placed(0.4))
    states = jax.jit(jax.vmap(environment.reset))(jax.random.split(jax.random.key(1), 64))
    places = np.asarray(states.data.qpos).reshape(64, 2, 7)[:, :, :3]
    assert not np.asarray(states.failed).any()
    assert np.linalg.norm(places[:, 0] - places[:, 1], axis=-1).min() > 0.2
    assert places[..., 2].min() > 0.1


@pytest.mark.night
def test_giving_up_is_a_flag():
    class Never(Bounce):
        def initialize_episode(self, physics, random_state):
            physics.variables["tries"] = random_state.uniform()
            physics.fail(physics.variables["tries"] > -1)

    with pytest.raises(composer.EpisodeInitializationError):
        composer.Environment(Never()).reset()
    state = jax.jit(composer.MjxEnvironment(Never(), max_reset_attempts=4).reset)(jax.random.key(0))
    assert bool(state.failed)


@pytest.mark.night
def test_elliptic_cones_are_no_matter_where_nothing_can_touch():
    """MJX 3.17 raises a TypeError there: a joint limit, no contact, and the cones that arenas have."""
    arena = composer.Arena()
    limited = mjcf.from_xml_string(
        '<mujoco model="flap"><worldbody><body name="b"><joint name="j" axis="0 1 0" limited="true" range="-.1 .1"/>'
        '<geom size=".1" pos="0 0 -.2" contype="0" conaffinity="0"/></body></worldbody></mujoco>'
    )
    arena.attach(composer.ModelWrapperEntity(limited))
    task = composer.NullTask(arena)
    task.set_timesteps(control_timestep=0.02, physics_timestep=0.01)
    environment = composer.MjxEnvironment(task)
    state = jax.jit(lambda key: environment.step(environment.reset(key), jnp.zeros(0)))(jax.random.key(0))
    assert np.isfinite(state.data.qpos).all()
