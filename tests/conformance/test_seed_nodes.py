"""The node tutorial that the project starts from runs here with only its import lines changed.

The tutorial itself is not part of this repository: its folder is ``../shared/seeds``, or ``$SIM2REAL_SEEDS``.
"""

import os
import re
from pathlib import Path
from typing import Union

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import sim2real.graph as graph_room
from sim2real import Policy
from sim2real.graph import BaseNode, DelayDistribution, GraphState, Jitter, Scheduling, StepState, Timeline
from sim2real.graph.delays import TrainableDist
from sim2real.graph.episode import MemoryRecorder
from sim2real.graph.schedule import draw
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.training.networks.architectures import MLP, init_mlp

SEEDS = Path(os.environ.get("SIM2REAL_SEEDS", Path(__file__).parents[3] / "shared" / "seeds"))
TUTORIAL = sorted(SEEDS.glob("001_*.txt"))
pytestmark = pytest.mark.skipif(not TUTORIAL, reason=f"no node tutorial in {SEEDS} (set SIM2REAL_SEEDS)")

IMPORTS = {
    "from rex import base": "import sim2real.graph as base",
    "from rex.base import GraphState, StepState": "from sim2real.graph import GraphState, StepState",
    "from rex.node import BaseNode": "from sim2real.graph import BaseNode",
    "from rex.node import BaseWorld": "from sim2real.graph import BaseWorld",
    "from rex.jax_utils import tree_dynamic_slice": "from sim2real.graph.slicing import tree_dynamic_slice",
    "from rex.ppo import Policy": "from sim2real import Policy",
}
RATE_HZ, DURATION_S = 50.0, 3.0
KEY = jax.random.key(2)


def text():
    return TUTORIAL[0].read_text(encoding="utf-8").replace("\xa0", " ")


def cells():
    """Return the complete examples of the tutorial, by title."""
    parts = re.split(r"^# @title Example: (.*)$", text(), flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def with_our_imports(code):
    """Change import lines, and nothing else."""
    lines = [IMPORTS.get(line, line) for line in code.splitlines()]
    assert not [line for line in lines if re.match(r"\s*(from|import) rex", line)]
    return "\n".join(lines)


def snippet(first, last):
    """Return the lines of the tutorial from one that starts with ``first`` to one that starts with ``last``."""
    lines = text().splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith(first))
    end = next(i for i in range(begin, len(lines)) if lines[i].startswith(last))
    return "\n".join(lines[begin : end + 1])


@pytest.fixture(scope="module")
def tutorial():
    """Run the cells in order in one namespace; return it."""
    namespace = {"__name__": "tutorial"}
    for title, code in cells().items():
        exec(compile(with_our_imports(code), f"<tutorial: {title}>", "exec"), namespace)
    return namespace


def connected(sensor, agent, actuator, world, to_world, to_sensor):
    """Connect the four nodes as the notebook does that the tutorial belongs to."""
    agent.connect(sensor, blocking=True, window=3, delay_dist=distrax.Normal(0.002, 0.002))
    actuator.connect(agent, blocking=True, delay_dist=distrax.Normal(0.002, 0.002))
    world.connect(actuator, skip=True, delay_dist=to_world)
    sensor.connect(world, delay_dist=to_sensor)
    return {n.name: n for n in (sensor, agent, actuator, world)}


def delay(value=0.0):
    """Return a delay to identify; the recorded timing has jitter, so messages come in small bursts."""
    return TrainableDist.create(value, 0.0, 0.1, "linear", burst=1)


def robot(t, world="OdeWorld", sensor="Sensor", actuator="Actuator", delays=None):
    to_world, to_sensor = delays or (distrax.Normal(0.01, 0.002), distrax.Normal(0.01, 0.002))
    computation = distrax.Normal(0.0075, 0.003)
    return connected(
        t[sensor]("sensor", RATE_HZ, delay_dist=computation),
        t["Agent"]("agent", RATE_HZ, delay_dist=distrax.Normal(0.01, 0.003)),
        t[actuator]("actuator", RATE_HZ, delay_dist=computation),
        t[world]("world", RATE_HZ),
        to_world,
        to_sensor,
    )


