"""Pushes and starts of a training's episodes, shown beside the parameters."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.episodes import Episodes, Varied
from sim2real.robots.control_loop.training_task import LoopTask
from sim2real.train.environment.graph_environment import TrainingTask
from sim2real.train.environment.pushes import Pushes
from sim2real.train.environment.variation import VariationConfig

COUNT = 1024
"""Number of starts that are drawn to be shown, and the approximate number of pushes."""


def with_disturbances(
    episodes: Episodes, vary: VariationConfig, task: TrainingTask, pushes: Pushes | None, seed: int
) -> Episodes:
    """Return the episodes' distributions with pushes and starts, at the end of the curriculum."""
    # Scale parameters by the curriculum's last share.
    share = vary.curriculum[1]
    last = jnp.float32(share) if vary.grows else None
    k_push, k_start = jax.random.split(jax.random.key(seed))
    draws = {p.name: p.value + share * (episodes.draws[p.name] - p.value) for p in episodes.parameters}

    # Draw starts and pushes as training does.
    added: dict[str, tuple[str, jax.Array]] = {}
    if isinstance(task, LoopTask) and any(task.start):
        offsets = jax.vmap(lambda key: task.offsets(key, last))(jax.random.split(k_start, COUNT))
        for name, unit, values in zip(("position", "velocity"), ("rad", "rad/s"), offsets, strict=True):
            added |= {f"start {name}": (unit, values)} if values.any() else {}
    if pushes is not None:
        kicks = pushes.kicks(k_push, (round(COUNT / pushes.chance),), last)
        added["push"] = ("rad/s", kicks[kicks != 0.0])
    return replace(
        episodes,
        noise=tuple(replace(n, deviation=share * n.deviation, bias=share * n.bias) for n in episodes.noise),
        parameters=(*episodes.parameters, *(Varied(name, unit, 0.0) for name, (unit, _) in added.items())),
        draws={**draws, **{name: np.ravel(np.asarray(values, np.float64)) for name, (_, values) in added.items()}},
        push_hz=vary.push_hz if pushes is not None else 0.0,
        curriculum=vary.curriculum,
    )
