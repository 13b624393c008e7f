"""Replay of a deployment: its commands drive the models of its robot, and its log tests the parameters."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.deployment import AS_HERE, Drift, Replay
from sim2real.artifacts.identification import UNFINISHED, Identification, Noise
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.identify.drift import drift_test
from sim2real.identify.expected import expected_at
from sim2real.identify.problem.problem import Problem
from sim2real.identify.search.refine import refine
from sim2real.identify.validation import prediction
from sim2real.identify.validation.verdict import positions
from sim2real.robots.worlds import in_world
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.replay_problem import longest_delay_s, problem_of_logs
from sim2real.stages.pipeline.pipeline import Pipeline

_REPETITIONS = 16
"""Measurements with noise, from which the errors of an unchanged robot follow."""
_NOISE = 2.0
"""Errors below this many deviations of the measurement count as noise."""


def tested(
    pipeline: Pipeline, identification: Identification, episodes: Sequence[Episode]
) -> tuple[list[Replay], Drift]:
    """Replay recorded commands on the identified and the nominal model, and test the parameters.

    The measurements are compared with those of the simulated sensor, with its delay, at the log's times.

    Raises:
        Sim2RealError: When the logs are too short, or the identification does not fit the robot.
    """
    robot = held_out_parts.having(
        in_world(pipeline.load(), identification.world), [p.name for p in identification.parameters]
    )
    longest_s = longest_delay_s(robot, identification, pipeline.identify.max_delay_s)
    config = replace(pipeline.identify, settle_s=identification.settle_s, max_delay_s=longest_s)
    # Cut the logs into segments.
    problem, ahead_s = problem_of_logs(robot, identification, episodes, config)
    if identification.posterior is None:
        ended = UNFINISHED.get(identification.verdict.status, "has no intervals")
        raise Sim2RealError(
            f"this identification {ended}: its estimates may be far off", hint=identification.verdict.next or None
        )
    # Test each parameter, and fit all of them to this log.
    drifted, x = drift_test.drift(problem, identification.posterior, identification.widening or 1.0, robot.causes)
    z = refine(problem, problem.table.at_scale(x)[None], settle=False).z
    refitted = {n: float(np.ravel(v)[0]) for n, v in problem.table.decode(z).items()}
    nominal = {p.name: p.nominal for p in problem.model.parameters}
    # Predict the segments with each model.
    models = {
        "identified": {n: identification.values.get(n, v) for n, v in nominal.items()},
        AS_HERE: refitted,
        "nominal": nominal,
    }
    all_segments = np.ones(problem.segments, bool)
    columns = prediction.samples(problem, models, config.settle_s, all_segments)
    errors = prediction.errors(problem, columns, list(models), config.settle_s, [ahead_s])
    # Predict the model's own motion from readings with noise: the errors of a robot that has not changed.
    alike = _of_noise(problem, columns, identification.noise, models["identified"], config.settle_s, ahead_s)
    # Compare the errors with those on the identification's held-out data.
    held_out, held = (_held_out(identification, model, ahead_s) for model in ("identified", "hold"))
    rows = []
    for position in positions(problem.model, robot.units):
        rmse = {e.model: e.rmse.get(position.column) for e in errors if e.held_out}
        rmse = {m: e if e is not None and math.isfinite(e) else None for m, e in rmse.items()}
        promise, moved, now = held_out.get(position.column), held.get(position.column), rmse.get("hold")
        if promise is not None:  # a model's error grows with the motion
            promise = expected_at(identification, position.column, promise)
            promise = max(promise, _NOISE * position.sigma) * max(1.0, now / moved if now and moved else 1.0)
            promise = math.hypot(promise, alike.get(position.column, 0.0))
            # A model that diverges on its own motion bounds nothing.
            promise = promise if math.isfinite(promise) else None
        free = _free_run(identification, position.column)
        rows.append(Replay(position.name, position.unit, ahead_s, rmse, promise, position.column, free))
    return rows, drifted


def _of_noise(
    problem: Problem,
    columns: Mapping[str, np.ndarray],
    noise: Sequence[Noise],
    values: Mapping[str, float],
    settle_s: float,
    ahead_s: float,
) -> dict[str, float]:
    """Return the error below which 95 % of the predictions of the model's own motion stay: column -> error.

    Their measurements are the predictions with noise. Beside an unstable equilibrium, as of a balanced pendulum, the
    errors of an initial state grow so fast that the best model has them.

    Args:
        columns: Predictions of the model ``identified``, as ``prediction.samples`` returns them.
        values: Its parameters.
    """
    rng, at, every = np.random.default_rng(0), np.nonzero(problem.ts >= 0), np.ones(problem.segments, bool)
    fields = {n.column: n for n in noise if f"{n.column}_identified" in columns}
    rows: dict[str, list[float]] = {column: [] for column in fields}
    for _ in range(_REPETITIONS):
        measured = {f: np.array(values) for f, values in problem.readings.items()}
        for column, n in fields.items():
            name, index = n.place
            reading = columns[f"{column}_identified"] + n.deviation * rng.normal(size=len(at[0]))
            reading = n.quantum * np.round(reading / n.quantum) if n.quantum else reading
            measured[name][at if index is None else (*at, index)] = reading
        noisy = problem.with_readings(measured)
        predicted = prediction.samples(noisy, {"identified": values}, settle_s, every)
        errors = prediction.errors(noisy, predicted, ["identified"], settle_s, [ahead_s])
        rmse = next(e.rmse for e in errors if e.held_out and e.model == "identified")
        for column in fields:
            error = rmse.get(column)
            rows[column].append(error if error is not None and math.isfinite(error) else math.inf)
    return {column: float(np.quantile(errors, 0.95, method="higher")) for column, errors in rows.items()}


def _held_out(identification: Identification, model: str, ahead_s: float) -> Mapping[str, float]:
    """Return the error of a model on the identification's held-out data: field -> error."""
    rows = [p for p in identification.prediction if p.model == model and p.held_out and p.horizon_s == ahead_s]
    return {n: e for row in rows for n, e in row.rmse.items() if e is not None}


def _free_run(identification: Identification, column: str) -> float | None:
    """Return the mean error of the identified model in free runs on held-out data; None if it is unknown."""
    rows = [r.rmse for r in identification.free_run if r.model == "identified" and r.held_out and r.field == column]
    errors = [e for e in rows if e is not None]
    return float(np.mean(errors)) if errors and len(errors) == len(rows) else None