def record(nodes, timeline, params=None):
    recorder = MemoryRecorder()
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, recorder=recorder, timeline=timeline)
    graph.start(graph.init(KEY, params, order=("agent",)))
    assert graph.wait(timeout_s=120)
    graph.stop()
    return recorder.episode()


@pytest.fixture(scope="module")
def log(tutorial):
    """Record three seconds of random actions on the ODE world, in simulated clock."""
    nodes = robot(tutorial)
    timeline = draw(nodes, DURATION_S, rng=1)
    return timeline, record(nodes, timeline)


@pytest.fixture(scope="module")
def open_loop(tutorial):
    """Record three seconds of given actions, held for half a second each, through reset and step."""
    nodes = robot(tutorial, sensor="SimSensor", delays=(delay(0.035), delay(0.025)))
    recorder = MemoryRecorder()
    timeline = draw(nodes, DURATION_S, rng=4)
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, recorder=recorder, timeline=timeline)
    params = {
        "sensor": tutorial["SensorParams"](sensor_delay=0.025),
        "actuator": tutorial["ActuatorParams"](actuator_delay=0.035),
    }
    gs, ss = graph.reset(graph.init(KEY, params, order=("agent",)))
    for k in range(int(timeline.vertices["agent"].count[0]) - 1):
        action = [-1.7, 1.7, -1.0, 1.0, 0.0, 0.1][int(k / (0.5 * RATE_HZ)) % 6]
        gs, ss = graph.step(gs, ss, tutorial["AgentOutput"](action=jnp.array([action], jnp.float32)))
    graph.stop()
    return recorder.episode()


def test_the_cells_are_the_expected_ones():
    assert list(cells()) == ["Agent", "Actuator", "Sensor", "ODE simulation node", "Brax simulation node"]


def test_the_record_holds_what_the_nodes_did(log):
    _, episode = log
    counts = {n: len(s) for n, s in episode.steps.items()}
    assert set(counts) == {"sensor", "agent", "actuator", "world"}
    assert all(0.95 * RATE_HZ * DURATION_S < count <= RATE_HZ * DURATION_S for count in counts.values())
    action = episode.outputs["agent"]["action"]
    assert action.shape[1:] == (1,)
    assert action.std() > 0.8
    assert np.ptp(episode.outputs["sensor"]["th"]) > 0.3


def test_compiled_it_rolls_out_as_recorded(tutorial, log):
    timeline, episode = log
    graph = CompiledGraph(robot(tutorial), "agent", timeline)
    _, records = jax.jit(lambda: graph.rollout(graph.init(KEY, order=("agent",)), tuple(graph.nodes)))()
    for name, field, tolerance in (
        ("agent", "action", 0),
        ("actuator", "action", 0),
        ("world", "th", 2e-4),
        ("world", "thdot", 2e-3),
        ("sensor", "th", 2e-4),
    ):
        ran = np.asarray(records[name].seq) >= 0
        got = np.asarray(getattr(records[name].output, field))[ran]
        assert len(got) > 0.9 * RATE_HZ * DURATION_S
        np.testing.assert_allclose(got, episode.outputs[name][field][: len(got)], atol=tolerance, rtol=0)


