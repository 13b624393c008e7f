"""Hash nodes, whose output reveals any wrong message in their inputs, and random graphs of them."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.delays import EmpiricalDist, TrainableDist
from sim2real.graph.node import BaseNode, BaseWorld, Jitter, Scheduling
from sim2real.types import PyTree

if TYPE_CHECKING:
    from jax.typing import ArrayLike

_BURST = 8
"""Extra messages in the windows of trainable delays: senders with hiccups send in bursts."""
_PRIME, _OFFSET, _MASK = 16777619, 12345, 2**32 - 1


@struct.dataclass
class Value(Base):
    """A message with one number."""

    x: PyTree


def mix(a: int, b: int) -> int:
    """Return a 32-bit hash of two 32-bit integers; it depends on their order."""
    return ((a ^ (b & _MASK)) * _PRIME + _OFFSET) & _MASK


DTYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "bool", "float32", "float16")
"""Dtypes of the messages of hash nodes in a random graph."""


def as_message(out: int, dtype: str) -> int:
    """Return the number in a hash node's message for its output; every dtype holds it exactly."""
    if dtype == "bool":
        return out & 1
    if dtype.startswith("float"):
        return out & 0x3FF
    bits = 8 * np.dtype(dtype).itemsize
    low = out & (2**bits - 1)
    return low - 2**bits if dtype.startswith("int") and low >> (bits - 1) else low


def hash_step(state: int, seq: int, windows: list[tuple[list[int], list[int]]]) -> tuple[int, int]:
    """Return state and output after a step of a hash node.

    Args:
        windows: For each input, in the order of their names: seq and value of each message, oldest first.
    """
    acc = mix(state, seq)
    for seqs, values in windows:
        for s, x in zip(seqs, values, strict=True):
            acc = mix(mix(acc, s), x)
    return acc, mix(acc, 7)


class HashInPython(BaseNode):
    """A hash node in Python: its state is a hash of every entry of every window of all its steps.

    Attributes:
        dtype: Dtype of its messages, one of ``DTYPES``.
    """

    jittable = False
    dtype = "uint32"

    def init_state(self, rng: PyTree = None, graph_state: GraphState | None = None) -> PyTree:
        """Return a hash of the node's name."""
        del rng, graph_state
        return jnp.uint32(zlib.crc32(self.name.encode()))

    def init_output(self, rng: PyTree = None, graph_state: GraphState | None = None) -> Value:
        """Return a random number; all readers must get the same number."""
        del graph_state
        return Value(x=self._message(jax.random.bits(rng, (), jnp.uint32)))

    def step(self, step_state: StepState) -> tuple[StepState, Value]:
        """Mix everything into the state."""
        windows = [
            ([int(s) for s in np.asarray(w.seq)], [int(x) for x in np.asarray(w.data.x)])
            for _, w in sorted(step_state.inputs.items())
        ]
        acc, out = hash_step(int(step_state.state), int(step_state.seq), windows)
        return step_state.replace(state=np.uint32(acc)), Value(x=np.asarray(as_message(out, self.dtype), self.dtype))

    def _message(self, out: jax.Array) -> jax.Array:
        """Return ``as_message`` in JAX."""
        if self.dtype == "bool":
            return (out & 1).astype(bool)
        return (out & 0x3FF).astype(self.dtype) if self.dtype.startswith("float") else out.astype(self.dtype)


class HashInJax(HashInPython):
    """A hash node in JAX; same numbers as ``HashInPython``."""

    jittable = True

    def step(self, step_state: StepState) -> tuple[StepState, Value]:
        """Mix everything into the state."""

        def mixed(a: jax.Array, b: ArrayLike) -> jax.Array:
            b = jnp.asarray(b)
            whole = b.astype(jnp.int32) if jnp.issubdtype(b.dtype, jnp.floating) else b
            return (a ^ whole.astype(jnp.uint32)) * jnp.uint32(_PRIME) + jnp.uint32(_OFFSET)

        acc = mixed(jnp.asarray(step_state.state), step_state.seq)
        for name in sorted(step_state.inputs):
            window = step_state.inputs[name]
            for i in range(window.seq.shape[0]):
                acc = mixed(mixed(acc, window.seq[i]), window.data.x[i])
        return step_state.replace(state=acc), Value(x=self._message(mixed(acc, jnp.uint32(7))))


class HashWorldInPython(HashInPython, BaseWorld):
    """A hash node on a world's grid."""


class HashWorldInJax(HashInJax, BaseWorld):
    """A hash node on a world's grid, in JAX."""


class MakeNode(Protocol):
    """Makes a node, or a world, of a random graph."""

    def __call__(self, name: str, rate: float, world: bool, **options: PyTree) -> BaseNode:
        """Return the node.

        Args:
            rate: Steps per second [Hz].
            **options: Options of ``BaseNode``; none for a world.
        """
        ...


