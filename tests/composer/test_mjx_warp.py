"""The same tasks on MuJoCo Warp: against C and against MJX's JAX, on the CPU; what Warp cannot run."""

import composer_parts
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import Generic, MJCFFeature
from sim2real.composer.variation import PhysicsVariator, distributions, noises
from sim2real.errors import UsageError
from sim2real.graph import Base, BaseNode
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled.graph import CompiledGraph

pytestmark = pytest.mark.night  # compiles kernels; starting without them is tested in test_mjx_refusals.py
STEPS, SUBSTEPS = 50, 2
MISSING = "Warp is not installed: the extra warp"


@pytest.fixture(scope="module")
def installed():
    """Whatever runs on Warp; its kernels are compiled once for a machine, in about half a minute."""
    return pytest.importorskip("warp", reason=MISSING)


class Throw(composer.Task):
    """An arm swings while a ball is thrown on the floor; without a floor it falls through, with no contacts."""

    def __init__(self, floor=True, vary=False):
        arena = composer.Arena()
        root = arena.mjcf_model
        root.option.timestep = 0.004
        root.worldbody.add("geom", type="plane", size=[2, 2, 0.1])
        if not floor:  # MJX's JAX fails on elliptic cones, the arena's, where no contact is possible
            root.option.flag.contact, root.option.cone = "disable", "pyramidal"
        self.arm = composer.ModelWrapperEntity(composer_parts.model(composer, composer_parts.ARM))
        base = self.arm.mjcf_model.worldbody.geom[0]
        base.contype = base.conaffinity = 0  # it just touches the arm: a coin's toss in single precision
        arena.attach(self.arm).pos = [0, 0, 0.6]
        ball = mjcf.RootElement(model="ball")
        ball.worldbody.add("geom", type="sphere", size=[0.1])
        self.ball = composer.ModelWrapperEntity(ball)
        arena.add_free_entity(self.ball).pos = [1, 0, 0.2]
        self._root_entity, self.joints = arena, self.arm.mjcf_model.find_all("joint")
        self.control_timestep, self.variator = SUBSTEPS * 0.004, PhysicsVariator()
        if vary:
            self.variator.bind_attributes(
                self.joints[0], damping=noises.Multiplicative(distributions.Uniform(0.5, 2.0))
            )

    @property
    def task_observables(self):
        found = {
            "sensors": MJCFFeature("sensordata", self.arm.mjcf_model.sensor.sensor),
            "late": MJCFFeature("qpos", self.joints, buffer_size=3, delay=3, update_interval=2),
            "wrist": MJCFFeature("xpos", self.arm.mjcf_model.find("site", "wrist")),
            "turn": MJCFFeature("xmat", self.arm.mjcf_model.find("site", "wrist")),
            "pushed": Generic(lambda physics: physics.variables["pushed"]),
        }
        for value in found.values():
            value.enabled = True
        return found

    def initialize_episode(self, physics, random_state):
        self.variator.apply_variations(physics, random_state)
        physics.set(self.joints, "qpos", np.array([0.5, -0.3]))
        physics.set(mjcf.get_frame_freejoint(self.ball.mjcf_model), "qvel", np.array([0.5, 0, 0, 0, 0, 0]))
        physics.variables["pushed"] = physics.np.zeros(1)

    def before_substep(self, physics, action, random_state):
        physics.set_control(action)
        physics.variables["pushed"] = physics.variables["pushed"] + 1.0

    def get_reward(self, physics):
        return physics.bind(self.ball.mjcf_model.find_all("geom")[0]).xpos[2]


def rollout(environment, actions, key=None):
    """Return the first state and, in one program, all that follow."""

    def play(key):
        start = environment.reset(key)
        return start, jax.lax.scan(lambda s, a: (environment.step(s, a),) * 2, start, actions)[1]

    return jax.jit(play)(jax.random.key(0) if key is None else key)


@pytest.fixture(scope="module")
def actions():
    return np.random.RandomState(0).uniform(-0.5, 0.5, (STEPS, 2)).astype(np.float32)


def worst(states, env, actions):
    """Return the largest difference to C, name by name, and the number of steps with contacts."""
    env.reset()
    found, touching = {}, 0
    for i, action in enumerate(actions):
        env.step(action)
        touching += bool(env.physics.data.ncon)
        for name in ("qpos", "qvel", "qacc", "actuator_force", "sensordata", "site_xpos", "cvel"):
            here = np.asarray(getattr(states.data, name)[i])
            scale = max(1.0, np.abs(getattr(env.physics.data, name)).max())
            found[name] = max(found.get(name, 0.0), np.abs(here - getattr(env.physics.data, name)).max() / scale)
    return found, touching


@pytest.mark.parametrize("legacy", [True, False])
def test_steps_without_contacts_are_those_of_c(installed, actions, legacy):
    environment = composer.MjxEnvironment(Throw(floor=False), legacy_step=legacy, impl="warp")
    _, states = rollout(environment, actions)
    found, touching = worst(states, composer.Environment(Throw(floor=False), legacy_step=legacy), actions)
    assert not touching
    assert max(found.values()) < 1e-5, found


