"""The initial state: the same for the same seed, in whatever order the nodes are given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from asynchronous_nodes import Jitted, Plain
from oracles.hash_nodes import HashInJax, HashInPython

from sim2real.errors import UsageError
from sim2real.graph import TrainableDist
from sim2real.runtime.init import OUTPUTS, collect, default_output, init_graph_state

KEY = jax.random.key(3)


class Reads(HashInJax):
    """Its state is made from another node's, which must be there before it."""

    def init_params(self, rng=None, graph_state=None):
        return jax.random.uniform(rng)

    def init_state(self, rng=None, graph_state=None):
        return graph_state.state["a"] + jnp.uint32(1)

    def init_delays(self, rng=None, graph_state=None):
        return {"a": graph_state.params["b"] * 0 + 0.03, "unknown": 1.0}


def graph():
    a, b, c = HashInJax("a", 10), Reads("b", 10), HashInPython("c", 10)
    b.connect(a, delay_dist=TrainableDist.create(0.0, 0.0, 0.05))
    b.connect(c, delay_dist=TrainableDist.create(0.01, 0.0, 0.05), skip=True)
    return {"a": a, "b": b, "c": c}


def test_does_not_depend_on_the_order_of_nodes():
    nodes = graph()
    first = init_graph_state(nodes, "a", KEY)
    second = init_graph_state(dict(reversed(nodes.items())), nodes["a"], KEY)
    for field in ("params", "state", "aux"):
        one, two = getattr(first, field), getattr(second, field)
        assert jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), one, two))
    assert int(first.aux[OUTPUTS]["a"].x) != int(first.aux[OUTPUTS]["c"].x)
    assert int(init_graph_state(nodes, "a", jax.random.key(4)).aux[OUTPUTS]["a"].x) != int(first.aux[OUTPUTS]["a"].x)


def test_order_params_and_delays():
    nodes = graph()
    with pytest.raises(KeyError):
        init_graph_state(nodes, "b", KEY)
    state = init_graph_state(nodes, "b", KEY, params={"b": 0.25}, order=["a"])
    assert float(state.params["b"]) == 0.25
    assert int(state.state["b"]) == int(state.state["a"]) + 1
    assert float(state.delays["b"]["a"].delay) == pytest.approx(0.03)
    assert float(state.delays["b"]["c"].delay) == pytest.approx(0.01)
    assert set(state.delays) == {"b"}
    assert set(state.delays["b"]) == {"a", "c"}
    assert int(state.step) == -1
    for given in ({"params": {"z": 1}}, {"order": ["z"]}):
        with pytest.raises(UsageError, match="names z, not in the graph"):
            init_graph_state(nodes, "a", KEY, **given)

    states = jax.jit(jax.vmap(lambda k: init_graph_state(nodes, "a", k)))(jax.random.split(KEY, 4))
    one = init_graph_state(nodes, "a", jax.random.split(KEY, 4)[2])
    np.testing.assert_array_equal(states.aux[OUTPUTS]["a"].x[2], one.aux[OUTPUTS]["a"].x)


def test_what_is_no_graph_is_refused():
    nodes = graph()
    assert set(collect([nodes["a"], nodes["c"]], nodes["b"])) == {"a", "b", "c"}
    lone, eager = Jitted("lone", 10), Plain("eager", 10, advance=True)
    lone.connect(lone)
    for args, words in (
        (({"x": nodes["a"]}, nodes["a"]), "the key 'x' stands for"),
        (([lone], lone), "algebraic loop"),
        (([eager], eager), "advance=True"),
        *(((nodes, wrong), "the supervisor must be one of the nodes") for wrong in ("a", None, ["a", "b"])),
    ):
        with pytest.raises(UsageError, match=words):
            collect(*args)
    with pytest.raises(UsageError, match="no default output"):
        default_output(init_graph_state({"a": nodes["a"]}, "a", KEY), "b")
