"""Nodes for the tests of AsyncGraph, and a way to draw random graphs of them."""

import threading
import time
import zlib

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sim2real.graph import Base, BaseNode, EmpiricalDist, Jitter, Scheduling

MASK = 2**32 - 1


@struct.dataclass
class Value(Base):
    x: jax.Array


def mix(a: int, b: int) -> int:
    """Mix two 32-bit integers: the order of the mixed values matters."""
    return ((a ^ (b & MASK)) * 16777619 + 12345) & MASK


class Plain(BaseNode):
    """Counts its steps in plain Python, sleeps a while in each, and notes everything that is called."""

    jittable = False

    def __init__(self, *args, busy=(0.0,), **kwargs):
        super().__init__(*args, **kwargs)
        self.busy = busy
        self.calls: list[str] = []
        self.seqs: list[int] = []
        self.threads: set[int] = set()

    def init_state(self, rng=None, graph_state=None):
        return np.int32(0)

    def init_output(self, rng=None, graph_state=None):
        return Value(x=np.int32(-1))

    def startup(self, graph_state, timeout=None):
        self.calls.append("startup")
        return True

    def stop(self, timeout=None):
        self.calls.append("stop")
        return True

    def step(self, step_state):
        self.seqs.append(int(step_state.seq))
        self.threads.add(threading.get_ident())
        seconds = self.busy[int(step_state.seq) % len(self.busy)]
        if seconds:
            time.sleep(seconds)
        return step_state.replace(state=step_state.state + 1), Value(x=step_state.seq)


class Jitted(Plain):
    """The same in JAX, without side effects."""

    jittable = True

    def step(self, step_state):
        return step_state.replace(state=step_state.state + 1), Value(x=step_state.seq)


class HashInPython(BaseNode):
    """Its state depends on everything that it was given: every slot of every window, in order."""

    jittable = False

    def init_state(self, rng=None, graph_state=None):
        return jnp.uint32(zlib.crc32(self.name.encode()))

    def init_output(self, rng=None, graph_state=None):
        return Value(x=jax.random.bits(rng, (), jnp.uint32))

    def step(self, step_state):
        acc = mix(int(step_state.state), int(step_state.seq))
        for name in sorted(step_state.inputs):
            window = step_state.inputs[name]
            for seq, x in zip(window.seq, window.data.x, strict=True):
                acc = mix(mix(acc, int(seq)), int(x))
        return step_state.replace(state=np.uint32(acc)), Value(x=np.uint32(mix(acc, 7)))


class HashInJax(HashInPython):
    jittable = True

    def step(self, step_state):
        def mixed(a, b):
            return (a ^ b.astype(jnp.uint32)) * jnp.uint32(16777619) + jnp.uint32(12345)

        acc = mixed(step_state.state, step_state.seq)
        for name in sorted(step_state.inputs):
            window = step_state.inputs[name]
            for i in range(window.seq.shape[0]):
                acc = mixed(mixed(acc, window.seq[i]), window.data.x[i])
        return step_state.replace(state=acc), Value(x=mixed(acc, jnp.uint32(7)))


def pair(cls=Plain, rate=100.0, **options):
    """Return a sensor and an agent that listen to each other; ``options`` are those of the agent's input."""
    sensor, agent = cls("sensor", rate), Plain("agent", rate)
    agent.connect(sensor, **options)
    sensor.connect(agent, skip=True)
    return sensor, agent


def random_graph(seed: int, make, delays_of) -> list[BaseNode]:
    """Return 3 to 5 nodes with random options; the last one is a fine supervisor.

    ``make(name, rate, **options)`` returns a node, ``delays_of(rng, rate)`` delays of messages and steps [s].
    """
    rng = np.random.default_rng(seed)
    nodes = []
    for i in range(int(rng.integers(3, 6))):
        rate = float(rng.choice([20, 30, 40, 50, 64, 100]))
        scheduling = [Scheduling.FREQUENCY, Scheduling.PHASE][int(rng.integers(2))]
        nodes.append(make(f"n{i}", rate, scheduling=scheduling, **delays_of(rng, rate)))
    for i, reader in enumerate(nodes):
        for j, sender in enumerate(nodes):
            if i == j or rng.random() < 0.45:
                continue
            reader.connect(
                sender,
                blocking=bool(rng.random() < 0.4),
                window=int(rng.integers(1, 4)),
                skip=j > i or bool(rng.random() < 0.2),
                jitter=[Jitter.LATEST, Jitter.BUFFER][int(rng.integers(2))],
                **delays_of(rng, sender.rate),
            )
        if any(c.blocking for c in reader.inputs.values()):
            reader.advance = bool(rng.random() < 0.5)
    return nodes


def jittery(rng: np.random.Generator, rate: float) -> dict:
    """Return delays that are often longer than expected, and sometimes longer than a period."""
    scale = rng.uniform(0.05, 0.5) / rate
    samples = rng.exponential(scale, 200).round(4)  # to 0.1 ms, so that ties happen
    return {"delay_dist": EmpiricalDist(samples, block=1), "delay": round(float(scale), 4)}
