"""What a step returns must look like what it got; only what JAX itself takes for the same may differ."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.hash_nodes import Value

from sim2real.errors import UsageError
from sim2real.graph import BaseNode
from sim2real.graph.schedule import draw
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.runtime.steps import Format, matched

FLOAT, INT = jnp.float32(1.0), jnp.int32(1)


@pytest.mark.parametrize(
    ("got", "like"),
    [(0.5, FLOAT), (0, FLOAT), (np.float64(0.5), FLOAT), (2, INT), (True, jnp.bool_(False)), (jnp.asarray(0.5), FLOAT),
     (3, jnp.uint8(0)), (np.zeros(2), jnp.zeros(2))],
)  # fmt: skip
def test_the_same_in_other_words_passes(got, like):
    found = matched("n", "it", got, "that", like)
    assert (found.dtype, found.shape) == (like.dtype, like.shape)
    np.testing.assert_array_equal(found, got)


@pytest.mark.parametrize(
    ("got", "like", "words"),
    [
        (0.5, INT, r"float32\[\] instead of int32\[\]"),
        (FLOAT, INT, r"float32\[\] instead of int32\[\]"),
        (INT, FLOAT, r"int32\[\] instead of float32\[\]"),
        (jnp.zeros(3), FLOAT, r"float32\[3\] instead of float32\[\]"),
        ("x", FLOAT, r"str instead of float32\[\]"),
    ],
)
def test_another_type_is_refused_by_name(got, like, words):
    with pytest.raises(UsageError, match=rf"node 'n': it differs from that: \.x is {words}"):
        matched("n", "it", Value(x=got), "that", Value(x=like))
    with pytest.raises(UsageError, match="node 'n': it differs from that: "):
        matched("n", "it", {"y": got}, "that", {"x": like})


class Slip(BaseNode):
    """The usual slip: 0 where 0.0 was meant."""

    def init_state(self, rng=None, graph_state=None):
        return 0 if "state" in self.name else 0.0

    def init_output(self, rng=None, graph_state=None):
        return Value(x=0 if "output" in self.name else 0.0)

    def step(self, step_state):
        return step_state.replace(state=step_state.state + 0.25), Value(x=0.1)


@pytest.mark.parametrize(
    ("name", "words"), [("state", "the state that step returns"), ("output", "the output of step")]
)
def test_no_angle_becomes_0_because_init_said_0(name, words):
    nodes = [Slip(name, 10)]
    nodes[0].connect(nodes[0], skip=True)  # somebody hears it
    timeline = draw(nodes, 0.5)
    compiled = CompiledGraph(nodes, name, timeline)
    with pytest.raises(UsageError, match=rf"node {name!r}: {words} differs .* float32\[\] instead of int32\[\]"):
        jax.eval_shape(lambda: compiled.rollout(compiled.init(jax.random.key(0))))
    simulated = AsyncGraph(nodes, nodes[0], Clock.SIMULATED, timeline=timeline)
    with pytest.raises(UsageError, match=f"node {name!r}: {words} differs"):
        simulated.warmup(simulated.init(jax.random.key(0)))


def test_an_integer_that_does_not_fit_is_an_error_on_a_clock():
    """A step in plain Python returns numbers of 64 bits: 300 would become 44 in 8 bits."""
    form = Format("node", {"count": np.int8(0)})
    assert form.pack({"count": 100})[0].dtype == np.int8
    with pytest.raises(UsageError, match="300, which does not fit into int8"):
        form.pack({"count": 300})
