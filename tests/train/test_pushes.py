"""Pushes change velocities by what was said, and differences grow over the training."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import Following, Growing

from sim2real.artifacts.episodes import Episodes
from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode
from sim2real.graph.schedule import draw
from sim2real.robots.loop import AGENT
from sim2real.robots.training import training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import load_robot
from sim2real.stages.train.bundle import training_summary
from sim2real.training.config import PPOConfig
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.environment.pushes import Pushes
from sim2real.training.environment.variation import VariationConfig
from sim2real.training.ppo.trainer import Sweep, train

KEY = jax.random.key(4)
CONFIG = PPOConfig(
    num_envs=8, minibatches=2, rollout_steps=4, total_steps=192, hidden=(4,), evaluations=2, eval_steps=2,
    epochs=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def robot():
    return load_robot("pendulum")


@pytest.fixture(scope="module")
def loop(robot):
    """The graph and the task of a pendulum whose gain differs, with a noisy sensor's parameters."""
    values = robot.nominal()
    nodes, task = training_loop(robot, values, {"gain": values["gain"] + np.array([-4.0, 4.0])}, {}, False)
    return nodes, task, CompiledGraph(nodes, AGENT, draw(nodes, 0.2))


@pytest.fixture
def pushes(robot, loop):
    return Pushes.of(VariationConfig(push=2.0, push_hz=10.0), loop[0]["world"], robot.drive.rate_hz)


def test_joints_are_pushed_as_often_and_as_hard_as_was_said(pushes):
    assert pushes.chance == pytest.approx(10.0 / 50.0)
    kicks = np.asarray(jax.jit(lambda key: pushes.kicks(key, (20000,)))(KEY))
    hit = kicks[kicks != 0.0]
    assert hit.size / kicks.size == pytest.approx(pushes.chance, rel=0.05)
    assert np.abs(hit).max() <= 2.0
    assert hit.std() == pytest.approx(2.0 / np.sqrt(3.0), rel=0.03)
    np.testing.assert_allclose(pushes.kicks(KEY, (20000,), jnp.float32(0.25)), 0.25 * kicks, rtol=1e-6)


def test_a_push_changes_the_velocity_by_what_was_drawn(loop):
    _, task, graph = loop
    world = loop[0]["world"]
    always = Pushes(world.name, world, (2.0,), 1.0)
    calm, pushed = GraphEnvironment(graph, task), GraphEnvironment(graph, task, pushes=always)
    state, _ = jax.jit(calm.reset)(KEY)
    action = jnp.array([1.0])
    without, with_it = (env.step(state, action, KEY).state.graph.state["world"] for env in (calm, pushed))
    kick = float(always.kicks(KEY, ()))
    assert abs(kick) > 0.1
    assert float(with_it.thdot - without.thdot) == pytest.approx(kick, abs=1e-5)
    assert float(with_it.th) == float(without.th), "a blow moves nothing at once"


def test_what_cannot_be_pushed_is_refused(loop):
    class Wall(BaseNode):
        def step(self, step_state):
            return step_state, None

    with pytest.raises(UsageError, match="a Wall cannot be pushed: it has no `velocity`"):
        Pushes.of(VariationConfig(push=1.0), Wall("wall", 50.0), 50.0)
    with pytest.raises(UsageError, match="must not exceed the policy's rate, 50 Hz, got 60"):
        Pushes.of(VariationConfig(push=1.0, push_hz=60.0), loop[0]["world"], 50.0)
    assert Pushes.of(VariationConfig(), Wall("wall", 50.0), 50.0) is None
    with pytest.raises(UsageError, match=r"vary.push_angular: a .* has no floating base"):
        Pushes.of(VariationConfig(push=1.0, push_angular=1.0), loop[0]["world"], 50.0)


