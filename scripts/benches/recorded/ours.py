"""Our identification of recordings: with the settings of a pipeline, or those of ``new`` for a robot from a model."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benches.recorded.sets import BEFORE, Fold, Recording, load
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identification import predictions as prediction
from sim2real.identification.fit import Fit as ModelFit
from sim2real.identification.fit import as_numbers
from sim2real.identification.fit import fit as fit_model
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.identify import fitting
from sim2real.stages.load import load_robot
from sim2real.stages.shared import from_model
from sim2real.stages.shared import identification as shared
from sim2real.stages.shared.arguments import open_recording
from sim2real.stages.shared.robot_flags import RobotFlags

SETTLE_S = 0.3
"""Length of the samples from which the initial state of the disk's free run is estimated [s]."""
Columns = Mapping[str, np.ndarray]
"""Samples of free runs: ``recording``, ``ahead`` [s], and of each field the measured and the predicted values."""


@dataclass(frozen=True)
class Case:
    """A robot that is judged, with the settings of its identification."""

    name: str
    config: IdentifyConfig
    robot: Any
    model: Any

    @property
    def fields(self) -> list[str]:
        """The columns of positions."""
        return [c.position if c.index is None else f"{c.position}[{c.index}]" for c in self.model.channels]


Predict = Callable[[Sequence[Recording]], list[np.ndarray]]
Fit = tuple[Predict, str]
"""Predictor and summary."""
SETS = {"disk": "disk", "xl330": "xl330", "so101": "so101_log"}
"""Sets with a pipeline of ours, and its name."""
CHOOSES = ("sts3250", "emps")
"""Sets with `--terms auto`; for a quadruped's twelve joints that takes 15 min."""
COLUMNS = ("q_rad", "q_goal_rad"), ("q_m", "force_n")
"""Names of columns of positions and commands that an import understands, of hinges and of a slide that forces push."""
ARM = """<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="arm">
      <joint name="servo" axis="0 1 0" damping="1" armature="0.02" frictionloss="0.2"/>
      <inertial pos="0 0 -{length}" mass="{mass}" diaginertia="1e-4 1e-4 1e-4"/>
    </body>
  </worldbody>
</mujoco>
"""
"""The model that docs/guides/any_robot.md gives for a servo with a mass on an arm."""


def identify(case: Case, fitted: Mapping[str, Episode]) -> ModelFit:
    """Fit with the settings of the case."""
    c, episodes = case.config, list(fitted.values())
    longer = windows(episodes, c.long_s, 0.0, c.initial_state == "free") if c.long_s else []
    length = c.settle_s + c.horizon_s
    spans = windows(episodes, length, c.spacing_s, c.initial_state == "free")
    return fit_model(Problem(case.model, episodes, spans, length, c), longer)


def windows(episodes: Sequence[Episode], length_s: float, spacing_s: float, estimated: bool) -> list[Span]:
    """Return the segments of all recordings; 0.3 s at both ends stay free where initial states are estimated."""
    edge = 0.3 if estimated else 0.0
    step = spacing_s or length_s
    begins = [np.arange(edge, e.duration_s - length_s - edge, step) for e in episodes]
    return [Span(r, float(b)) for r, times in enumerate(begins) for b in times]


def predict_whole(case: Case, models: Mapping[str, Any], test: Mapping[str, Episode]) -> Columns:
    """Return columns of one free run over each whole test recording."""
    episodes = list(test.values())
    if case.name == "disk":  # The initial state is estimated from the samples before the part.
        begin, settle, config = BEFORE * 0.025 - SETTLE_S, SETTLE_S, case.config
    else:
        begin, settle, config = 0.0, 0.0, replace(case.config, initial_state="rest")
    length = max(e.duration_s for e in episodes) - begin
    problem = Problem(case.model, episodes, [Span(r, begin, False) for r in range(len(episodes))], length, config)
    columns = prediction.samples(problem, models, settle)
    return columns | {"ahead": columns["into"] - settle}


def fit(name: str, fold: Fold, seed: int) -> Fit:
    """Identify with our own settings, without a limit of time.

    Args:
        fold: If the set has a pipeline, its recordings are read again, as logs.
    """
    return _fit_pipeline(name, fold, seed) if name in SETS else _fit_described(name, fold, seed)


def _fit_pipeline(name: str, fold: Fold, seed: int) -> Fit:
    pipeline, robot = SETS[name], load_robot(SETS[name])
    config = replace(robot.defaults.identify, seed=seed)
    case = Case(pipeline, config, robot, robot.identifiable(config.max_delay_s))
    assert fold.logs
    identified, judged = identify(case, load(pipeline, fold.logs[0])), fold.logs[1]

    def predict(test_recordings: Sequence[Recording]) -> list[np.ndarray]:
        test = load(pipeline, judged)
        columns = predict_whole(case, {"identified": identified.values}, test)
        return [_at(case, columns, r, one) for r, one in enumerate(test_recordings)]

    tried = identified.search.evaluations if identified.search else 0
    return predict, f"{tried} candidates, then refined"


