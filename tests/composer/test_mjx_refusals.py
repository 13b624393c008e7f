"""What a compiled program cannot do, refused with the name of hook, element or option; and actions of a task's own."""

import collections
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dm_env import specs

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import Generic, MJCFCamera
from sim2real.composer.physics.mjx.warp import warp
from sim2real.composer.variation import distributions
from sim2real.errors import UsageError

ROD = """
<mujoco model="rod"><option timestep="0.01" {option}><flag {flag}/></option>
  <default><geom contype="0" conaffinity="0" condim="1"/></default>
  <worldbody><camera name="front"/><body name="rod"><joint name="hinge" axis="0 1 0"/><geom name="rod" type="capsule"
    fromto="0 0 0 .3 0 0" size=".02"/><site name="tip" pos=".3 0 0"/></body></worldbody>
  <actuator><motor name="torque" joint="hinge" ctrlrange="-1 1" ctrllimited="true" {actuator}/></actuator>
  <keyframe><key name="up" qpos=".7" qvel=".2" time="1.5"/></keyframe>
</mujoco>
"""


class Rod(composer.Task):
    def __init__(self, option="", actuator="", flag=""):
        text = ROD.format(option=option, actuator=actuator, flag=flag)
        self._root_entity = composer.ModelWrapperEntity(mjcf.from_xml_string(text))
        model = self._root_entity.mjcf_model
        self.hinge, self.tip = model.find("joint", "hinge"), model.find("site", "tip")
        self.geom = model.find("geom", "rod")
        self.n, self.mode, self.memory, self.counts = 0, None, {"before": np.zeros(3)}, collections.deque([0])
        self.random = np.random.RandomState(0)
        self.control_timestep = 0.02

    def get_reward(self, physics):
        return physics.bind(self.tip).xpos[2]


def made(**hooks):
    """Return an environment of a rod with some hooks; nothing is compiled."""
    return composer.MjxEnvironment(type("Rod", (Rod,), hooks)())


def start(function):
    return {"initialize_episode": lambda self, physics, random_state: function(self, physics)}


def after(function):
    return {"after_step": lambda self, physics, random_state: function(self, physics)}


def reward(function):
    return {"get_reward": function}


def count(task, physics):
    task.n += 1


def remember(task, physics):
    task.memory["before"] = physics.bind(task.tip).xpos


def end(task, physics):
    return bool(physics.bind(task.hinge).qpos[0] > 1)


IN_PLACE = r"Rod.initialize_episode writes into an array in place.*physics.write\("
TYPES = {
    "initialize_episode": lambda task, physics, random_state: physics.variables.update(n=0),
    "after_substep": lambda task, physics, random_state: physics.variables.update(n=physics.variables["n"] + 0.5),
}


@pytest.mark.parametrize(
    ("hooks", "match"),
    [
        # What only Python would keep.
        (after(count), r"Rod.n is changed by Rod.after_step.*same value\s+hint: keep .* physics.variables\['n'\]"),
        (start(count), "Rod.n is changed by Rod.initialize_episode"),
        (after(lambda task, _: task.counts.append(1)), "Rod.counts is changed by Rod.after_step"),
        (after(remember), r"Rod.memory was set by a hook, Rod.after_step, to a value that exists only"),
        (start(lambda task, _: task.random.uniform()), "Rod.random is changed by Rod.initialize_episode"),
        (start(lambda task, _: np.random.uniform()), "Rod.initialize_episode draws from a global source of randomness"),
        # What needs a number, with the way to do it, and the line.
        (reward(lambda task, p: 1.0 if p.bind(task.tip).xpos[2] > 1 else 0.0), r"decides in Python .*physics.np.where"),
        (reward(lambda task, p: np.linalg.norm(p.bind(task.tip).xpos)), "calls numpy on .*use physics.np"),
        (reward(lambda task, p: float(p.bind(task.tip).xpos[2])), "makes a Python number of .*leave it an array"),
        (reward(lambda task, p: [0.0, 1.0][p.np.argmax(p.bind(task.tip).xpos)]), "uses .* as a Python integer"),
        (reward(lambda task, p: p.bind(task.tip).xpos[p.bind(task.tip).xpos > 0].sum()), "picks items with a mask"),
        ({"should_terminate_episode": end}, r"Rod.should_terminate_episode .*\(line \d+: return bool\("),
        # What is written in place.
        (start(lambda task, p: p.bind(task.hinge).qpos.__setitem__(0, 0.3)), IN_PLACE),
        (start(lambda task, p: p.data.qpos.__setitem__(0, 0.3)), IN_PLACE),
        (start(lambda task, p: p.model.body_mass.__setitem__(1, 2.0)), IN_PLACE),
        # What the program has as a constant.
        (start(lambda task, p: setattr(p.bind(task.geom), "contype", 1)), "geom_contype"),
        (start(lambda task, p: p.bind([task.geom]).contype.__setitem__(slice(None), 1)), "geom_contype"),
        (start(lambda task, p: p.model.geom_contype.__setitem__(slice(None), 1)), "geom_contype"),
        (start(lambda task, p: p.named.model.geom_contype.__setitem__("rod", 1)), "geom_contype"),
        (start(lambda task, p: setattr(p.model.opt, "iterations", 1)), "opt.iterations"),
        (start(lambda task, p: setattr(p.model.opt, "disableflags", 16)), "opt.disableflags"),
        (start(lambda task, p: setattr(p.model.stat, "extent", 1.0)), "stat.extent"),
        (start(lambda task, p: p.model.vis.headlight.ambient.__setitem__(0, 1.0)), "vis.headlight.ambient"),
        (start(lambda task, p: setattr(p.bind(task.hinge), "frictionloss", 1.0)), "dof_frictionloss"),
        # Variables and fields.
        (TYPES, r"physics.variables\['n'\] starts as int32\[\] and is float32\[\] after a step"),
        (after(lambda task, p: p.variables.update(late=p.time())), "'late' first appear in a step"),
        (after(lambda task, p: p.bind(task.hinge).qfrc_adhesion), "MJX has no field 'qfrc_adhesion'"),
    ],
)
def test_what_a_hook_cannot_do_is_refused_by_name(hooks, match):
    with pytest.raises((UsageError, AttributeError), match=f"(?s){match}"):
        made(**hooks)


