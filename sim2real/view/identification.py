"""What identify writes, read and checked: from here on nothing has to doubt its input."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sim2real.view.files import blaming, check, read_arrays, read_json, read_number, read_numbers
from sim2real.view.run import Artifact

_NUMBERS = ("nominal", "standard_error", "low95", "high95", "lower", "upper", "truth")
_COLUMNS = ("t", "segment", "held_out")
MODELS = ("identified", "no delay", "nominal")


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
class HeldOut:
    """How far one position is off on held-out data after the longest horizon: model -> RMSE, and what is as good."""

    name: str
    unit: str
    horizon_s: float
    rmse: Mapping[str, float]
    beaten_by: Sequence[str]


@dataclass(frozen=True)
class FreeRun:
    """How far one model's free run of one recording is off in one field."""

    model: str
    recording: int
    begin_s: float
    seconds: float
    held_out: bool
    field: str
    rmse: float
    mae: float


@dataclass(frozen=True)
class Quantity:
    """One quantity over recordings: each by itself, and what they say together."""

    name: str
    unit: str
    estimates: np.ndarray
    standard_errors: np.ndarray
    mean: float
    standard_error: float
    between: float
    low95: float
    high95: float
    agree: bool


@dataclass(frozen=True)
class Determined:
    """What the data determines at the estimate: condition number, messages, and standard errors after a minute."""

    condition: float
    messages: Sequence[str]
    per_minute: Mapping[str, float]


@dataclass(frozen=True)
class Identification:
    """What ``identify`` found.

    Attributes:
        status: The verdict; empty where there is none.
        reasons: Why.
        estimates: The parameters.
        correlation: Names and matrix ``(P, P)``; None where there is none.
        history: Best loss of each generation ``(G,)``.
        search: Other numbers about the search.
        prediction: Prediction errors.
        samples: Arrays of ``predictions.npz``: ``t``, ``into``, ``segment``, ``recording``, ``held_out`` ``(N,)`` and
            the fields' values.
        free: The same of ``free_runs.npz``; empty where there is none.
        free_runs: Errors of the free runs.
        aggregate: What several recordings say; empty for one.
        determined: What the data determines, if told.
        units: Field -> unit, where told.
        sigma: Field -> the deviation that a measurement was assumed to have, where told.
        misfit: Root mean square of the residuals in these deviations, if told.
        settle_s: How much of a held-out segment its initial state was fitted to [s].
        segments: How many segments, if told.
        logs: Names of the recordings, fitted ones first.
        held_out: How far each position is off on held-out data, the worst first.
    """

    status: str
    reasons: Sequence[str]
    estimates: list[Estimate]
    correlation: tuple[list[str], np.ndarray] | None
    history: np.ndarray
    search: Mapping[str, Any]
    prediction: list[Prediction]
    samples: Mapping[str, np.ndarray]
    free: Mapping[str, np.ndarray]
    free_runs: list[FreeRun]
    aggregate: list[Quantity]
    determined: Determined | None
    units: Mapping[str, str]
    sigma: Mapping[str, float] = field(default_factory=dict)
    misfit: float | None = None
    settle_s: float = 0.0
    segments: Any = None
    logs: Sequence[str] = ()
    held_out: Sequence[HeldOut] = ()

    @property
    def fields(self) -> list[str]:
        """The measured fields."""
        return [n.removesuffix("_measured") for n in self.samples if n.endswith("_measured")]

    @property
    def recordings(self) -> list[int]:
        """Numbers of the recordings that there are samples of."""
        return np.unique(self.samples["recording"]).tolist()

    def models(self, name: str) -> list[str]:
        """Return the models that predict a field."""
        return [m for m in MODELS if f"{name}_{m}" in self.samples]

    def disjoint(self) -> np.ndarray:
        """Return which samples to show ``(N,)``: segments may overlap, and then the later one is left out."""
        t_s, segment, recording = (self.samples[n] for n in ("t", "segment", "recording"))
        chosen, end = np.zeros(len(t_s), bool), {}
        for number in dict.fromkeys(segment.tolist()):
            rows = segment == number
            own = int(recording[rows][0])
            if t_s[rows][0] > end.get(own, -np.inf):
                chosen |= rows
                end[own] = t_s[rows][-1]
        return chosen


