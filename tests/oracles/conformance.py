"""Test suites to inherit: the requirements on every node and every runtime."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from contractions import contracting_node
from oracles.hash_nodes import MakeNode, hash_node, random_graph
from oracles.reference import Reference

from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.node import BaseNode
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.types import PyTree


def first_step_state(nodes: Mapping[str, BaseNode], name: str, key: jax.Array) -> StepState:
    """Return the step state of a node's first step, before any message has arrived.

    Args:
        key: JAX key of parameters, states and default outputs.
    """
    # Parameters and states first, as the outputs may depend on them.
    keys = {n: jax.random.split(jax.random.fold_in(key, i), 4) for i, n in enumerate(nodes)}
    gs = GraphState()
    for n, node in nodes.items():
        gs = gs.replace(params={**gs.params, n: node.init_params(keys[n][0], gs)})
    for n, node in nodes.items():
        gs = gs.replace(state={**gs.state, n: node.init_state(keys[n][1], gs)})
    # Fill each window with the sender's default output.
    inputs = {}
    for input_name, c in nodes[name].inputs.items():
        sender = c.output_node.name
        output = nodes[sender].init_output(keys[sender][2], gs)
        data = jax.tree_util.tree_map(lambda x, w=c.window: jnp.broadcast_to(x, (w, *jnp.shape(x))), output)
        zeros = jnp.zeros(c.window, jnp.float32)
        inputs[input_name] = InputState(jnp.full(c.window, -1, jnp.int32), zeros, zeros, data)
    step = StepState(
        keys[name][3], gs.state[name], gs.params[name], inputs, jnp.int32(0), jnp.int32(0), jnp.float32(0.0)
    )
    return jax.tree_util.tree_map(jnp.asarray, step)


class NodeConformance(ABC):
    """Tests that every node must pass. Inherit in a test module, under a name that starts with ``Test``."""

    @abstractmethod
    def graph(self) -> tuple[Mapping[str, BaseNode], str]:
        """Return the connected node and its senders, by name; and the name of the node to test."""

    def first_step(self) -> tuple[BaseNode, StepState, Mapping[str, BaseNode]]:
        """Return the node, its first step state, and all nodes by name."""
        nodes, name = self.graph()
        return nodes[name], first_step_state(nodes, name, jax.random.key(0)), nodes

    def test_the_step_is_pure(self) -> None:
        """The same step state gives the same results and is not modified."""
        node, step_state, _ = self.first_step()
        before = copy.deepcopy(jax.tree_util.tree_map(np.asarray, _without_keys(step_state)))
        first, second = node.step(step_state), node.step(step_state)
        assert _equal(_without_keys(first), _without_keys(second)), f"node {node.name!r}: two calls differ"
        assert _equal(before, _without_keys(step_state)), f"node {node.name!r}: step changed its step state"

    def test_the_step_keeps_structure_shapes_and_dtypes(self) -> None:
        """State, parameters and key keep structure, shapes and dtypes: a compiled loop carries them."""
        node, step_state, _ = self.first_step()
        after, _ = node.step(step_state)
        for field in ("state", "params", "rng"):
            _same_form(getattr(step_state, field), getattr(after, field), f"node {node.name!r}: {field}")

    def test_the_output_looks_like_the_default_output(self) -> None:
        """Output and default output have the same structure: a reader's window holds both."""
        node, step_state, nodes = self.first_step()
        gs = GraphState(
            params={n: x.init_params(jax.random.key(1)) for n, x in nodes.items()}, state={node.name: step_state.state}
        )
        _same_form(node.init_output(jax.random.key(2), gs), node.step(step_state)[1], f"node {node.name!r}: output")

    def test_what_init_makes_depends_on_the_key_alone(self) -> None:
        """The same key gives the same parameters, state and output."""
        node, _, nodes = self.first_step()
        one, two = (first_step_state(nodes, node.name, jax.random.key(5)) for _ in range(2))
        assert _equal(_without_keys(one), _without_keys(two)), f"node {node.name!r}: init is not reproducible"

    def test_the_step_can_be_compiled(self) -> None:
        """JAX can trace the step, unless ``jittable`` is False."""
        node, step_state, _ = self.first_step()
        if node.jittable:
            traced = jax.eval_shape(node.step, step_state)[1]
            _same_form(traced, node.step(step_state)[1], f"node {node.name!r}: traced output")