@pytest.mark.parametrize(
    ("model", "options", "match"),
    [
        ({"option": 'noslip_iterations="3"'}, {}, "no-slip solver: option noslip_iterations is 3"),
        ({"actuator": 'delay="0.02" nsample="8"'}, {}, "delays and intervals: actuator 'torque'"),
        ({"option": 'integrator="implicit"'}, {}, "integrator mjINT_IMPLICIT"),
        ({"flag": 'spring="disable"'}, {}, "both springs and dampers if one of them is disabled"),
        ({}, {"impl": "warp"}, "mujoco-mjx"),  # which is not installed
        ({}, {"impl": "warp", "nconmax": 0}, "nconmax is a number of at least 1, got 0"),
        ({}, {"impl": "warp", "njmax": 0}, "njmax is a number of at least 1, got 0"),
        ({}, {"impl": "cpp"}, "no implementation 'cpp'"),
        ({}, {"nconmax": 10}, "nconmax and njmax are Warp's"),
    ],
)
def test_models_and_options_are_refused_by_name(model, options, match, monkeypatch):
    monkeypatch.setattr("mujoco.mjx.warp.WARP_INSTALLED", False)
    with pytest.raises(UsageError, match=match):
        composer.MjxEnvironment(Rod(**model), **options)


def test_elliptic_cones_without_friction_are_refused_by_name():
    arena = composer.Arena()
    for name in ("a", "b"):
        ball = f'<body name="{name}"><freejoint/><geom name="{name}" size=".1" condim="1"/></body>'
        arena.mjcf_model.attach(mjcf.from_xml_string(f'<mujoco model="{name}"><worldbody>{ball}</worldbody></mujoco>'))
    with pytest.raises(UsageError, match=r"(?s)condim 1.*'a/a', 'b/b'.*pyramidal"):
        composer.MjxEnvironment(composer.NullTask(arena))


def test_observables_are_refused_by_name():
    def add(name, observable):
        task = Rod()
        task.root_entity.observables.add_observable(name, observable(task))
        return task

    late = Generic(lambda physics: physics.time(), delay=distributions.Poisson(2.0))
    for name, observable, match in (
        ("far", lambda task: lambda p: np.linalg.norm(p.bind(task.tip).xpos), "observable 'far' calls numpy"),
        ("front", lambda t: MJCFCamera(t.root_entity.mjcf_model.find("camera", "front")), "camera observables 'front'"),
        ("late", lambda task: late, r"observable 'late': .* has no bound"),
    ):
        with pytest.raises(UsageError, match=match):
            composer.MjxEnvironment(add(name, observable))
    late.max_delay = 9
    assert composer.MjxEnvironment(add("late", lambda task: late)).observation_spec()["late"].shape == (1,)


@pytest.mark.parametrize("chosen", [None, "cpu", "device"])
def test_warp_starts_on_the_device_that_jax_computes_on(chosen, monkeypatch):
    monkeypatch.setattr("mujoco.mjx.warp.WARP_INSTALLED", True)
    monkeypatch.setattr("mujoco.mjx.warp.mujoco_warp", SimpleNamespace())
    cpu = jax.devices("cpu")[0]
    with jax.default_device(cpu if chosen == "device" else chosen):
        assert warp.find_device() == cpu
    monkeypatch.setattr(warp.jax, "devices", lambda kind=None: [SimpleNamespace(platform="tpu")] if not kind else [])
    if chosen is None:
        with pytest.raises(UsageError, match="Warp runs on CUDA devices and on the CPU"):
            warp.find_device()


def test_what_is_the_same_for_all_may_be_kept_and_options_belong_to_each_copy():
    def initialize_episode(task, physics, random_state):
        task.mode = int(physics.bind(task.geom).element_id)
        task.found = [task.mode]
        physics.model.opt.gravity = random_state.uniform(-1, 1, 3)

    environment = made(initialize_episode=initialize_episode)
    task = environment.task
    assert (task.mode, task.found, task.n) == (0, [0], 0)
    states = jax.eval_shape(jax.vmap(environment.reset), jax.random.split(jax.random.key(0), 4))
    assert states.leaves["opt.gravity"].shape == (4, 3)
    with pytest.raises(ValueError, match="read-only"):
        environment.model.geom_contype[:] = 1


