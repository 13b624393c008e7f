"""Differences between the episodes of a training: parameters, noise, starts, pushes; as distributions to show."""

from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.episodes import Episodes, Varied
from sim2real.artifacts.identification import ROUND_TRIP, Identification, Noise
from sim2real.artifacts.timing import Timing
from sim2real.graph.node import TICKS_PER_S, BaseNode
from sim2real.robots.loop import DELAYS, LoopTask
from sim2real.robots.nodes import SimSensor
from sim2real.stages.terminal.console import note
from sim2real.stages.train.config import TrainConfig
from sim2real.training.environment.pushes import Pushes
from sim2real.training.environment.tasks import TrainingTask
from sim2real.training.environment.timelines import TimelineDraw
from sim2real.training.environment.variation import VariationConfig

_MAX_TIMES = 5000
"""Number of times that are kept for pictures."""
COUNT = 1024
"""Number of starts that are drawn to be shown, and the approximate number of pushes."""


def set_start(task: LoopTask, config: TrainConfig) -> None:
    """Give the task the configured offsets of an episode's start."""
    start = (config.vary.start_position, config.vary.start_velocity)
    if not any(start):
        return
    task.start = start
    jax.eval_shape(task.params, jax.random.key(0))


def set_noise(sensor: BaseNode, identification: Identification | None, config: TrainConfig) -> tuple[Noise, ...]:
    """Give the simulated sensor the noise of the log; return it.

    Readings that no log determines, such as the orientation of a robot in a stand, keep the robot's nominal noise. So
    do biases, which are constant in a log.
    """
    factor = config.vary.noise
    if identification is None or not identification.noise or not factor:
        return ()
    noise = tuple(
        replace(n, deviation=factor * n.deviation, quantum=factor * n.quantum, bias=factor * n.bias)
        for n in identification.noise
    )
    if not isinstance(sensor, SimSensor):
        note(f"readings are exact: {type(sensor).__name__} takes no noise, as sim2real.robots.nodes.SimSensor does")
        return ()
    nominal, logged = {n.column: n for n in sensor.noise}, {n.column for n in noise}
    biases = {column: factor * n.bias for column, n in nominal.items()}
    biased = [replace(n, bias=max(n.bias, biases.get(n.column, 0.0))) for n in noise]
    sensor.noise = (*biased, *(n for column, n in nominal.items() if column not in logged))
    return sensor.noise


def episodes_of(
    identification: Identification | None,
    values: Mapping[str, float],
    draws: Mapping[str, np.ndarray],
    noise: tuple[Noise, ...],
    drawn: TimelineDraw,
    timing: Timing | None,
    config: TrainConfig,
) -> Episodes:
    """Return the distributions of the episodes, with one row for the sum of the delays."""
    # A row for each drawn parameter, with its interval.
    estimates = {p.name: p for p in identification.parameters} if identification is not None else {}
    columns = {n: d for n, d in draws.items() if n not in DELAYS}
    rows = [
        Varied(n, p.unit, values[n], p.low95, p.high95, p.verdict == "not determined")
        if (p := estimates.get(n)) is not None
        else Varied(n, "", values[n])
        for n in columns
    ]
    if delays := [n for n in DELAYS if n in draws]:
        trip = estimates.get(ROUND_TRIP)
        columns[ROUND_TRIP] = np.sum([draws[n] for n in delays], axis=0)
        ends = (trip.low95, trip.high95) if trip is not None else (None, None)
        rows.append(Varied(ROUND_TRIP, "s", sum(values[n] for n in delays), *ends))

    # Computation times of each node, drawn and recorded.
    drawn_s = {
        n: ((v.end - v.start)[np.arange(v.start.shape[1]) < v.count[:, None]] / TICKS_PER_S)
        for n, v in drawn.timeline.vertices.items()
    }
    recorded_s = {} if identification is None or timing is None else timing.steps_s
    widens = config.vary.misfit and not config.vary.uniform
    return Episodes(
        parameters=tuple(rows),
        widening=(identification.widening if identification and widens else None) or 1.0,
        noise=noise,
        timelines=config.timelines,
        cut=drawn.cut,
        again=drawn.redrawn,
        longest_pause_s=drawn.longest_pause_s,
        draws={n: np.asarray(d, np.float64) for n, d in columns.items()},
        recorded_s={n: np.asarray(s, np.float64)[:_MAX_TIMES] for n, s in recorded_s.items()},
        drawn_s={n: np.asarray(s, np.float64)[:_MAX_TIMES] for n, s in drawn_s.items() if n in recorded_s},
        off=_deviations(identification, noise),
    )


def _deviations(identification: Identification | None, noise: tuple[Noise, ...]) -> dict[str, np.ndarray]:
    """Return the measurements minus the predictions of the identified model, for columns with predictions."""
    deviations = {}
    for n in noise:
        measured, model = f"{n.column}_measured", f"{n.column}_identified"
        if identification is not None and {measured, model} <= set(identification.samples):
            values = np.asarray(identification.samples[measured] - identification.samples[model], np.float64)
            deviations[n.column] = values[np.isfinite(values)][:_MAX_TIMES]
    return deviations


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
        kicks = pushes.kicks(k_push, (round(COUNT / pushes.chance), len(pushes.sizes)), last)
        added |= {name: (unit, hit[hit != 0.0]) for name, unit, hit in pushes.named(kicks) if hit.any()}
    return replace(
        episodes,
        noise=tuple(replace(n, deviation=share * n.deviation, bias=share * n.bias) for n in episodes.noise),
        parameters=(*episodes.parameters, *(Varied(name, unit, 0.0) for name, (unit, _) in added.items())),
        draws={**draws, **{name: np.ravel(np.asarray(values, np.float64)) for name, (_, values) in added.items()}},
        push_hz=vary.push_hz if pushes is not None else 0.0,
        curriculum=vary.curriculum,
        follow=vary.follow,
    )
