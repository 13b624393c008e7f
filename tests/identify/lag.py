"""A first-order lag, whose logs and derivatives are solved by hand: the world of the tests of identification."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sim2real.graph.base import Base
from sim2real.graph.episode import Episode, Steps
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.identification.config import FitConfig
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.segments import Span

TICK_S, PERIOD_S, DURATION_S, LENGTH_S = 0.01, 0.02, 10.0, 1.0
GAIN, TAU_S, BIAS, NOISE = 1.7, 0.13, 0.2, 0.002


@struct.dataclass
class Level(Base):
    """State and measurement."""

    y: jnp.ndarray


@struct.dataclass
class Command(Base):
    """What drives it."""

    u: jnp.ndarray


@struct.dataclass
class Params(Base):
    """A lag whose input has a bias, and a square that it does not have."""

    gain: float = 1.0
    tau: float = 0.1
    bias: float = 0.0
    square: float = 0.0
    start: float = 0.0


class Lag(BaseWorld):
    """A first-order lag, exact over a tick; ``outside``: computed by a callback, which JAX cannot differentiate."""

    outside = False

    def init_params(self, rng=None, graph_state=None):
        return Params()

    def init_state(self, rng=None, graph_state=None):
        return Level(y=jnp.asarray(graph_state.params["world"].start, jnp.float32))

    def init_output(self, rng=None, graph_state=None):
        return graph_state.state["world"]

    def step(self, step_state):
        p, u = step_state.params, step_state.inputs["actuator"][-1].data.u
        steady = p.gain * (u + p.bias + p.square * u**2)
        if self.outside:
            shape = jax.ShapeDtypeStruct((), jnp.float32)
            y = jax.pure_callback(lagged, shape, step_state.state.y, steady, p.tau, vmap_method="broadcast_all")
        else:
            y = steady + (step_state.state.y - steady) * jnp.exp(-TICK_S / p.tau)
        return step_state.replace(state=Level(y=y)), Level(y=y)


def lagged(y, steady, tau):
    """Return the level a tick later, in numpy."""
    return (steady + (y - steady) * np.exp(-TICK_S / tau)).astype(np.float32)


class Sensor(BaseNode):
    """Passes the level on."""

    def init_output(self, rng=None, graph_state=None):
        return Level(y=jnp.float32(0.0))

    def step(self, step_state):
        return step_state, step_state.inputs["world"][-1].data


class Actuator(BaseNode):
    """Plays what was recorded."""

    def init_output(self, rng=None, graph_state=None):
        return Command(u=jnp.float32(0.0))


class Model:
    """What a pipeline provides."""

    world = Lag
    sensor = "sensor"
    ahead_s = 0.0
    given = {"actuator": Command(u="u")}  # noqa: RUF012
    channels = (Channel("y", None, position_sigma=NOISE, velocity_sigma=0.1),)
    parameters = ParameterTable(
        [
            Parameter("gain", "1", 1.5, 0.25, 4.0, leaf="world.gain"),
            Parameter("tau", "s", 0.1, 0.02, 0.5, leaf="world.tau"),
            Parameter("bias", "1", 0.0, -1.0, 1.0, "linear", leaf="world.bias", term="bias"),
            Parameter("square", "1", 0.0, -1.0, 1.0, "linear", leaf="world.square", term="square"),
            Parameter("offset", "1", 0.0, -1.0, 1.0, "linear", "measurement", free=False),
        ]
    )

    def nodes(self, max_delay_s):
        world, sensor, actuator = (
            self.world("world", 1 / TICK_S),
            Sensor("sensor", 1 / PERIOD_S),
            Actuator("actuator", 1 / PERIOD_S),
        )
        world.connect(actuator, skip=True)
        sensor.connect(world)
        return {n.name: n for n in (sensor, actuator, world)}

    def params(self, values, start):
        return self.parameters.placed({"world": replace(Params(), start=start[0])}, values)


def lag_log(seed, bias=BIAS):
    """A lag's log: commands hold from one sample to the next, and act from the sample on."""
    rng = np.random.default_rng(seed)
    count = round(DURATION_S / PERIOD_S)
    u = np.repeat(rng.uniform(-1, 1, count // 5), 5)
    y = np.zeros(count)
    for k in range(1, count):
        steady = GAIN * (u[k - 1] + bias)
        y[k] = steady + (y[k - 1] - steady) * np.exp(-PERIOD_S / TAU_S)
    slots = np.arange(count) * round(PERIOD_S * 1e6)
    none, late = np.zeros_like(slots), slots > 0

    def steps(start, end):
        return Steps(scheduled=slots, start=start, woken=start, ts_overwrite=none - 1, end=end, drift=none)

    return Episode(
        steps={"sensor": steps(slots, slots + 10), "actuator": steps(slots - 20 * late, slots - 5 * late)},
        messages={},
        outputs={"sensor": {"y": y + NOISE * rng.normal(size=count)}, "actuator": {"u": u}},
    )


def spans(recording):
    return [Span(recording, float(b)) for b in np.arange(0.4, DURATION_S - LENGTH_S - 0.3, LENGTH_S)]


CONFIG = FitConfig(max_delay_s=0.02, generations=0, initial_state="free")
TRUE = {"gain": GAIN, "tau": TAU_S, "bias": BIAS, "square": 0.0, "offset": 0.0}
