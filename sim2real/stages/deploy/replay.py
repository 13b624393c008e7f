"""Replay of a deployment: predicts its motion from its commands, and tests whether parameters have changed."""

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.deployment import AS_HERE, Drift
from sim2real.artifacts.identification import STANDING_STILL, ComparedError, Identification, Noise
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.identification import drift as drift_test
from sim2real.identification import predictions as prediction
from sim2real.identification.expected import expected_at
from sim2real.identification.fit import refine
from sim2real.identification.held_out import MOVES
from sim2real.identification.model import ChecksLogs, IdentifiableModel
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.predictions import NOISE, Position, positions
from sim2real.identification.residuals import Problem
from sim2real.robots.robot import RecordedRobot, watched
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.shared.identification import identified_robot, side_by_side

_REPETITIONS = 16
"""Number of simulated noisy measurements, which give the errors of an unchanged robot."""
_SEGMENT_S = 0.4
"""Shortest segment [s]. Errors of a balanced pendulum grow tenfold in 0.2 s, so long segments do not separate
models."""
_MARGIN = 1.25
"""Factor from the expected error of held-out parts to that of a deployment, as a policy moves differently. Without it,
the error of an unchanged pendulum was 6 % too large, even with the parameters of its own log.
"""
_LEAST, _LEAST_S = 4, 5.0
"""Fewest segments with motion for a test, and the shortest length of all logs [s]."""


def tested(
    robot: RecordedRobot, identification: Identification, episodes: Sequence[Episode]
) -> tuple[list[ComparedError], Drift]:
    """Replay recorded commands on the identified and the nominal model, and test the parameters.

    The measurements are compared with the simulated sensor's, which are delayed, at the log's times.

    Raises:
        Sim2RealError: The logs are too short, or the identification does not fit the robot.
    """
    robot, config = identified_robot(identification, robot)
    problem, ahead_s = _problem(robot, identification, episodes, config)
    posterior = identification.needed_posterior()
    # Test each parameter for a change, and fit all of them to this log.
    drifted, x = drift_test.drift(problem, posterior, posterior.widening)
    z = refine(problem, problem.table.within(x)[None], gain=problem.precision).x
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
    measured = positions(problem.model, robot.units)
    errors = prediction.errors(columns, list(models), measured, config.settle_s, ahead_s)
    # Predict simulated motion from noisy readings: such errors occur even if the robot has not changed.
    noise = identification.noise
    alike = _of_noise(problem, measured, columns, noise, models["identified"], config.settle_s, ahead_s)
    # Compare the errors with those on the identification's held-out parts.
    held_out, held = (_held_out(identification, model, ahead_s) for model in ("identified", STANDING_STILL))
    rows = []
    sigmas = {position.name: position.sigma for position in measured}
    for row in errors:
        expected, moved, now = held_out.get(row.joint), held.get(row.joint), row.baselines.get(STANDING_STILL)
        if expected is not None:  # a model's error grows with the motion
            expected = expected_at(identification, row.joint, expected)
            expected = max(expected, NOISE * sigmas[row.joint]) * max(1.0, now / moved if now and moved else 1.0)
            expected = _MARGIN * math.hypot(expected, alike.get(row.joint, 0.0))
            # If predictions of simulated motion diverge, there is no bound.
            expected = expected if math.isfinite(expected) else None
        rows.append(replace(row, log="this deployment", expected=expected, as_good=()))
    return rows, drifted


def _problem(
    robot: RecordedRobot, identification: Identification, episodes: Sequence[Episode], config: IdentifyConfig
) -> tuple[Problem, float]:
    """Return later logs in short segments, with the identified parameters, and the horizon of the predictions [s].

    Raises:
        Sim2RealError: The logs are too short, or of another motion.
    """
    model = watched(robot, config.max_delay_s)
    if isinstance(model, ChecksLogs):
        for episode in episodes:
            model.check(episode)
    # Choose the length of segments and the horizon.
    horizons = sorted({row.seconds for row in identification.errors if not row.log})
    length_s = max(_SEGMENT_S, config.settle_s + (horizons[0] if horizons else 0.0))
    ahead_s = max([h for h in horizons if config.settle_s + h <= length_s + 1e-9], default=length_s - config.settle_s)

    # Cut the logs; parts without motion are dropped.
    spans = side_by_side(episodes, config, [length_s] * len(episodes))
    spans = [s for s in spans if _moves(model, episodes[s.recording], s.begin_s, length_s)]
    seconds = sum(e.duration_s for e in episodes)
    if len(spans) < _LEAST or seconds < _LEAST_S:
        moving = f", {length_s * len(spans):.1f} s of them in motion,"
        raise Sim2RealError(f"{seconds:.1f} s of deployment{moving} are too little to test the model on")

    # Free the parameters that may have changed since the identification.
    identified = {p.name for p in robot.identifiable(config.max_delay_s).parameters if p.free}
    changeable = {p.name for p in model.parameters if p.free} - identified
    table = _table(model.parameters, identification, changeable)
    return Problem(model, list(episodes), spans, length_s, config, table), ahead_s


