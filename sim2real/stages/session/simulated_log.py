"""Simulates a log: the response of a robot's model to commands."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.episode import Episode, Steps, named_leaves
from sim2real.graph.node import to_ticks
from sim2real.graph.schedule import draw
from sim2real.graph.times import Vertex
from sim2real.identification.config import FitConfig
from sim2real.identification.model import IdentifiableModel
from sim2real.identification.rollouts import GraphOnC, choose_engine
from sim2real.robots.loop import ACTUATOR
from sim2real.robots.robot import Robot
from sim2real.runtime.compiled.open_loop import OpenLoopGraph


def simulate(
    model: IdentifiableModel,
    robot: Robot,
    signal: np.ndarray,
    values: Mapping[str, Any],
    config: FitConfig,
    seed: int = 0,
) -> Episode:
    """Return the simulated log of a signal.

    The robot starts at rest; a joint with a goal starts at its first goal.

    Args:
        robot: Gives the field and the rate of the command.
        signal: Shape ``(N, actions)``: one command for each step.
        config: Largest delay of the model, and the engine.
    """
    # Draw a timeline, and play the signal on it.
    nodes = model.nodes(config.max_delay_s)
    engine = choose_engine(config.engine, nodes, model.given)
    timeline = draw(nodes, len(signal) / robot.drive.rate_hz, rng=seed)
    commands, outputs = {}, {}
    for name in model.given:
        message = nodes[name].init_output(jax.random.key(0), None)
        count = timeline.vertices[name].start.shape[1]
        rows = {n: np.repeat(np.asarray(v)[None], count, axis=0) for n, v in named_leaves(message).items()}
        if name == ACTUATOR:
            played = signal[np.minimum(np.arange(count), len(signal) - 1)]
            rows[robot.drive.command] = played.reshape(rows[robot.drive.command].shape)
        leaves, kind = jax.tree_util.tree_flatten(message)
        commands[name] = kind.unflatten(
            [jnp.asarray(r[None], jnp.asarray(v).dtype) for r, v in zip(rows.values(), leaves, strict=True)]
        )
        outputs[name] = rows
    # Start at rest, joints with a goal at their first goal.
    graph = OpenLoopGraph(nodes, model.sensor, model.given)
    tables = jax.tree_util.tree_map(lambda rows: jnp.asarray(rows[0]), graph.tables(timeline, commands))
    messages = jax.tree_util.tree_map(lambda rows: rows[0], commands)
    rest = named_leaves(nodes[model.sensor].init_output(jax.random.key(0), None))
    driven = [i for i, c in enumerate(model.channels) if c.goal is not None]
    start = np.array([float(c.of(np.asarray(rest[c.position]))) for c in model.channels])
    start[driven] = [signal[0, model.channels[i].index or 0] for i in driven]
    params = model.params(values, jnp.asarray(np.concatenate([start, np.zeros_like(start)]), jnp.float32))
    # Assume that the first command also held before, as in segments of a log.
    gs = graph.begin(params, jax.tree_util.tree_map(lambda rows: rows[0], messages), 0)
    # Simulate by the configured engine.
    if engine.name == "c":
        on_c = GraphOnC(graph, engine.model)
        moved = on_c.step(jax.jit(lambda state: on_c.inputs(state, params, tables, messages))(gs))
        single = [jnp.asarray(a, jnp.float32) for a in moved]
        records = jax.jit(lambda state: on_c.outputs(state, single, tables, messages, model.sensor))(gs)
    else:
        records = jax.jit(lambda state: graph.run(state, tables, messages, model.sensor))(gs)
    # Return the simulation as an episode.
    count = int(timeline.vertices[model.sensor].count[0])
    outputs[model.sensor] = {n: np.asarray(v)[:count] for n, v in named_leaves(records).items()}
    early = {model.sensor: to_ticks(model.ahead_s)}  # the time that cutting into segments adds again
    steps = {n: _steps(timeline.vertices[n], len(next(iter(outputs[n].values()))), early.get(n, 0)) for n in outputs}
    return Episode(steps=steps, messages={}, outputs=outputs, metadata={})


def _steps(vertex: Vertex, count: int, early: int) -> Steps:
    """Return the steps of a node as in a log, ``early`` ticks earlier than drawn."""
    start, end = (np.maximum(times[0, :count] - early, 0) for times in (vertex.start, vertex.end))
    return Steps(start, start, start, np.full(count, -1), end, np.zeros(count, np.int64))