def test_rewards_may_be_arrays_and_controls_of_another_size_are_refused():
    environment = made(get_reward=lambda task, physics: physics.bind(task.tip).xpos[:2])
    state = jax.eval_shape(environment.reset, jax.random.key(0))
    after = jax.eval_shape(environment.step, state, jnp.zeros(1))
    assert state.reward.shape == after.reward.shape == (2,)
    with pytest.raises(UsageError, match=r"there are 1 controls, and set_control was given an array of shape \(3,\)"):
        jax.eval_shape(environment.step, state, jnp.zeros(3))


@pytest.mark.night
def test_writes_by_name_and_column_work():
    def write(task, physics):
        physics.named.data.qpos["hinge"] = 0.3
        physics.bind(task.hinge)["qvel"] = 0.5
        physics.bind([task.tip])["pos", ["x", "z"]] = physics.np.array([0.1, 0.2])

    state = jax.jit(made(**start(write)).reset)(jax.random.key(0))
    np.testing.assert_allclose([*state.data.qpos, *state.data.qvel], [0.3, 0.5])
    np.testing.assert_allclose(state.leaves["site_pos"], [[0.1, 0.0, 0.2]])


class Steered(Rod):
    """Three numbers make one torque; where they act is looked up when the model is compiled."""

    def action_spec(self, physics):
        return specs.BoundedArray((3,), float, [-1, -2, -1e10], 1.0)

    def after_compile(self, physics, random_state):
        self.number = physics.bind(self.tip).element_id
        physics.model.opt.gravity = [0, 0, -1]

    def before_step(self, physics, action, random_state):
        physics.set_control(action @ physics.np.array([0.1, 0.2, 0.3]))

    def get_reward(self, physics):
        return physics.data.site_xpos[self.number][2]


def test_actions_of_a_task_s_own_and_after_compile():
    environment = composer.MjxEnvironment(Steered())
    assert environment.action_spec().shape == (3,)
    assert environment.mjx_model.opt.gravity.tolist() == [0, 0, -1]
    after = jax.eval_shape(environment.step, jax.eval_shape(environment.reset, jax.random.key(0)), jnp.zeros(3))
    assert after.data.ctrl.shape == (1,)
    pytest.importorskip("gymnasium", reason="the vector environment: the extra interop")
    with pytest.raises(
        UsageError, match=r"task Steered has no observation: no observable is enabled\. Available: none"
    ):
        composer.MjxVectorEnv(environment, 2)

    class Shown(Steered):
        @composer.observable
        def height(self, physics):
            return physics.bind(self.tip).xpos[2:]

    environment = composer.MjxEnvironment(Shown())
    assert composer.BraxEnv(environment).action_size == 3
    space = composer.MjxVectorEnv(environment, 2).single_action_space
    assert (space.low.tolist(), space.high.tolist()) == ([-1, -2, -np.inf], [1, 1, 1])


@pytest.mark.night
def test_states_keyframes_colours_and_choices():
    """What hooks of dm_control's call; the same numbers as on C where nothing is drawn."""

    def begin(self, physics, random_state):
        physics.reset(0)
        physics.set_state(0.5 * physics.get_state())
        hue = 0.6 + 0.0 * physics.bind(self.hinge).qpos[0]
        physics.bind(self.geom).rgba = physics.np.stack([hue, 0.5 + 0 * hue, 0.8 + 0 * hue, 1.0 + 0 * hue])
        drawn = physics.np.asarray(random_state.choice(3, size=4, p=[0, 0, 1]))
        physics.variables["drawn"] = drawn + 0.0 * random_state.standard_normal(4)

    state = jax.jit(made(initialize_episode=begin).reset)(jax.random.key(0))
    env = composer.Environment(type("Rod", (Rod,), {"initialize_episode": begin})())
    env.reset()
    data = env.physics.data
    np.testing.assert_allclose([state.data.qpos[0], state.data.qvel[0], state.data.time], [0.35, 0.1, 1.5])
    np.testing.assert_allclose([data.qpos[0], data.qvel[0], data.time], [0.35, 0.1, 1.5])
    np.testing.assert_allclose(state.leaves["geom_rgba"], env.physics.model.geom_rgba, rtol=1e-6)
    np.testing.assert_array_equal(state.variables["drawn"], [2, 2, 2, 2])

    with pytest.raises(UsageError, match=r"hint: use x = random_state.permutation\(x\)"):
        made(initialize_episode=lambda self, physics, random_state: random_state.shuffle(np.arange(3)))
    with pytest.raises(AttributeError, match="on MJX random_state has no 'vonmises'"):
        made(initialize_episode=lambda self, physics, random_state: random_state.vonmises(0, 1))
    with pytest.raises(UsageError, match="must be between 0 and 0 inclusive, got: 3"):
        made(**start(lambda task, physics: physics.reset(3)))