def _table(parameters: ParameterTable, identification: Identification, watched: Container[str] = ()) -> ParameterTable:
    """Return parameters with the identified terms, fixed values, and bounds at least as wide as in the search.

    Args:
        watched: Names of parameters that are free although they were fixed, such as a payload.
    """
    terms = {p.term for p in parameters if p.term and (p.free or p.term in (identification.used_terms or ()))}
    names = {p.name for p in parameters}
    fixed = {p.name: p.estimate for p in identification.parameters if p.state == "fixed" and p.name in names}
    table = parameters.with_terms(terms).with_nominal(fixed)
    table = table.with_fixed({n: v for n, v in fixed.items() if n not in watched})
    free = {p.name for p in table if p.free}
    wider = {
        p.name: (min(p.lower, table[p.name].low), max(p.upper, table[p.name].high))
        for p in identification.parameters
        if p.name in free and p.kind != "delay" and p.lower is not None and p.upper is not None
    }
    return table.with_bounds(wider)


def _moves(model: IdentifiableModel, episode: Episode, begin_s: float, length_s: float) -> bool:
    """Return whether any joint moves in a part of a log [s].

    Segments without motion do not count: they tell nothing, and in a model with smooth friction a sticking joint
    creeps.
    """
    t = episode.steps[model.sensor].begun_s
    inside = (t >= begin_s) & (t <= begin_s + length_s)
    read = episode.outputs[model.sensor]
    return any(
        inside.any() and float(np.ptp(c.of(read[c.position][inside]))) > MOVES * c.position_sigma
        for c in model.channels
    )


def _of_noise(
    problem: Problem,
    measured: Sequence[Position],
    columns: Mapping[str, np.ndarray],
    noise: Sequence[Noise],
    values: Mapping[str, float],
    settle_s: float,
    ahead_s: float,
) -> dict[str, float]:
    """Return joint -> the error below which 95 % of the predictions of simulated motion stay.

    The simulated measurements are predictions plus noise. Near an unstable equilibrium, as of a balanced pendulum,
    errors of an initial state grow so fast that even the best model has large errors.

    Args:
        columns: Predictions of the model ``identified``; see ``predictions.samples``.
        values: Parameters of this model.
    """
    rng, at, every = np.random.default_rng(0), np.nonzero(problem.ts >= 0), np.ones(problem.segments, bool)
    fields = {n.field: n for n in noise if f"{n.field}_identified" in columns}
    joints = [p.name for p in measured if p.column in fields]
    rows: dict[str, list[float]] = {joint: [] for joint in joints}
    for _ in range(_REPETITIONS):
        readings = {f: np.array(values) for f, values in problem.readings.items()}
        for field, n in fields.items():
            name, index = n.place
            reading = columns[f"{field}_identified"] + n.deviation * rng.normal(size=len(at[0]))
            reading = n.resolution * np.round(reading / n.resolution) if n.resolution else reading
            readings[name][at if index is None else (*at, index)] = reading
        noisy = problem.with_readings(readings)
        predicted = prediction.samples(noisy, {"identified": values}, settle_s, every)
        errors = prediction.errors(predicted, ["identified"], measured, settle_s, ahead_s)
        sizes = {e.joint: e.error for e in errors if e.error is not None}
        for joint in joints:
            rows[joint].append(sizes.get(joint, math.inf))
    return {joint: float(np.quantile(errors, 0.95, method="higher")) for joint, errors in rows.items()}


def _held_out(identification: Identification, model: str, ahead_s: float) -> Mapping[str, float]:
    """Return joint -> error of a model on the identification's held-out parts."""
    rows = [row for row in identification.errors if not row.log and row.seconds == ahead_s]
    errors = {row.joint: row.error if model == "identified" else row.baselines.get(model) for row in rows}
    return {joint: error for joint, error in errors.items() if error is not None}