def read_identification(artifact: Artifact) -> Identification:
    """Read ``parameters.json``, ``predictions.npz`` and, where there is one, ``free_runs.npz``.

    Raises:
        Sim2RealError: When one is missing or not as it should be.
    """
    path = artifact.need("parameters", "parameters.json")
    with blaming(path, artifact):
        data = read_json(path)
        verdict = data.get("verdict") or {}
        search = dict(data.get("search", {}))
        told: dict[str, Any] = {
            "status": str(verdict.get("status", "")),
            "reasons": [str(r) for r in verdict.get("reasons", [])],
            "estimates": [_estimate(entry) for entry in data["parameters"]],
            "correlation": _correlation(data.get("correlation")),
            "history": read_numbers(search.pop("history", [])),
            "search": search,
            "prediction": [_prediction(row) for row in data.get("prediction", [])],
            "held_out": [_held_out(row) for row in data.get("held_out", [])],
            "free_runs": [_free_run(row) for row in data.get("free_run", [])],
            "aggregate": [_quantity(row) for row in data.get("aggregate", [])],
            "determined": _determined(data.get("check")),
            "units": {str(k): str(v) for k, v in data.get("units", {}).items()},
            "sigma": {str(k): float(v) for k, v in data.get("sigma", {}).items()},
            "misfit": read_number(data.get("misfit")),
            "segments": data.get("segments"),
            "logs": [str(log["path"]).replace("\\", "/").rsplit("/", 1)[-1] for log in data.get("logs", [])],
        }
    config = artifact.manifest.get("config") or {}
    path = artifact.need("predictions", "predictions.npz")
    with blaming(path, artifact):
        samples = _columns(read_arrays(path))
    free: Mapping[str, np.ndarray] = {}
    path = artifact.output("free_runs", "free_runs.npz")
    if path is not None:
        with blaming(path, artifact):
            free = _columns(read_arrays(path))
    return Identification(samples=samples, free=free, settle_s=float(config.get("settle_s", 0.0)), **told)


def _columns(samples: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    missing = set(_COLUMNS) - set(samples)
    check(not missing, f"no {', '.join(sorted(missing))}")
    wrong = [n for n, v in samples.items() if v.ndim != 1 or v.shape != samples["t"].shape]
    check(not wrong, f"not one value a sample: {', '.join(wrong)}")
    check(samples["t"].size > 0, "no sample")
    samples.setdefault("recording", np.zeros(samples["t"].shape, int))
    if "into" not in samples:
        begins = {s: samples["t"][samples["segment"] == s][0] for s in np.unique(samples["segment"])}
        samples["into"] = samples["t"] - np.array([begins[s] for s in samples["segment"]])
    return samples


def _estimate(entry: Mapping[str, Any]) -> Estimate:
    estimate = read_number(entry["estimate"], math.nan)
    texts = {name: str(entry.get(name) or "") for name in ("unit", "kind", "about", "verdict")}
    numbers = {n: read_number(entry.get(n)) for n in _NUMBERS}
    return Estimate(name=str(entry["name"]), estimate=estimate, **texts, **numbers)


def _correlation(data: Mapping[str, Any] | None) -> tuple[list[str], np.ndarray] | None:
    if not data:
        return None
    names = [str(n) for n in data["names"]]
    matrix = read_numbers(data["matrix"])
    if not names:
        return None
    check(matrix.shape == (len(names), len(names)), f"a correlation matrix of {matrix.shape} for {len(names)}")
    return names, matrix


def _prediction(row: Mapping[str, Any]) -> Prediction:
    errors = {n.removesuffix("_rmse"): read_number(v, math.nan) for n, v in row.items() if n.endswith("_rmse")}
    check(bool(errors), f"no error of any field in the prediction of {row.get('model')!r}")
    return Prediction(str(row["model"]), float(row["horizon_s"]), bool(row.get("held_out", False)), errors)


def _held_out(row: Mapping[str, Any]) -> HeldOut:
    errors = {str(m): read_number(e, math.inf) for m, e in row["rmse"].items()}
    check("identified" in errors, f"no error of what was identified in {row.get('name')!r}")
    named = str(row["name"]), str(row.get("unit") or ""), float(row["horizon_s"])
    return HeldOut(*named, errors, [str(m) for m in row.get("beaten_by", [])])


def _free_run(row: Mapping[str, Any]) -> FreeRun:
    numbers = {n: read_number(row[n], math.nan) for n in ("begin_s", "seconds", "rmse", "mae")}
    return FreeRun(
        model=str(row["model"]),
        recording=int(row["recording"]),
        held_out=bool(row["held_out"]),
        field=str(row["field"]),
        **numbers,
    )


def _quantity(row: Mapping[str, Any]) -> Quantity:
    arrays = {n: read_numbers(row[n]) for n in ("estimates", "standard_errors")}
    check(arrays["estimates"].shape == arrays["standard_errors"].shape, f"{row['name']}: estimates without errors")
    numbers = {n: read_number(row[n], math.nan) for n in ("mean", "standard_error", "between", "low95", "high95")}
    return Quantity(name=str(row["name"]), unit=str(row["unit"]), agree=bool(row["agree"]), **arrays, **numbers)


def _determined(data: Mapping[str, Any] | None) -> Determined | None:
    if not data:
        return None
    errors = {str(n): read_number(v, math.nan) for n, v in data.get("standard_error_per_minute", {}).items()}
    return Determined(read_number(data["condition"], math.nan), [str(m) for m in data.get("messages", [])], errors)