def test_a_floating_base_is_pushed_by_sizes_of_its_own():
    class Floating(BaseNode):
        floats = True

        def velocity(self, state):
            return state

        def with_velocity(self, state, velocity):
            return velocity

        def step(self, step_state):
            return step_state, None

    def largest(**vary):
        pushes = Pushes.of(VariationConfig(push=0.5, push_hz=25.0, **vary), Floating("world", 50.0), 50.0)
        after = jax.vmap(lambda key: pushes.kicks(key, (6,)))(jax.random.split(KEY, 500))
        assert [len(values[0]) for _, _, values in pushes.named(after)] == [3, 3]
        return np.abs(after).max(0)

    np.testing.assert_allclose(largest(push_angular=2.0), [0.5] * 3 + [2.0] * 3, rtol=0.05)
    np.testing.assert_allclose(largest(push_angular=0.0), [0.5] * 3 + [0.0] * 3, rtol=0.05)
    np.testing.assert_allclose(largest(), [0.5] * 6, rtol=0.05)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"push": -1.0}, r"vary.push must lie in \[0, 100\]"),
        ({"start_velocity": 1e9}, "vary.start_velocity must lie"),
        ({"push_hz": 0.0}, "vary.push_hz must lie"),
        ({"curriculum": (0.0, 2.0)}, "vary.curriculum must be two shares"),
        ({"curriculum": (1.0, 0.0)}, "the second above 0, got 1.0 0.0"),
        ({"follow": 0.5}, "vary.follow must lie in .* beside a vary.curriculum that grows, got 0.5"),
        ({"follow": 1.0, "curriculum": (0.5, 1.0)}, "vary.follow must lie"),
        ({"push_angular": 1.0}, "vary.push_angular must lie in .* beside a vary.push above 0"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, said):
    with pytest.raises(UsageError, match=said):
        VariationConfig(**settings)


def test_a_share_of_all_differences_is_that_share_of_each(robot, loop, monkeypatch):
    _, task, graph = loop
    monkeypatch.setattr(task, "start", (0.3, 1.0))
    env = GraphEnvironment(graph, task, curriculum=(0.2, 0.8))
    keys = jax.random.split(KEY, 64)
    start = jax.jit(lambda width: jax.vmap(lambda key: env.reset(key, width))(keys)[0].graph.params)
    none, half, full = (jax.device_get(start(jnp.float32(w))) for w in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(none["world"].K, none["world"].K[0], rtol=1e-6)
    assert np.std(full["world"].K) > 0.1 * full["world"].K.mean()
    for part in (lambda p: p["world"].K, lambda p: p["world"].start):
        far = part(full) - part(none)
        assert np.std(far) > 0.0
        np.testing.assert_allclose(part(half) - part(none), 0.5 * far, atol=2e-6)
    moved = np.abs(full["world"].start - none["world"].start).max(0)
    assert (moved <= [0.3, 1.0]).all()
    assert (moved > [0.25, 0.85]).all()
    assert half["sensor"].noise.tolist() == [0.5] * 64
    last = jax.jit(lambda: jax.vmap(env.reset)(keys)[0].width)()
    np.testing.assert_allclose(last, 0.8)


@pytest.mark.night
def test_differences_grow_evenly_from_update_to_update():
    found = train(Growing(), CONFIG, KEY)
    widths = np.linspace(0.2, 0.7, CONFIG.updates)
    assert CONFIG.updates == 6
    np.testing.assert_allclose(found.history["width"][:, 0], widths[[2, 5]], rtol=1e-5)
    # A rollout's first rows belong to episodes that were started in the one before, one row each.
    before = np.concatenate([widths[:1], widths[:-1]])
    played = before / CONFIG.rollout_steps + widths * (1.0 - 1.0 / CONFIG.rollout_steps)
    np.testing.assert_allclose(found.history["reward"][:, 0], played.reshape(2, 3).mean(1), rtol=1e-5)
    np.testing.assert_allclose(found.history["return"], 0.7, rtol=1e-6, err_msg="evaluations have the last share")


@pytest.mark.night
def test_differences_that_follow_success_grow_while_it_is_high():
    """In a quarter of the updates from the first to the last share at most: by 1/3 of 0.5 each, and then they stay."""
    config = replace(CONFIG, total_steps=12 * 32, evaluations=12, num_envs=8)
    assert config.updates == 12
    found = train(Following(), config, KEY)
    widths, step = found.history["width"][:, 0], 0.5 / 3
    np.testing.assert_allclose(widths[:2], [0.2 + step, 0.2 + 2 * step], rtol=1e-5)
    np.testing.assert_allclose(widths[2:], widths[1], rtol=1e-6, err_msg="no longer successful")
    np.testing.assert_allclose(found.history["return"], 0.7, rtol=1e-6, err_msg="evaluations have the last share")
    # The result reports how far it came.
    shown = training_summary(found, config, Sweep({}), Episodes((), curriculum=(0.2, 0.7), follow=0.5))
    assert shown["share reached"] == "0.53 of 0.7: success did not stay above 0.5"