def hash_node(name: str, rate: float, world: bool, **options: PyTree) -> BaseNode:
    """Return a hash node in plain Python.

    Args:
        rate: Steps per second [Hz].
        **options: Options of ``BaseNode``; not used by a world.
    """
    return HashWorldInPython(name, rate) if world else HashInPython(name, rate, **options)


def jax_hash_node(name: str, rate: float, world: bool, **options: PyTree) -> BaseNode:
    """Return a hash node in JAX.

    Args:
        rate: Steps per second [Hz].
        **options: Options of ``BaseNode``; not used by a world.
    """
    return HashWorldInJax(name, rate) if world else HashInJax(name, rate, **options)


def random_graph(
    seed: int, size: int | None = None, worlds: int | None = None, make: MakeNode = hash_node, trainable: bool = False
) -> dict[str, BaseNode]:
    """Return nodes by name with random rates, delays and connections; the first one can be the supervisor.

    Delays are multiples of 0.1 ms and often equal to the expected ones, so ties occur; some are several periods long,
    so steps overrun and messages come in bursts. All options of connections occur; loops have a skipped connection.

    Args:
        size: Number of nodes that are not worlds, 1 to 6; default: random.
        worlds: Number of worlds, 0 to 2; default: random.
        trainable: Whether some connections have a trainable delay, and hash nodes messages of random dtypes.
    """
    rng = np.random.default_rng(seed)
    size = int(rng.integers(2, 5)) if size is None else size
    worlds = int(rng.choice([0, 1, 1, 2])) if worlds is None else worlds
    nodes = []
    # Draw the nodes, then the connections; those against the order of nodes are skipped.
    for i in range(size):
        rate = float(rng.choice([20, 30, 40, 50, 64, 100]))
        scheduling = [Scheduling.FREQUENCY, Scheduling.PHASE][int(rng.integers(2))]
        nodes.append(make(f"n{i}", rate, False, scheduling=scheduling, **_delays(rng, rate, at_least=1e-4)))
    nodes += [make(f"world{i}", float(rng.choice([50, 100, 125])), True) for i in range(worlds)]
    for i, reader in enumerate(nodes):
        for j, sender in enumerate(nodes):
            if i != j and rng.random() < 0.55:
                connect_at_random(rng, reader, sender, skip=j > i)
        if any(c.blocking for c in reader.inputs.values()):
            reader.advance = bool(rng.random() < 0.4)
    # Make some delays trainable.
    if trainable:
        for sender in nodes:
            if isinstance(sender, HashInPython):
                sender.dtype = DTYPES[int(rng.integers(len(DTYPES)))]
        for reader in nodes:
            _make_trainable(rng, reader)
    return {n.name: n for n in nodes}


def _make_trainable(rng: np.random.Generator, reader: BaseNode) -> None:
    """Give most of a reader's connections that may have one a trainable delay, in whole milliseconds.

    Floats of hash nodes are only read without interpolation: the hash of a number that is rounded differs from runtime
    to runtime.
    """
    for connection in reader.inputs.values():
        sender = connection.output_node
        free = not connection.blocking and connection.jitter is Jitter.LATEST
        if not free or rng.random() < 0.2:
            continue
        kinds = ["zoh"] if getattr(sender, "dtype", "").startswith("float") else ["zoh", "linear"]
        low = int(rng.integers(0, 5))
        high = low + int(rng.integers(1, 40))
        delay = int(rng.integers(low, high + 1))
        interp = str(rng.choice(kinds))
        connection.delay_dist = TrainableDist.create(delay / 1000, low / 1000, high / 1000, interp, burst=_BURST)


def connect_at_random(rng: np.random.Generator, reader: BaseNode, sender: BaseNode, skip: bool) -> None:
    """Connect two nodes with random options, sometimes twice.

    Args:
        reader: The node that reads; if it is a world, its inputs do not block.
        skip: True: the connection is skipped; False: it may be.
    """
    for name in (None, f"{sender.name} again")[: 2 if rng.random() < 0.15 else 1]:
        reader.connect(
            sender,
            blocking=not isinstance(reader, BaseWorld) and bool(rng.random() < 0.4),
            window=int(rng.integers(1, 4)),
            skip=skip or bool(rng.random() < 0.2),
            jitter=[Jitter.LATEST, Jitter.BUFFER][int(rng.random() < 0.3)],
            name=name,
            **_delays(rng, sender.rate, at_least=0.0),
        )


def _delays(rng: np.random.Generator, rate: float, at_least: float) -> dict[str, PyTree]:
    """Return delay options: constant, or random, or random with hiccups of several periods."""
    kind = rng.random()
    scale = float(rng.uniform(0.05, 0.4)) / rate
    if kind < 0.35:
        fixed = max(at_least, round(scale, 4))
        return {"delay_dist": fixed}
    samples = rng.exponential(scale, 200)
    if kind > 0.8:
        samples[rng.random(200) < 0.05] += float(rng.uniform(1.0, 4.0)) / rate
    samples = np.maximum(samples.round(4), at_least)
    return {"delay_dist": EmpiricalDist(samples, block=int(rng.integers(1, 4))), "delay": round(scale, 4)}
