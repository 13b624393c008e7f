"""Nodes for the tests of AsyncGraph, and a way to draw random graphs of them."""

import threading
import time

import numpy as np
from oracles.hash_nodes import Value

from sim2real.graph import BaseNode, EmpiricalDist, Jitter, Scheduling


class Plain(BaseNode):
    """Counts its steps in plain Python, is busy for a while in each, and notes everything that is called."""

    jittable = False
    clock = time
    """Whose ``sleep`` keeps a step busy."""

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
            self.clock.sleep(seconds)
        return step_state.replace(state=step_state.state + 1), Value(x=step_state.seq)


class Jitted(Plain):
    """The same in JAX, without side effects."""

    jittable = True

    def step(self, step_state):
        return step_state.replace(state=step_state.state + 1), Value(x=step_state.seq)


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