class Sensing(Throw):
    """Sensors of every stage, of limits and of contacts among them."""

    def __init__(self, integrator):
        super().__init__()
        self.root_entity.mjcf_model.option.integrator = integrator
        ball, arm = self.ball.mjcf_model, self.arm.mjcf_model
        for joint in self.joints:
            joint.limited, joint.range = True, [-0.2, 0.45]
        inside = ball.worldbody.add("site", name="inside", size=[0.11])
        for kind in ("touch", "accelerometer", "velocimeter"):
            ball.sensor.add(kind, site=inside)
        for kind in ("force", "torque"):
            arm.sensor.add(kind, site=arm.find("site", "wrist"))
        for kind in ("jointlimitpos", "jointlimitvel", "jointlimitfrc"):
            arm.sensor.add(kind, joint=self.joints[0])
        arm.sensor.add("subtreelinvel", body=arm.worldbody.body[0])


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_steps_with_contacts_and_sensors_of_every_stage_are_those_of_c(installed, actions, integrator):
    _, states = rollout(composer.MjxEnvironment(Sensing(integrator), impl="warp"), actions)
    found, touching = worst(states, composer.Environment(Sensing(integrator)), actions)
    assert touching > 5
    assert max(found.values()) < 1e-4, found


class Varied(Throw):
    """Every copy has a ball, an arm, a gravity and an air of its own; the model was compiled without air."""

    def __init__(self):
        super().__init__()
        geom = self.ball.mjcf_model.find_all("geom")[0]
        factor = noises.Multiplicative(distributions.Uniform(0.5, 2.0))
        self.variator.bind_attributes(geom, size=factor)
        for body in self.arm.mjcf_model.find_all("body"):
            self.variator.bind_attributes(body, mass=factor)

    def initialize_episode(self, physics, random_state):
        super().initialize_episode(physics, random_state)
        physics.model.opt.gravity = physics.np.array([0.0, 0.0, -5.0]) * random_state.uniform(1.0, 2.0)
        physics.model.opt.density = 100.0 * random_state.uniform(1.0, 2.0)


def test_masses_sizes_and_options_differ_from_copy_to_copy_as_on_jax(installed, actions):
    keys = jax.random.split(jax.random.key(1), 3)

    def play(impl):
        environment = composer.MjxEnvironment(Varied(), impl=impl)
        return jax.vmap(lambda key: rollout(environment, actions, key)[1])(keys)

    mine, theirs = play("warp"), play("jax")
    names = {"body_mass", "body_invweight0", "dof_invweight0", "geom_size", "geom_rbound", "opt.gravity", "opt.density"}
    assert names < set(mine.leaves) & set(theirs.leaves)
    for name in sorted(set(mine.leaves) & set(theirs.leaves)):
        np.testing.assert_allclose(mine.leaves[name], theirs.leaves[name], rtol=2e-4, atol=1e-6, err_msg=name)
    boxes, radii = (np.asarray(mine.leaves[name])[:, 0, -1] for name in ("geom_aabb", "geom_size"))
    np.testing.assert_allclose(boxes[:, 1], np.tile(radii[:, :1], (1, 3)))
    np.testing.assert_allclose(mine.data.qpos, theirs.data.qpos, atol=1e-4)
    assert np.ptp(np.asarray(mine.data.qpos)[:, -1, 4]) > 0.01  # balls that lie are as high as they are large


class Again(Throw):
    """Draws a start until it is high enough, and computes with it: a predicate that differs from copy to copy."""

    def initialize_episode(self, physics, random_state):
        super().initialize_episode(physics, random_state)
        physics.set(self.joints, "qpos", random_state.uniform(-0.8, 0.8, 2))
        physics.fail(physics.bind(self.arm.mjcf_model.find("site", "wrist")).xpos[2] < 1.05)


def test_copies_start_differ_and_are_selected_one_by_one(installed, actions):
    environment = composer.MjxEnvironment(Again(vary=True), max_reset_attempts=30, impl="warp", nconmax=16)
    reset, step = jax.jit(jax.vmap(environment.reset)), jax.jit(jax.vmap(environment.step))
    keys = jax.random.split(jax.random.key(3), 4)
    states = start = reset(keys)
    assert not np.asarray(start.failed).any()
    assert np.asarray(start.observation["wrist"])[:, 0, 2].min() > 1.05
    assert len(set(np.asarray(start.leaves["dof_damping"])[:, 0].tolist())) == 4
    for action in actions[:20]:
        states = step(states, np.tile(action, (4, 1)))
    _, alone = rollout(environment, actions[:20], keys[2])
    np.testing.assert_allclose(states.data.qpos[2], alone.data.qpos[-1], atol=1e-5)
    assert np.ptp(np.asarray(states.data.qpos)[:, 0]) > 0.01

    done = np.array([False, True, False, True])
    mixed = jax.jit(jax.vmap(environment.select))(done, start, states)
    for i, at in enumerate(done):
        whole = jax.tree_util.tree_map(lambda x, i=i: x[i], start if at else states)
        here = jax.tree_util.tree_map(lambda x, i=i: x[i], mixed)
        np.testing.assert_array_equal(here.data.qpos, whole.data.qpos)
        assert here.steps == whole.steps
    after, fresh = step(mixed, np.tile(actions[0], (4, 1))), step(start, np.tile(actions[0], (4, 1)))
    np.testing.assert_allclose(after.data.qpos[1], fresh.data.qpos[1], atol=1e-6)


