"""What nodes and connections refuse, and what they say about it."""

import jax.numpy as jnp
import numpy as np
import pytest

import sim2real.graph as base
from sim2real.errors import UsageError
from sim2real.graph import BaseNode, BaseWorld, Jitter, Scheduling
from sim2real.graph.slicing import tree_dynamic_slice


@pytest.mark.parametrize("rate", [0, -1, float("nan"), float("inf"), None, "10"])
def test_a_rate_is_a_positive_number(rate):
    for cls in (BaseNode, BaseWorld):
        with pytest.raises(UsageError, match="'n': rate must be a positive number"):
            cls("n", rate)


def test_numbers_may_be_numpy_s():
    node = BaseNode("n", np.int64(50), delay=np.float64(0.002), delay_dist=np.float32(0.001))
    assert (type(node.rate), node.rate, node.delay) == (float, 50.0, 0.002)
    assert BaseWorld("w", np.float32(50)).rate == 50.0
    connection = node.connect(BaseNode("a", 10), window=np.int32(3), delay_dist=np.float32(0.25))
    assert (type(connection.window), connection.total_window, connection.delay) == (int, 3, 0.25)


NAN = float("nan")


@pytest.mark.parametrize("value", [-0.1, NAN, "x"])
@pytest.mark.parametrize("option", ["delay", "delay_dist"])
def test_delays_are_checked_and_named(option, value):
    options = {option: value}
    with pytest.raises(UsageError, match="node 'n'"):
        BaseNode("n", 10, **options)
    a, b = BaseNode("a", 10), BaseNode("b", 10)
    with pytest.raises(UsageError, match=r"connection 'a' -> 'b' \(input 'in'\)"):
        b.connect(a, name="in", **options)
    assert not b.inputs
    assert not a.outputs


@pytest.mark.parametrize("window", [0, 1.5, "2", None])
def test_a_window_is_a_whole_number_of_at_least_one(window):
    with pytest.raises(UsageError, match=f"'a' -> 'b'.* window must be a whole number.* at least 1, got {window!r}"):
        BaseNode("b", 1).connect(BaseNode("a", 1), window=window)


def test_only_nodes_can_be_connected():
    with pytest.raises(UsageError, match="node 'b': connect takes the node that sends, got 'p'"):
        BaseNode("b", 1).connect("p")


def test_options_may_be_given_by_value_and_unknown_ones_are_refused():
    assert BaseNode("n", 1, scheduling="phase").scheduling is Scheduling.PHASE
    assert BaseNode("b", 1).connect(BaseNode("a", 1), jitter="buffer").jitter is Jitter.BUFFER
    with pytest.raises(ValueError, match="sometimes"):
        BaseNode("n", 1, scheduling="sometimes")


def test_a_world_is_busy_for_a_hair_less_than_its_period():
    world = BaseWorld("w", 50, color="blue", order=2)
    assert (world.delay, world.phase_output, world.color, world.order) == (0.999 / 50, 0.999 / 50, "blue", 2)


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
