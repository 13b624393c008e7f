"""The artifact of identify: ``parameters.json``, predictions, free runs, and the timing of the recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np

from sim2real.artifacts.estimation.links import Link
from sim2real.artifacts.estimation.noise import Noise
from sim2real.artifacts.estimation.posterior import Posterior
from sim2real.artifacts.estimation.promise import Bound, Promise, promises_table
from sim2real.artifacts.estimation.quantity import Quantity
from sim2real.artifacts.estimation.search import Search
from sim2real.artifacts.estimation.tried_term import TriedTerm
from sim2real.artifacts.estimation.worst_second import WorstSecond
from sim2real.artifacts.files import (
    check,
    make_folder,
    malformed,
    read_arrays,
    read_versioned,
    write_arrays,
    write_json,
)
from sim2real.artifacts.run.run_folder import Source
from sim2real.artifacts.summary import ArtifactTable, Interval, Shown
from sim2real.artifacts.timing import TIMING, Timing
from sim2real.types import Json

FORMAT = 3
PARAMETERS, PREDICTIONS, FREE_RUNS, REPLAYS = "parameters.json", "predictions.npz", "free_runs.npz", "replays.npz"
ROUND_TRIP = "round_trip_delay"
"""Name of the sum of all delays."""
MODELS = ("identified", "no delay", "nominal")
"""Models that predict: with the estimates, fitted without delays, and with the nominal values."""
_COLUMNS = ("t", "into", "segment", "recording", "held_out")
_NO_LIMIT = 1e6
"""Value of an absent limit: ``worlds.drive_terms.NO_LIMIT``, whose module takes a second to import."""
_AGAIN = "run `sim2real identify` again"
UNFINISHED = {"interrupted": "was interrupted", "not converged": "did not converge"}
"""Verdict on an identification without intervals -> the reason as text."""


@dataclass(frozen=True)
class Estimate:
    """One identified parameter; a number is None if it does not apply, is infinite or unknown.

    Attributes:
        name: Its name; ``NAME@RECORDING`` if each recording has a value of its own.
        kind: Kind of the parameter; a ``derived`` one is computed from others.
        nominal: The data sheet's value.
        low95: Lower end of the 95 % interval.
        lower: Lower bound of the search.
        verdict: ``accepted``, ``negligible``, ``not reached``, ``fixed``, ``at a bound``, ``not identifiable`` or
            ``not converged``, or ``interrupted``.
        truth: The value in the embedded robot.
    """

    name: str
    unit: str
    kind: Literal["dynamics", "delay", "measurement", "derived"]
    about: str
    nominal: float | None
    estimate: float
    verdict: str
    standard_error: float | None = None
    low95: float | None = None
    high95: float | None = None
    lower: float | None = None
    upper: float | None = None
    truth: float | None = None

    @property
    def absent(self) -> bool:
        """Whether it is a limit that the model does not have, as no motion reaches one; tables omit it."""
        return self.verdict == "fixed" and self.estimate == self.nominal == _NO_LIMIT


@dataclass(frozen=True)
class Judgement:
    """The verdict on an identification: its status, the reasons, and the command to run next."""

    status: str
    reasons: tuple[str, ...]
    next: str = ""


@dataclass(frozen=True)
class Matrix:
    """A matrix ``(P, P)`` over named parameters."""

    names: tuple[str, ...]
    matrix: np.ndarray

    def __post_init__(self) -> None:
        size = len(self.names)
        check(self.matrix.shape == (size, size), f"a matrix of {self.matrix.shape} for {size} names")


@dataclass(frozen=True)
class Determined:
    """Determinacy of the parameters at the estimate.

    Attributes:
        condition: Condition number of the Jacobian; its columns are scaled by the widths of the bounds.
        undetermined: Groups of parameters; the data determines at most combinations of each group.
        messages: The same in sentences.
        standard_error_per_minute: Parameter -> expected standard error after one minute of such data.
    """

    condition: float | None
    undetermined: tuple[tuple[str, ...], ...]
    messages: tuple[str, ...]
    standard_error_per_minute: Mapping[str, float | None]


@dataclass(frozen=True)
class Prediction:
    """Errors of a model up to a horizon: field -> root mean square and mean absolute error; None without data."""

    model: str
    horizon_s: float
    held_out: bool
    rmse: Mapping[str, float | None]
    mae: Mapping[str, float | None]


@dataclass(frozen=True)
class HeldOut:
    """Errors of one position on held-out data, up to the longest horizon.

    Attributes:
        column: Its name among the fields, such as ``position[1]``.
        rmse: Model -> root mean square error; None if it is infinite.
        beaten_by: Baselines with an error that is not larger.
    """

    name: str
    column: str
    unit: str
    horizon_s: float
    rmse: Mapping[str, float | None]
    beaten_by: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check("identified" in self.rmse, f"no error of the identified model in {self.name!r}")


@dataclass(frozen=True)
class FreeRun:
    """Errors of one model in one field, with all held-out data of a recording simulated from one initial state.

    Attributes:
        low95: Lower end of the 95 % interval of ``rmse`` over draws of the posterior; None for other models.
    """

    model: str
    recording: int
    begin_s: float
    seconds: float
    held_out: bool
    field: str
    rmse: float | None
    mae: float | None
    low95: float | None = None
    high95: float | None = None


@dataclass(frozen=True)
class HeldOutPart:
    """A fit without one part of the recordings, and its errors on that part.

    Attributes:
        terms: Optional terms of the model in this fit.
        values: Parameter -> estimate of this fit.
        share: Parameter -> share of the information in all recordings that the part holds.
        ahead: Field -> root mean square error on the part up to the longest horizon.
        free: Field -> root mean square error of a free run over the part; empty without a free run.
        run_s: Length of the free run [s]; 0 in older files.
    """

    name: str
    terms: tuple[str, ...]
    values: Mapping[str, Json]
    share: Mapping[str, float]
    ahead: Mapping[str, float | None]
    free: Mapping[str, float | None] = field(default_factory=dict)
    run_s: float = 0.0


@dataclass(frozen=True, repr=False)
class Identification(Shown):
    """The result of identify.

    Attributes:
        logs: The fitted recordings, then the recordings that are held out whole.
        residual_inflation: Factor on the variance of the estimates, as residuals are correlated in time.
        misfit: Root mean square of the residuals, in deviations of the measurement.
        held_out: Errors of each position on held-out data, the largest first.
        worst: The second in which the model explains a joint worst; None without samples, and in older files.
        aggregate: Quantities estimated from each recording alone; empty unless configured.
        left_out: A fit for each held-out part; empty without folds.
        promises: The ledger: each error on a held-out part or on held-out data, beside the bound that was given before.
        ranges: Signal -> its range in the fitted segments; see ``segments.ranges``.
        tried: What optional terms gain on held-out parts; empty if none was tried.
        terms: Optional terms of the model in the fit; None if the model has no optional terms.
        noise: Noise of the sensor; empty in older files.
        widening: Factor on the posterior's deviations that covers errors of the model; None in older files.
        held_out_from_s: Start of the first held-out segment [s].
        settle_s: Length of the first part of a held-out segment, to which its initial state is fitted [s].
        sigma: Field -> assumed deviation of a measurement.
        world: Name of the simulated world; None for the robot's own.
        posterior: Distribution from which training draws robots; None after an interrupted search.
        samples: Columns of the segments ``(N,)``: ``t``, ``into`` (since the segment's start) [s], ``segment``,
            ``recording``, ``held_out``, and ``FIELD_measured`` and ``FIELD_MODEL`` of each field.
        free: The same columns of the free runs; empty without free runs.
        replays: Initial states and commands of held-out segments and free runs; see ``identify.validation.replays``.
        timing: Timing of the first recording, from which training draws its delays; None if only the estimates exist.
    """

    pipeline: str
    logs: tuple[Source, ...]
    verdict: Judgement
    parameters: tuple[Estimate, ...]
    search: Search = field(default_factory=Search)
    covariance: Matrix | None = None
    correlation: Matrix | None = None
    residual_inflation: float | None = None
    misfit: float | None = None
    check: Determined | None = None
    prediction: tuple[Prediction, ...] = ()
    held_out: tuple[HeldOut, ...] = ()
    worst: WorstSecond | None = None
    free_run: tuple[FreeRun, ...] = ()
    aggregate: tuple[Quantity, ...] = ()
    left_out: tuple[HeldOutPart, ...] = ()
    promises: tuple[Promise, ...] = ()
    bounds: tuple[Bound, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    tried: tuple[TriedTerm, ...] = ()
    terms: tuple[str, ...] | None = None
    links: tuple[Link, ...] = ()
    noise: tuple[Noise, ...] = ()
    widening: float | None = None
    segments: int | None = None
    held_out_from_s: float | None = None
    settle_s: float = 0.0
    sigma: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    world: str | None = None
    posterior: Posterior | None = None
    samples: Mapping[str, np.ndarray] = field(default_factory=dict)
    free: Mapping[str, np.ndarray] = field(default_factory=dict)
    replays: Mapping[str, np.ndarray] = field(default_factory=dict)
    timing: Timing | None = None
    format: int = FORMAT

    def about(self) -> Mapping[str, Json]:
        """Return pipeline, verdict, reasons, the next command and the number of parameters, by name."""
        facts = {"pipeline": self.pipeline, "verdict": self.verdict.status, "why": "; ".join(self.verdict.reasons)}
        worst = self.worst.text(self.logs) if self.worst else ""
        facts |= {"worst": worst, "next": self.verdict.next, "parameters": len(self.parameters)}
        return {name: value for name, value in facts.items() if value}

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter."""
        rows = [
            [p.name, p.estimate, Interval(p.low95, p.high95), p.unit, p.nominal, p.truth, _off(p), p.verdict]
            for p in self.parameters
            if not p.absent
        ]
        headers = ("parameter", "estimate", "95 % interval", "unit", "nominal", "truth", "off by", "verdict")
        return ArtifactTable(headers, rows)

    def recordings_table(self) -> ArtifactTable:
        """Return a row for each quantity that is estimated from each recording alone."""
        rows = [
            [q.name, q.mean, q.standard_error, Interval(q.low95, q.high95), q.unit, q.between, q.agree]
            for q in self.aggregate
        ]
        return ArtifactTable(("over recordings", "mean", "s.e.", "95 % of the next", "unit", "spread", "agree"), rows)

    def alternatives_table(self) -> ArtifactTable:
        """Return a row for each other model that fits the recordings as well."""
        others = () if self.posterior is None else self.posterior.others
        rows = [[other.about, f"{100 * other.weight:.0f} %"] for other in others]
        return ArtifactTable(("explains the recordings as well", "share of the draws"), rows)

    def held_out_table(self) -> ArtifactTable:
        """Return the errors on held-out data: a row for each position, a column for each model."""
        models = list(dict.fromkeys(model for row in self.held_out for model in row.rmse))
        rows = [
            [row.name, *(row.rmse.get(m) for m in models), row.unit, ", ".join(row.beaten_by) or "none"]
            for row in self.held_out
        ]
        horizon = f"held-out RMSE, {self.held_out[0].horizon_s:g} s ahead" if self.held_out else ""
        return ArtifactTable((horizon, *models, "unit", "no better than"), rows)

    def promises_table(self) -> ArtifactTable:
        """Return the ledger: a row for each error and the bound that was given before it."""
        return promises_table(self.promises)

    @property
    def values(self) -> dict[str, float]:
        """Parameter -> estimate, without derived parameters."""
        return {p.name: p.estimate for p in self.parameters if p.kind != "derived"}

    @property
    def fields(self) -> list[str]:
        """The measured fields."""
        return [n.removesuffix("_measured") for n in self.samples if n.endswith("_measured")]

    @property
    def recordings(self) -> list[int]:
        """Numbers of the recordings in ``samples``."""
        return np.unique(self.samples["recording"]).tolist() if self.samples else []

    def models(self, name: str) -> list[str]:
        """Return the models that predict a field."""
        return [m for m in MODELS if f"{name}_{m}" in self.samples]

    def disjoint(self) -> np.ndarray:
        """Return a mask ``(N,)`` of the samples in segments that do not overlap an earlier one."""
        t_s, segment, recording = (self.samples[n] for n in ("t", "segment", "recording"))
        mask, end = np.zeros(len(t_s), bool), {}
        for number in dict.fromkeys(segment.tolist()):
            rows = segment == number
            log = int(recording[rows][0])
            if t_s[rows][0] > end.get(log, -np.inf):
                mask |= rows
                end[log] = t_s[rows][-1]
        return mask

    def save(self, folder: Path | str) -> dict[str, str]:
        """Write it into a folder.

        Returns:
            Output -> name of the file in the folder.
        """
        folder = make_folder(folder)
        written = {"parameters": PARAMETERS}
        self.write(folder / PARAMETERS)
        for name, columns in (("predictions", self.samples), ("free_runs", self.free), ("replays", self.replays)):
            if columns:
                write_arrays(folder / written.setdefault(name, f"{name}.npz"), columns)
        return written if self.timing is None else {**written, **self.timing.save(folder)}

    def write(self, path: Path) -> None:
        """Write estimates and verdict as JSON, without samples and timing."""
        arrays = ("samples", "free", "replays", "timing")
        write_json(path, {f.name: getattr(self, f.name) for f in fields(self) if f.name not in arrays})

    @staticmethod
    def load(path: Path | str) -> Identification:
        """Read what ``save`` wrote.

        Args:
            path: The folder, or its ``parameters.json``; a file without predictions beside it is read, too.

        Raises:
            Sim2RealError: When the file is missing, malformed, or of another format.
        """
        path = Path(path)
        file = path / PARAMETERS if path.is_dir() else path
        # Read the estimates, then the samples and the timing if their files exist.
        identification = read_versioned(file, Identification, _AGAIN, FORMAT)
        with malformed(file, _AGAIN):
            check(all(np.isfinite(p.estimate) for p in identification.parameters), "an estimate is no number")
        # Files beside it may be missing: a copy of the estimates alone can be read.
        others: dict[str, Json] = {}
        if file.with_name(TIMING).is_file():
            others["timing"] = Timing.load(file.with_name(TIMING))
        for name, samples_file in (("samples", PREDICTIONS), ("free", FREE_RUNS), ("replays", REPLAYS)):
            if (samples_path := file.with_name(samples_file)).is_file():
                with malformed(samples_path, _AGAIN):
                    others[name] = (dict if name == "replays" else _columns)(read_arrays(samples_path))
        return replace(identification, **others)


def _off(p: Estimate) -> str:
    """Return the error of an estimate as a share of the truth; in its unit if the truth is 0."""
    if p.truth is None:
        return ""
    return f"{100 * (p.estimate / p.truth - 1):+.1f} %" if p.truth else f"{p.estimate:+.2g} {p.unit}"


def _columns(samples: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns; each must have one value a sample, and at least one sample."""
    missing = set(_COLUMNS) - set(samples)
    check(not missing, f"no {', '.join(sorted(missing))}")
    wrong = [n for n, v in samples.items() if v.ndim != 1 or v.shape != samples["t"].shape]
    check(not wrong, f"not one value a sample: {', '.join(wrong)}")
    check(samples["t"].size > 0, "no sample")
    return samples
