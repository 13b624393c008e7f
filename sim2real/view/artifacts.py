"""What identify, train and deploy write, read and checked: from here on nothing has to doubt its input."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.view.run import Artifact
from sim2real.view.signals import Recording, Series, components, read_recording

_NUMBERS = ("nominal", "standard_error", "low95", "high95", "lower", "upper", "truth")
_GAP = ("real", "simulation", "gap")


@dataclass(frozen=True)
class Estimate:
    """One identified parameter; None where a number does not apply or is not known."""

    name: str
    unit: str
    kind: str
    about: str
    estimate: float
    nominal: float | None
    standard_error: float | None
    low95: float | None
    high95: float | None
    lower: float | None
    upper: float | None
    truth: float | None
    verdict: str

    @property
    def truth_in_errors(self) -> float | None:
        """How many standard errors the truth lies above the estimate."""
        if self.truth is None or not self.standard_error:
            return None
        return (self.truth - self.estimate) / self.standard_error


def in_readable_unit(e: Estimate) -> Estimate:
    """Return a parameter in ms where it is a time below a second; others as they are."""
    largest = max(abs(v) for v in (e.estimate, e.upper, e.truth) if v is not None)
    if e.unit != "s" or largest >= 1.0:
        return e
    scaled = {n: getattr(e, n) for n in (*_NUMBERS, "estimate")}
    return replace(e, unit="ms", **{n: None if v is None else 1e3 * v for n, v in scaled.items()})


@dataclass(frozen=True)
class Prediction:
    """How far a model's prediction is off after a horizon: field -> RMSE."""

    model: str
    horizon_s: float
    held_out: bool
    rmse: Mapping[str, float]


@dataclass(frozen=True)
class Identification:
    """What ``identify`` found.

    Attributes:
        estimates: The parameters.
        correlation: Names and matrix ``(P, P)``; None where there is none.
        history: Best loss of each generation ``(G,)``.
        search: Other numbers about the search.
        prediction: Prediction errors.
        samples: Arrays of ``predictions.npz``: ``t``, ``segment``, ``held_out`` ``(N,)`` and the fields' values.
        units: Field -> unit, where told.
        segments: How many segments, if told.
    """

    estimates: list[Estimate]
    correlation: tuple[list[str], np.ndarray] | None
    history: np.ndarray
    search: Mapping[str, Any]
    prediction: list[Prediction]
    samples: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    segments: Any

    @property
    def fields(self) -> list[str]:
        """The measured fields."""
        return [n.removesuffix("_measured") for n in self.samples if n.endswith("_measured")]

    def models(self, name: str) -> list[str]:
        """Return the models that predict a field."""
        return [m for m in ("identified", "nominal") if f"{name}_{m}" in self.samples]

    def disjoint(self) -> np.ndarray:
        """Return which samples to show ``(N,)``: segments may overlap, and then the later one is left out."""
        t_s, segment = self.samples["t"], self.samples["segment"]
        chosen, end = np.zeros(len(t_s), bool), -np.inf
        for number in dict.fromkeys(segment.tolist()):
            rows = segment == number
            if t_s[rows][0] > end:
                chosen |= rows
                end = t_s[rows][-1]
        return chosen


@dataclass(frozen=True)
class Training:
    """Learning curves: ``steps`` ``(K,)``; returns and success ``(K, seeds)``; ``seconds`` ``(K,)``.

    ``best_seed`` is the one whose policy was kept, if told.
    """

    steps: np.ndarray
    returns: np.ndarray
    success: np.ndarray
    seconds: np.ndarray
    best_seed: int | None


@dataclass(frozen=True)
class Deployment:
    """Episodes on the robot beside the same policy in simulation.

    Attributes:
        episodes: The robot's logs.
        simulated: For each episode the simulation's series, ``command`` among them; empty where nothing was simulated.
        scores: For each episode what ``result.json`` says of it: ``real`` and ``simulation``, empty likewise.
        gap: Rows with quantity, real, simulation and gap.
        units: Field or quantity -> unit, where told.
    """

    episodes: list[Recording]
    simulated: list[list[Series]]
    scores: Sequence[Mapping[str, Mapping[str, Any]]]
    gap: Sequence[Mapping[str, Any]]
    units: Mapping[str, str]


def read_identification(artifact: Artifact) -> Identification:
    """Read ``parameters.json`` and ``predictions.npz``.

    Raises:
        Sim2RealError: When one is missing or not as it should be.
    """
    path = artifact.need("parameters", "parameters.json")
    with _blaming(path, artifact):
        data = _json(path)
        estimates = [_estimate(entry) for entry in data["parameters"]]
        correlation = None
        if data.get("correlation"):
            names = [str(n) for n in data["correlation"]["names"]]
            matrix = np.array([[_number(v, math.nan) for v in row] for row in data["correlation"]["matrix"]])
            _check(matrix.shape == (len(names), len(names)), f"a correlation matrix of {matrix.shape} for {len(names)}")
            correlation = (names, matrix)
        search = dict(data.get("search", {}))
        history = np.array([_number(v, math.nan) for v in search.pop("history", [])], np.float64)
        prediction = [_prediction(row) for row in data.get("prediction", [])]
        units = {str(k): str(v) for k, v in data.get("units", {}).items()}
    path = artifact.need("predictions", "predictions.npz")
    with _blaming(path, artifact):
        samples = _arrays(path)
        missing = {"t", "segment", "held_out"} - set(samples)
        _check(not missing, f"no {', '.join(sorted(missing))}")
        wrong = [n for n, v in samples.items() if v.ndim != 1 or v.shape != samples["t"].shape]
        _check(not wrong, f"not one value a sample: {', '.join(wrong)}")
        _check(samples["t"].size > 0, "no sample")
    return Identification(estimates, correlation, history, search, prediction, samples, units, data.get("segments"))


