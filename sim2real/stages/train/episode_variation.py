"""What pushes and starts do to the episodes of a training, shown beside the parameters."""

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

SHOWN = 1024
"""How many episodes' starts are drawn to be shown, and about how many pushes."""


def with_disturbances(
    episodes: Episodes, vary: VariationConfig, task: TrainingTask, pushes: Pushes | None, seed: int
) -> Episodes:
    """Return what episodes are drawn from, with pushes and starts as training draws them, as wide as at its end.

    Args:
        task: The task, which draws starts.
        pushes: What draws pushes; None: there are none.
    """
    share = vary.curriculum[1]
    last = jnp.float32(share) if vary.grows else None
    k_push, k_start = jax.random.split(jax.random.key(seed))
    drawn = {p.name: p.value + share * (episodes.draws[p.name] - p.value) for p in episodes.parameters}
    more: dict[str, tuple[str, jax.Array]] = {}
    if isinstance(task, LoopTask) and any(task.start):
        offsets = jax.vmap(lambda key: task.offsets(key, last))(jax.random.split(k_start, SHOWN))
        for name, unit, values in zip(("position", "velocity"), ("rad", "rad/s"), offsets, strict=True):
            more |= {f"start {name}": (unit, values)} if values.any() else {}
    if pushes is not None:
        kicks = pushes.kicks(k_push, (round(SHOWN / pushes.chance),), last)
        more["push"] = ("rad/s", kicks[kicks != 0.0])
    return replace(
        episodes,
        noise=tuple(replace(n, deviation=share * n.deviation, bias=share * n.bias) for n in episodes.noise),
        parameters=(*episodes.parameters, *(Varied(name, unit, 0.0) for name, (unit, _) in more.items())),
        draws={**drawn, **{name: np.ravel(np.asarray(values, np.float64)) for name, (_, values) in more.items()}},
        push_hz=vary.push_hz if pushes is not None else 0.0,
        curriculum=vary.curriculum,
    )