T = TypeVar("T")


class Played(NamedTuple):
    """One episode of hash nodes, as a runtime played it.

    Attributes:
        outputs: Node -> its outputs by seq, shape ``(N,)``; the last few steps may be missing.
    """

    states: Mapping[str, PyTree]
    defaults: Mapping[str, PyTree]
    outputs: Mapping[str, np.ndarray]


class RuntimeConformance(ABC):
    """Tests that every runtime must pass: each step gets exactly the messages of the timing rules."""

    make: MakeNode = staticmethod(hash_node)
    """Makes the hash nodes, in Python or in JAX."""
    seeds: Sequence[int] = range(8)
    """Seeds of the random graphs."""
    duration_s: float = 0.4
    """Length of an episode [s]."""

    @abstractmethod
    def play(self, nodes: Mapping[str, BaseNode], supervisor: str, timeline: Timeline, episode: int) -> Played:
        """Play one episode of a timeline in the runtime under test."""

    trainable: bool = True
    """Whether the runtime applies trainable delays."""

    def test_every_step_sees_what_the_rules_say(self) -> None:
        """The hash of all messages that a node has read equals that of the reference implementation."""
        for seed in self.seeds:
            self.check(random_graph(seed, make=type(self).make), seed)

    def test_messages_of_every_dtype_arrive_as_they_were_sent(self) -> None:
        """The same with messages of random dtypes, and trainable delays, at which integers and booleans hold."""
        for seed in self.seeds[:1] if self.trainable else ():
            self.check(random_graph(seed, make=type(self).make, trainable=True), seed)

    def test_floats_lie_between_the_messages_that_the_rules_say(self) -> None:
        """Values of trainable delays, which interpolate, under blocking inputs and bursts."""
        for seed in self.seeds[:1] if self.trainable else ():
            self.check(random_graph(seed, make=contracting_node, trainable=True), seed, floats=True)

    def check(self, nodes: Mapping[str, BaseNode], seed: int, floats: bool = False) -> None:
        """Compare an episode of hash nodes, or of contractions, with the reference implementation."""
        timeline, kind = draw(nodes, self.duration_s, 2, seed), float if floats else int
        played = self.play(nodes, "n0", timeline, seed % 2)
        start = [{n: kind(x) for n, x in values.items()} for values in (played.states, played.defaults)]
        reference = Reference(nodes, timeline, seed % 2)
        expected = reference.floats(*start) if floats else reference.hashes(*start)
        for name, states in expected.items():
            got = [kind(x) for x in played.outputs.get(name, ())]
            where = f"seed {seed}: node {name!r}"
            if floats:
                np.testing.assert_allclose(got, np.tanh(states)[: len(got)], atol=2e-4, err_msg=where)
            else:
                sent = [reference.message(name, h) for h in states]
                assert got == sent[: len(got)], f"{where} read other messages"
            # A compiled graph computes steps that reach no world up to two periods of the supervisor late.
            assert len(got) >= 0.4 * len(states) - 3, f"{where} made {len(got)} steps"


def _without_keys(tree: T) -> T:
    """Return the tree with JAX keys replaced by their raw numbers."""

    def one(leaf: PyTree) -> PyTree:
        is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return jax.random.key_data(leaf) if is_key else leaf

    return jax.tree_util.tree_map(one, tree)


def _equal(a: object, b: object) -> bool:
    same = jax.tree_util.tree_map(lambda x, y: np.array_equal(x, y, equal_nan=False), a, b)
    return all(jax.tree_util.tree_leaves(same))


def _same_form(expected: object, got: object, what: str) -> None:
    trees = [jax.tree_util.tree_structure(t) for t in (expected, got)]
    assert trees[0] == trees[1], f"{what}: {trees[1]} instead of {trees[0]}"
    flat, _ = jax.tree_util.tree_flatten_with_path(expected)
    for (path, old), new in zip(flat, jax.tree_util.tree_leaves(got), strict=True):
        form = [(jnp.shape(x), jnp.result_type(x)) for x in (old, new)]
        assert form[0] == form[1], f"{what}{jax.tree_util.keystr(path)}: {form[1]} instead of {form[0]}"
