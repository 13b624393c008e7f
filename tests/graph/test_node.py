"""Nodes, connections and collections of nodes: what they refuse, and what they say about it."""

import distrax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2real.graph as base
from sim2real.errors import UsageError
from sim2real.graph import BaseNode, BaseWorld, DelayDistribution, Jitter, Scheduling
from sim2real.graph.node import by_name, check_senders
from sim2real.graph.schedule import draw
from sim2real.graph.slicing import tree_dynamic_slice

NAN = float("nan")


def pair(**options):
    sensor, agent = BaseNode("sensor", 10), BaseNode("agent", 10)
    agent.connect(sensor, **options)
    return sensor, agent


@pytest.mark.parametrize("rate", [0, -1, NAN, float("inf"), None, "10"])
def test_a_rate_is_a_positive_number(rate):
    for cls in (BaseNode, BaseWorld):
        with pytest.raises(UsageError, match="'n': rate must be a positive number"):
            cls("n", rate)


@pytest.mark.parametrize(
    "options",
    [
        *({name: value} for name in ("delay", "delay_dist") for value in (-0.1, NAN, "x")),
        {"delay_dist": np.float32("inf")},
        {"delay_dist": distrax.Deterministic(-1.0)},
        {"delay_dist": distrax.Normal(NAN, 0.1)},
    ],
)
def test_delays_are_checked_and_named(options):
    with pytest.raises(UsageError, match="node 'n'"):
        BaseNode("n", 10, **options)
    a, b = BaseNode("a", 10), BaseNode("b", 10)
    with pytest.raises(UsageError, match=r"connection 'a' -> 'b' \(input 'in'\)"):
        b.connect(a, name="in", **options)
    assert not b.inputs
    assert not a.outputs


def test_options_are_checked_and_may_be_numpy_s_or_given_by_value():
    node = BaseNode("n", np.int64(50), delay=np.float64(0.002), delay_dist=np.float32(0.001), scheduling="phase")
    assert (type(node.rate), node.rate, node.delay, node.scheduling) == (float, 50.0, 0.002, Scheduling.PHASE)
    c = node.connect(BaseNode("a", 10), window=np.int32(3), delay_dist=np.float32(0.25), jitter="buffer")
    assert (type(c.window), c.total_window, c.delay, c.jitter) == (int, 3, 0.25, Jitter.BUFFER)
    world = BaseWorld("w", np.float32(50), color="blue", order=2)  # busy for a hair less than its period
    assert (world.delay, world.phase_output, world.color, world.order) == (0.999 / 50, 0.999 / 50, "blue", 2)
    for window in (0, 1.5, "2", None):
        with pytest.raises(
            UsageError, match=f"'a' -> 'n'.* window must be a whole number.* at least 1, got {window!r}"
        ):
            node.connect(BaseNode("a", 1), name="more", window=window)
    with pytest.raises(UsageError, match="node 'n': connect takes the node that sends, got 'p'"):
        node.connect("p")
    with pytest.raises(ValueError, match="sometimes"):
        BaseNode("n", 1, scheduling="sometimes")


def test_defaults_of_the_callbacks():
    node = BaseNode("n", 10)
    assert node.init_params() == node.init_state() == node.init_output() == base.Empty()
    assert node.init_delays() == {}
    assert node.startup(base.GraphState())
    assert node.stop()
    assert node.now() == 0.0
    with pytest.raises(NotImplementedError, match=r"node .n. .BaseNode. has no step"):
        node.step(base.StepState())


def test_arithmetic_and_indexing_of_messages():
    state = base.InputState(
        seq=jnp.arange(3), ts_sent=jnp.arange(3.0), ts_recv=jnp.arange(3.0), data=jnp.arange(6.0).reshape(3, 2)
    )
    assert state[-1].data.tolist() == [4.0, 5.0]
    assert state[-2:].seq.tolist() == [1, 2]
    double = state + state
    assert double.data.tolist() == (2 * np.arange(6.0).reshape(3, 2)).tolist()
    assert ((state * 2.0 - state) / 2.0).ts_sent.tolist() == [0.0, 0.5, 1.0]
    assert (-state).seq.tolist() == [0, -1, -2]


def test_tree_helpers():
    tree = {"a": jnp.arange(6).reshape(2, 3), "b": np.arange(12.0).reshape(2, 3, 2)}
    out = tree_dynamic_slice(tree, jnp.array([1, 7]))
    assert out["a"].tolist() == [[5]]
    assert out["b"].shape == (1, 1, 2)


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        ("sensor", "nodes of a graph were expected, got 'sensor'"),
        (None, "nodes of a graph were expected, got None"),
        (["sensor"], "made of nodes, got 'sensor'"),
        ([BaseNode("a", 1), BaseNode("a", 2)], "two nodes are called 'a'"),
        ({"b": BaseNode("a", 1)}, "key 'b' stands for a node that is called 'a'"),
    ],
)
def test_what_is_no_collection_of_nodes_is_refused(nodes, words):
    with pytest.raises(UsageError, match=words):
        by_name(nodes)


def test_a_sender_is_the_node_itself():
    """A sensor that was replaced, while the agent still listens to the old one: its rate and delays would be wrong."""
    sensor, agent = pair()
    with pytest.raises(UsageError, match=r"'agent' listens to another object called 'sensor' \(.*rate=10\)") as error:
        draw([BaseNode("sensor", 50), agent], 1.0)
    assert "connect 'agent' to the new node" in (error.value.hint or "")
    with pytest.raises(UsageError, match="'agent' listens to 'sensor', which is not in the graph"):
        check_senders({"agent": agent})
    check_senders({"agent": agent}, among={})
    listed, named = draw([sensor, agent], 1.0), draw({"sensor": sensor, "agent": agent}, 1.0)
    np.testing.assert_array_equal(listed.edges["agent", "sensor"].seq_in, named.edges["agent", "sensor"].seq_in)


class Odd(DelayDistribution):
    """Draws what it is told to."""

    def __init__(self, drawn):
        self.drawn = drawn

    def sample(self, rng, shape):
        return self.drawn(shape)

    def quantile(self, q):
        return 0.0


@pytest.mark.parametrize(
    "drawn",
    [lambda s: np.full(s, np.nan), lambda s: np.full(s, -0.1), lambda s: np.zeros(3)],
    ids=["nan", "<0", "shape"],
)
def test_a_distribution_that_draws_no_delays_is_named(drawn):
    with pytest.raises(UsageError, match=r"node 'n': .*Odd.* draws invalid delays"):
        draw([BaseNode("n", 10, delay_dist=Odd(drawn))], 1.0)
    with pytest.raises(UsageError, match=r"'sensor' -> 'agent'.* draws invalid delays"):
        draw(pair(delay_dist=Odd(drawn)), 1.0)


@pytest.mark.parametrize(("duration_s", "episodes"), [(float("nan"), 1), (float("inf"), 1), (1.0, 0)])
def test_timelines_have_a_length_and_a_number(duration_s, episodes):
    with pytest.raises(UsageError, match="cannot be drawn"):
        draw([BaseNode("n", 10)], duration_s, episodes)