@pytest.mark.night
def test_sensor_and_actuator_delay_are_identified_from_the_record(tutorial, open_loop):
    """Recorded actions go in, recorded measurements are compared in the sensor: only the sum of the delays matters."""
    episode = open_loop
    outputs = {n: {f: jnp.asarray(x)[None] for f, x in episode.outputs[n].items()} for n in ("sensor", "actuator")}
    nodes = connected(
        tutorial["SimSensor"]("sensor", RATE_HZ, outputs=tutorial["SensorOutput"](**outputs["sensor"])),
        tutorial["Agent"]("agent", RATE_HZ),
        tutorial["SimActuator"]("actuator", RATE_HZ, outputs=tutorial["ActuatorOutput"](**outputs["actuator"])),
        tutorial["OdeWorld"]("world", RATE_HZ),
        delay(),
        delay(),
    )
    recorded = Timeline.from_episode(episode, {n: nodes[n] for n in ("sensor", "agent", "actuator")})
    graph = CompiledGraph(nodes, "agent", draw(nodes, DURATION_S, recorded=recorded))

    def loss(total):
        params = {
            "sensor": tutorial["SensorParams"](sensor_delay=total / 2),
            "actuator": tutorial["ActuatorParams"](actuator_delay=total / 2),
        }
        gs, _ = graph.rollout(graph.init(KEY, params, order=("agent",)))
        return gs.state["sensor"].loss_th + 0.01 * gs.state["sensor"].loss_thdot

    sums = np.linspace(0.0, 0.1, 41)
    losses = np.asarray(jax.jit(jax.vmap(loss))(jnp.asarray(sums, jnp.float32)))
    best = int(np.argmin(losses))
    assert sums[best] == pytest.approx(0.06, abs=0.0026)
    assert losses[best] < 0.01 * losses[-1]
    slope = jax.jit(jax.grad(loss))
    assert float(slope(jnp.float32(0.07))) > 0 > float(slope(jnp.float32(0.05)))


def test_a_policy_of_ours_acts_in_the_agent(tutorial):
    nodes = robot(tutorial, sensor="SimSensor", actuator="SimActuator")
    rng = np.random.default_rng(0)
    policy = Policy(
        params=init_mlp(rng, (19, 8, 1), 1.0), log_std=jnp.zeros(1), mean=jnp.zeros(19), std=jnp.ones(19),
        low=-2.0 * jnp.ones(1), high=2.0 * jnp.ones(1), network=MLP((8, 1)),
    )  # fmt: skip
    params = {"agent": nodes["agent"].init_params().replace(policy=policy, init_method="random")}
    graph = CompiledGraph(nodes, "agent", draw(nodes, 1.0))
    gs, ss = jax.jit(graph.reset)(graph.init(KEY, params, order=("agent",)))
    expected = policy.get_action(tutorial["AgentParams"].get_observation(ss))
    assert float(gs.state["world"].th) == pytest.approx(float(gs.state["agent"].init_th), abs=1.0)
    gs, ss = jax.jit(graph.step)(gs, ss)
    np.testing.assert_allclose(gs.buffer["agent"][-1].action, expected, rtol=1e-5)
    np.testing.assert_allclose(gs.state["agent"].history_act[0], expected, rtol=1e-5)


@pytest.mark.night
def test_the_brax_world_runs(tutorial):
    """The second world of the tutorial; in `make test` all other tests here run the first one."""
    nodes = robot(tutorial, world="BraxWorld", sensor="SimSensor", actuator="SimActuator")
    timeline = draw(nodes, 0.4)
    episode = record(nodes, timeline)
    th = episode.outputs["world"]["th"]
    assert np.isfinite(th).all()
    assert len(th) == 20
    assert 0.001 < np.ptp(th) < 3.0


def test_the_sketches_of_the_text_are_valid_definitions(tutorial):
    """Not complete (``...`` bodies, a missing argument), but their classes and the connection can be made."""
    names = dict(Union=Union, distrax=distrax, jax=jax, struct=struct, BaseNode=BaseNode, Jitter=Jitter)
    names |= dict(GraphState=GraphState, StepState=StepState, DelayDistribution=DelayDistribution)
    names |= dict(Scheduling=Scheduling)
    exec(snippet("class MyNode(BaseNode):", "        return step_state.replace(state=new_state), output"), names)
    exec(snippet("@struct.dataclass", "    some_output_data: jax.Array"), names)
    exec(snippet("class RealWorldNode(BaseNode):", "        return True  # Return True if successful"), names)
    assert names["MyNode"]("n", 10, order=1).rate == 10
    assert names["RealWorldNode"]("n", 10).startup(graph_room.GraphState())
    assert names["MyParams"](some_parameter=2.0).adjust_parameter(3.0).some_parameter == 6.0
    a, b = names["MyNode"]("node_a", 10), names["MyNode"]("node_b", 10)
    exec(snippet("node_a.connect(", ")"), {**names, "node_a": a, "node_b": b})
    connection = a.inputs["input_from_b"]
    assert (connection.blocking, connection.window, connection.delay, connection.skip) == (True, 5, 0.01, False)