def _fit_described(name: str, fold: Fold, seed: int) -> Fit:
    """Identify a robot from a model and logs, with the terms and the settings of `new`."""
    # The logs have the gains only if the fitted recordings differ in them: a constant gain has no effect of its own.
    gains = len({r.constants.get("duty_per_rad") for r in fold.fitted}) > 1
    with tempfile.TemporaryDirectory() as folder:
        logs, model = _written(fold.fitted, Path(folder), gains), _model(fold.fitted, Path(folder))
        with contextlib.redirect_stderr(io.StringIO()):  # drops the messages on columns, which repeat for each fold
            flags = RobotFlags(mjcf=model, as_told=True)
            pipeline = from_model.describe_robot(flags, [str(p) for p in logs]).made()
        wanted = "auto" if name in CHOOSES else "own"
        robot = shared.offering(pipeline, wanted)
        fitted = {str(p): open_recording(p, robot).episode for p in logs}
    config = replace(pipeline.defaults.identify, seed=seed)
    model = robot.identifiable(config.max_delay_s)
    case = Case(name, shared.with_length(config, model), robot, model)
    identified = _fit_with_terms(case, fitted) if wanted == "auto" else identify(case, fitted)

    def predict(test_recordings: Sequence[Recording]) -> list[np.ndarray]:
        with tempfile.TemporaryDirectory() as folder:
            test = [open_recording(p, robot).episode for p in _written(test_recordings, Path(folder), gains)]
        columns = _free_run(case, identified.values, test, test_recordings)
        return [_at(case, columns, r, one, started=True) for r, one in enumerate(test_recordings)]

    about = f"{len(identified.problem.table)} parameters of a robot from its model, refined from the model's"
    about += f"; terms {', '.join(identified.problem.table.terms) or 'none'}"
    return predict, f"{about}; engine {identified.problem.engine.name}"


def _fit_with_terms(case: Case, fitted: dict[str, Any]) -> Any:
    """Identify with optional terms chosen on held-out parts, as ``--terms auto`` does."""
    c, episodes = replace(case.config, terms="auto"), list(fitted.values())
    model, length = case.model, c.settle_s + c.horizon_s
    table = shared.with_wanted_terms(model.parameters, c.terms)
    spans = windows(episodes, length, c.spacing_s, c.initial_state == "free")
    none = fit_model(Problem(model, episodes, spans, length, c, table.with_terms(())))
    problem = Problem(model, episodes, spans, length, c, table)
    selection = fitting.compare_terms(none, problem, c, list(fitted))
    fewer = table.with_terms(selection.chosen.names(table))
    end = fewer.encode(as_numbers(problem.table, selection.chosen.x))
    longer = shared.covering([(0.0, e.duration_s) for e in episodes], c.long_s or 0.0)
    return fit_model(Problem(model, episodes, spans, length, c, fewer), longer, end=end)


def _model(fitted: Sequence[Recording], folder: Path) -> Path:
    """Return the model's file: that of the recordings, or the guide's arm with their load, which must be one."""
    if "mjcf" in fitted[0].constants:
        return Path(fitted[0].constants["mjcf"])
    loads = {(r.constants["mass"], r.constants["length"]) for r in fitted}
    if len(loads) > 1:
        raise UsageError(f"recordings of one model have one load, got masses and lengths {sorted(loads)}")
    ((mass, length),) = loads
    path = folder / "arm.xml"
    path.write_text(ARM.format(mass=mass, length=length))
    return path


def _written(recordings_to_write: Sequence[Recording], folder: Path, gains: bool) -> list[Path]:
    """Write recordings as files of another recorder, with descriptive names of columns; return their paths.

    Args:
        gains: Whether the files have a column of the firmware's gain.
    """
    paths = []
    for i, r in enumerate(recordings_to_write):
        position, command = COLUMNS["sliding" in r.constants]
        columns: dict[str, Any] = {"t_s": r.t, position: r.position, command: r.command}
        if "torque_enable" in r.constants:
            columns["torque_enable"] = np.asarray(r.constants["torque_enable"], np.float64)[:, None]
        if gains:
            columns["kp"] = np.full((len(r.t), 1), r.constants["duty_per_rad"])
        np.savez(path := folder / f"log_{i}.npz", **columns)
        paths.append(path)
    return paths


def _free_run(
    case: Case, values: dict[str, Any], test: Sequence[Episode], test_recordings: Sequence[Recording]
) -> dict[str, np.ndarray]:
    """Return columns of one simulation of each test recording, from the same initial state as for all entrants."""
    # Samples before the largest delay are not compared, so that delay is hardly larger than the estimate.
    config = replace(case.config, max_delay_s=values["delay"] + 2 * case.robot.tick_s)
    spans = [Span(r, 0.0, False) for r in range(len(test))]
    problem = Problem(case.model, test, spans, max(e.duration_s for e in test), config)
    # The initial state is a cubic in time for each joint, with the given position and velocity.
    starts = np.stack([np.pad(r.start, ((0, 0), (0, 2))) for r in test_recordings])
    problem.data = problem.data._replace(starts=problem.data.starts.at[: len(test_recordings)].set(starts))
    columns = prediction.samples(problem, {"identified": values}, 0.0)
    return columns | {"ahead": columns["into"]}


def _at(
    case: Case, columns: dict[str, np.ndarray], recording: int, one: Recording, started: bool = False
) -> np.ndarray:
    """Return predicted positions at a recording's stamps, ``(N, joints)``.

    Args:
        started: Whether the simulation begins in the recording's first state, which is then the first prediction.
    """
    pick = (columns["recording"] == recording) & (columns["ahead"] > 0)
    t, first = columns["ahead"][pick], [0.0] if started else []
    predicted = [columns[f"{f}_identified"][pick] for f in case.fields]
    lines = [[*(one.start[j, :1] if started else []), *line] for j, line in enumerate(predicted)]
    return np.stack([np.interp(one.t - one.t[0], [*first, *t], line) for line in lines], axis=1)
