"""Nodes under the suite that any node can inherit; and nodes that it must catch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from contractions import contracting_node
from oracles.conformance import NodeConformance
from oracles.hash_nodes import HashInJax, HashInPython, Value

from sim2real.graph import BaseNode
from sim2real.stages.load import load_robot


def heard(node, sender):
    node.connect(sender, window=3)
    return {n.name: n for n in (sender, node)}, node.name


class TestHashInJax(NodeConformance):
    def graph(self):
        return heard(HashInJax("a", 10), HashInJax("b", 10))


class TestHashInPython(NodeConformance):
    def graph(self):
        return heard(HashInPython("a", 10), HashInPython("b", 10))


class TestContraction(NodeConformance):
    def graph(self):
        return heard(contracting_node("a", 10, False), contracting_node("w", 10, True))


class TestPendulumSensor(NodeConformance):
    def graph(self):
        nodes = load_robot("pendulum").identifiable(0.06).nodes(0.06)
        return nodes, "sensor"


class TestPendulumWorld(NodeConformance):
    def graph(self):
        nodes = load_robot("pendulum").identifiable(0.06).nodes(0.06)
        return nodes, "world"


class Bad(BaseNode):
    """Has the faults that its name says."""

    def init_state(self, rng=None, graph_state=None):
        return jnp.zeros(2)

    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(np.random.default_rng().random() if "init" in self.name else 0.0))

    def step(self, step_state):
        self.calls = getattr(self, "calls", 0) + 1
        x = jnp.float32(self.calls if "impure" in self.name else 1.0)
        x = x.astype(jnp.int32) if "output" in self.name else x
        state = jnp.zeros(3) if "state" in self.name else step_state.state
        if "traced" in self.name and float(step_state.ts) > 1.0:
            x = -x
        return step_state.replace(state=state), Value(x=x)


@pytest.mark.parametrize(
    ("fault", "test", "error"),
    [
        ("impure", "test_the_step_is_pure", AssertionError),
        ("state", "test_the_step_keeps_structure_shapes_and_dtypes", AssertionError),
        ("output", "test_the_output_looks_like_the_default_output", AssertionError),
        ("init", "test_what_init_makes_depends_on_the_key_alone", AssertionError),
        ("traced", "test_the_step_can_be_compiled", jax.errors.ConcretizationTypeError),
    ],
)
def test_faults_are_caught(fault, test, error):
    class Suite(NodeConformance):
        def graph(self):
            return heard(Bad(f"a {fault}", 10), Bad(f"b {fault}", 10))

    for name in (n for n in dir(Suite) if n.startswith("test_")):
        if name == test:
            with pytest.raises(error):
                getattr(Suite(), name)()
        elif fault not in ("impure", "init", "traced"):
            getattr(Suite(), name)()