def read_training(artifact: Artifact) -> Training:
    """Read ``history.json``.

    Raises:
        Sim2RealError: When it is missing or not as it should be.
    """
    path = artifact.need("history", "history.json")
    with _blaming(path, artifact):
        data = _json(path)
        steps = _numbers(data["steps"])
        returns, success = (_numbers(data[name]).reshape(len(steps), -1) for name in ("return", "success"))
        seconds = _numbers(data["seconds"]).reshape(len(steps))
        _check(len(steps) > 0, "no evaluation")
        best = None if data.get("best_seed") is None else int(data["best_seed"])
        _check(best is None or 0 <= best < returns.shape[1], f"no curve of seed {best}")
    return Training(steps, returns, success, seconds, best)


def read_deployment(artifact: Artifact) -> Deployment:
    """Read the logs, ``simulation.npz`` and ``result.json``.

    Raises:
        Sim2RealError: When one is missing or not as it should be.
    """
    path = artifact.need("result", "result.json")
    with _blaming(path, artifact):
        data = _json(path)
        scores = [{"real": dict(e["real"]), "simulation": dict(e["simulation"] or {})} for e in data["episodes"]]
        _check(bool(scores), "no episode")
        gap = [{"quantity": str(r["quantity"]), **{k: _number(r[k]) for k in _GAP}, **_unit(r)} for r in data["gap"]]
        units = {str(k): str(v) for k, v in data.get("units", {}).items()}
    path = artifact.need("simulation", "simulation.npz")
    with _blaming(path, artifact):
        arrays = _arrays(path)
        simulated = [_of_episode(arrays, i) for i in range(len(scores))]
    # The embedded robot may run on from one episode to the next: then one account holds the truth of all.
    truths = [artifact.output(f"truth_{i}", f"truth_{i}.bin") for i in range(len(scores))]
    common = artifact.output("truth", "truth.bin")
    episodes = [
        read_recording(artifact.need(f"log_{i}", f"episode_{i}.mcap"), truths[i] or common) for i in range(len(scores))
    ]
    return Deployment(episodes, simulated, scores, gap, units)


class _blaming:  # noqa: N801 - reads as a statement: with _blaming(path, artifact)
    """Turns what a malformed file raises into an error that names the file."""

    def __init__(self, path: Path, artifact: Artifact) -> None:
        self.path, self.artifact = path, artifact

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Sim2RealError) or not isinstance(
            error, ValueError | KeyError | TypeError | AttributeError | IndexError | OSError
        ):
            return
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
        raise Sim2RealError(f"{self.path} is malformed: {reason}", hint=self.artifact.again) from error


def _check(good: bool, reason: str) -> None:
    if not good:
        raise ValueError(reason)


def _json(path: Path) -> dict[str, Any]:
    data = json.loads(path.read_text(encoding="utf-8"))
    _check(isinstance(data, dict), "not a JSON object")
    return data


def _arrays(path: Path) -> dict[str, np.ndarray]:
    import zipfile

    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (zipfile.BadZipFile, EOFError) as error:
        raise ValueError(str(error)) from error


def _number(value: Any, missing: float | None = None) -> Any:
    """Return a number; ``missing`` for null; JSON spells infinite ones and NaN as strings."""
    if value is None:
        return missing
    number = float(value)
    return missing if missing is None and math.isnan(number) else number


def _numbers(values: Sequence[Any]) -> np.ndarray:
    def flat(value: Any) -> Any:
        return [flat(v) for v in value] if isinstance(value, list) else _number(value, math.nan)

    return np.array(flat(list(values)), np.float64)


def _estimate(entry: Mapping[str, Any]) -> Estimate:
    estimate = _number(entry["estimate"], math.nan)
    texts = {name: str(entry.get(name) or "") for name in ("unit", "kind", "about", "verdict")}
    return Estimate(name=str(entry["name"]), estimate=estimate, **texts, **{n: _number(entry.get(n)) for n in _NUMBERS})


def _prediction(row: Mapping[str, Any]) -> Prediction:
    errors = {n.removesuffix("_rmse"): _number(v, math.nan) for n, v in row.items() if n.endswith("_rmse")}
    _check(bool(errors), f"no error of any field in the prediction of {row.get('model')!r}")
    return Prediction(str(row["model"]), float(row["horizon_s"]), bool(row.get("held_out", False)), errors)


def _unit(row: Mapping[str, Any]) -> dict[str, str]:
    return {"unit": str(row["unit"])} if row.get("unit") else {}


def _of_episode(arrays: Mapping[str, np.ndarray], number: int) -> list[Series]:
    """Return the series of one simulated episode: fields ``NAME_i`` at the times ``t_NAME_i``, else ``t_i``."""
    suffix = f"_{number}"
    own = {n.removesuffix(suffix): v for n, v in arrays.items() if n.endswith(suffix)}
    found: list[Series] = []
    for name, values in own.items():
        if name == "t" or name.startswith("t_"):
            continue
        t_s = own.get(f"t_{name}", own["t"])
        if len(t_s) != len(values):
            # Commands have a rate of their own: evenly over the same time, if nothing says when they were sent.
            t_s = np.arange(len(values)) * (float(own["t"][-1]) / len(values))
        found += components(name, "simulation", t_s, values)
    return found