def test_copies_share_the_room_for_contacts_and_all_end_when_it_is_too_small(installed):
    task = Throw()
    box = task.ball.mjcf_model.find_all("geom")[0]
    box.type, box.size = "box", [0.1, 0.1, 0.1]
    environment = composer.MjxEnvironment(task, impl="warp", nconmax=2)  # a box touches the floor in four places
    start = jax.vmap(environment.reset)(jax.random.split(jax.random.key(0), 2))
    step = jax.jit(jax.vmap(environment.step))
    for heights, ends in (([0.09, 0.5], False), ([0.09, 0.09], True)):
        qpos = start.data.qpos.at[:, 4].set(jnp.array(heights))
        state = step(start.replace(data=start.data.replace(qpos=qpos)), jnp.zeros((2, 2)))
        assert np.isfinite(state.data.qpos).all()
        assert np.asarray(state.done).tolist() == [ends, ends]
        assert not np.asarray(state.truncated).any()
        if not ends:
            assert state.data.qvel[0, 4] > state.data.qvel[1, 4]  # the floor holds it


def test_a_copy_ends_when_there_is_no_room_for_its_constraints(installed, actions):
    environment = composer.MjxEnvironment(Throw(), impl="warp", njmax=1)
    _, states = rollout(environment, actions)
    done = np.asarray(states.done)
    assert not done[0]
    assert done[-1]
    assert (np.asarray(states.discount) == ~done).all()
    assert np.isfinite(states.data.qpos).all()


@struct.dataclass
class Torque(Base):
    action: jax.Array


class Brake(BaseNode):
    def init_output(self, rng=None, graph_state=None):
        return Torque(jnp.zeros(2))

    def step(self, step_state):
        return step_state, Torque(-0.5 * step_state.inputs["world"][-1].data.values["late"][-1])


def in_a_graph(impl):
    """Return the positions of two copies that differ in damping and in their delays, after 0.4 s."""
    task = Throw(floor=False)
    world = composer.ComposedWorld("world", task, parameters={"damping": (task.joints, "damping")}, impl=impl)
    agent = Brake("actuator", rate=25.0, delay_dist=0.003)
    agent.connect(world, skip=True, delay_dist=0.004)
    world.connect(agent, skip=True, delay_dist=0.002)
    nodes = {"actuator": agent, "world": world}
    graph = CompiledGraph(nodes, "actuator", draw(nodes, 0.4, episodes=2))
    params = world.init_params()

    def play(damping, eps):
        values = {"world": params.replace(values={"damping": damping})}
        return graph.rollout(graph.init(jax.random.key(0), values, eps=eps))[0].state["world"].data.qpos

    damping = jnp.stack([params.values["damping"], 2 * params.values["damping"]])
    return np.asarray(jax.jit(jax.vmap(play))(damping, jnp.arange(2)))


def test_the_same_graph_runs_on_both(installed):
    mine, theirs = in_a_graph("warp"), in_a_graph("jax")
    np.testing.assert_allclose(mine, theirs, atol=1e-5)
    assert np.abs(mine[0] - mine[1]).max() > 1e-3


@pytest.mark.parametrize(
    ("option", "match"),
    [
        (("noslip_iterations", 3), "noslip_iterations is 3"),
        (("solver", "PGS"), "MJX-Warp cannot run this model: .*PGS"),
        ("placer", "PropPlacer reads the contacts of a copy"),
        ("contacts", "a copy has no 'contact__dist' of its own"),
    ],
)
def test_what_warp_cannot_run_is_refused_by_name(installed, option, match):
    task = Throw()
    if option == "placer":
        task.initialize_episode = composer.PropPlacer([task.ball], distributions.Uniform([0, 0, 0.2], [1, 1, 0.4]))
    elif option == "contacts":
        task.get_reward = lambda physics: physics.data.contact__dist[0]
    else:
        setattr(task.root_entity.mjcf_model.option, *option)
    with pytest.raises((UsageError, AttributeError), match=match):
        composer.MjxEnvironment(task, impl="warp")


def test_parameters_that_warp_cannot_change_are_refused(installed):
    task = Throw()
    with pytest.raises(UsageError, match="MJX-Warp cannot change 'dof_M0'"):
        composer.ComposedWorld("world", task, parameters={"m": (task.joints, "M0")}, impl="warp")
