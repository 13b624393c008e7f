"""The integrator of OdeWorld against solutions in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles.conformance import NodeConformance
from oracles.hash_nodes import Value

from sim2real.graph import BaseNode, StepState
from sim2real.worlds.ode import OdeWorld


class Oscillator(OdeWorld):
    """x'' = u - x, with a limited speed."""

    top = 1e9

    def init_state(self, rng=None, graph_state=None):
        return {"x": jnp.float32(1.0), "v": jnp.float32(0.0)}

    def init_output(self, rng=None, graph_state=None):
        return self.init_state()

    def derivative(self, params, state, command):
        return {"x": state["v"], "v": command - state["x"]}

    def command(self, step_state):
        return step_state.inputs["force"][-1].data.x if step_state.inputs else 0.0

    def limit(self, params, state):
        return {**state, "v": jnp.clip(state["v"], -self.top, self.top)}


class Force(BaseNode):
    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(0.0))

    def step(self, step_state):
        return step_state, Value(x=jnp.float32(1.0))


class TestOscillator(NodeConformance):
    def graph(self):
        world, force = Oscillator("world", 50), Force("force", 50)
        world.connect(force, skip=True)
        return {"force": force, "world": world}, "world"


def error_after_a_second(substep_s, rate=10):
    world = Oscillator("world", rate, substep_s=substep_s)
    ss = StepState(state={"x": jnp.asarray(1.0), "v": jnp.asarray(0.0)})  # float64 where it is enabled
    for _ in range(rate):
        ss, output = jax.jit(world.step)(ss)
    assert output == ss.state
    return abs(float(output["x"]) - np.cos(1.0)), world.substeps


def test_it_converges_as_a_method_of_order_four():
    with jax.enable_x64(True):
        coarse, n = error_after_a_second(0.1)
        fine, m = error_after_a_second(0.05)
    assert (n, m) == (1, 2)
    assert coarse < 1e-6
    assert 14 < coarse / fine < 18


def test_limits_hold_after_every_substep():
    world = Oscillator("w", 10)
    world.top = 0.05
    ss, _ = world.step(StepState(state=world.init_state()))
    assert float(ss.state["v"]) == pytest.approx(-0.05)
    assert float(ss.state["x"]) > 0.994
