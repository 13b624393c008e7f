"""What identify found: ``parameters.json``, predictions and free runs beside it, and the timing of the recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sim2real.artifacts.estimation.links import Link
from sim2real.artifacts.estimation.noise import Noise
from sim2real.artifacts.estimation.posterior import Posterior
from sim2real.artifacts.estimation.quantity import Quantity
from sim2real.artifacts.files import check, made, malformed, read_arrays, read_json, write_arrays, write_json
from sim2real.artifacts.run.run_folder import Source
from sim2real.artifacts.summary import Rows, Shown
from sim2real.artifacts.timing import TIMING, Timing
from sim2real.errors import Sim2RealError

FORMAT = 3
PARAMETERS, PREDICTIONS, FREE_RUNS = "parameters.json", "predictions.npz", "free_runs.npz"
ROUND_TRIP = "round_trip_delay"
"""Name of the sum of all delays."""
MODELS = ("identified", "no delay", "nominal")
"""The models that predict: with the values found, the same fitted without delays, and with the data sheet's values."""
_COLUMNS = ("t", "into", "segment", "recording", "held_out")
_AGAIN = "run `sim2real identify` again"


UNFINISHED = {"interrupted": "was interrupted", "not converged": "did not converge"}
"""Verdict -> what happened to an identification that has no intervals."""


@dataclass(frozen=True)
class Estimate:
    """One identified parameter; None where a number does not apply, is infinite or not known.

    Attributes:
        name: Its name; ``NAME@RECORDING`` where each recording has its own.
        unit: Unit of all numbers.
        kind: What it is a parameter of; ``derived`` ones follow from others.
        about: One line for tables and pages.
        nominal: The data sheet's value.
        estimate: The value found.
        standard_error: Its standard error.
        low95: Lower end of the 95 % interval.
        high95: Its upper end.
        lower: Lower bound of the search.
        upper: Upper bound.
        verdict: ``accepted``, ``negligible``, ``not reached``, ``fixed``, ``at a bound``, ``not identifiable`` or
            ``not converged``, or ``interrupted``.
        truth: The embedded robot's own value.
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
        """Check its size: it may come from a file."""
        size = len(self.names)
        check(self.matrix.shape == (size, size), f"a matrix of {self.matrix.shape} for {size} names")


@dataclass(frozen=True)
class Determined:
    """What the data determines at the estimate.

    Attributes:
        condition: Condition number of the Jacobian, its columns in widths of the bounds.
        undetermined: Groups of parameters of which at most combinations are determined.
        messages: The same in words.
        standard_error_per_minute: Parameter -> standard error to expect of one minute of such data.
    """

    condition: float | None
    undetermined: tuple[tuple[str, ...], ...]
    messages: tuple[str, ...]
    standard_error_per_minute: Mapping[str, float | None]


@dataclass(frozen=True)
class Refinement:
    """A local refinement: the loss before and after, and how many steps it took."""

    before: float | None
    after: float | None
    steps: int


@dataclass(frozen=True)
class Search:
    """How the estimate was found.

    Attributes:
        strategy: The search algorithm; None where the search was left out.
        history: Best loss of each generation ``(G,)``.
        evaluations: Candidates that were simulated.
        refined: The refinements after it.
        seconds: What all of it took [s].
        loss: Of an interrupted search: the best loss so far.
        done: Of an interrupted search: the shares of search and refinement that were done.
        engine: What simulated, and why.
    """

    strategy: str | None = None
    history: np.ndarray = field(default_factory=lambda: np.zeros(0))
    evaluations: int = 0
    refined: tuple[Refinement, ...] = ()
    seconds: float | None = None
    loss: float | None = None
    done: Mapping[str, float] = field(default_factory=dict)
    engine: str = ""


@dataclass(frozen=True)
class Prediction:
    """How far a model is off up to a horizon: field -> root mean square and mean absolute error; None without data."""

    model: str
    horizon_s: float
    held_out: bool
    rmse: Mapping[str, float | None]
    mae: Mapping[str, float | None]


@dataclass(frozen=True)
class HeldOut:
    """How far one position is off on held-out data, up to the longest horizon.

    Attributes:
        name: What people call it.
        column: Its name among the fields, such as ``position[1]``.
        unit: Its unit.
        horizon_s: The horizon [s].
        rmse: Model -> root mean square error; None where it is infinite.
        beaten_by: The baselines that are as good.
    """

    name: str
    column: str
    unit: str
    horizon_s: float
    rmse: Mapping[str, float | None]
    beaten_by: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check that the error of the identified model is there: it may come from a file."""
        check("identified" in self.rmse, f"no error of what was identified in {self.name!r}")


@dataclass(frozen=True)
class FreeRun:
    """How far one model is off in one field when all held-out data of a recording is simulated from one state."""

    model: str
    recording: int
    begin_s: float
    seconds: float
    held_out: bool
    field: str
    rmse: float | None
    mae: float | None


@dataclass(frozen=True)
class Left:
    """What was identified without one part of the recordings, and how far it is off there.

    Attributes:
        name: The part.
        terms: Optional terms of the model that the rest of the data chose, or that it was given.
        values: Parameter -> estimate without the part.
        share: Parameter -> share of what all recordings say about it that this part says.
        ahead: Field -> root mean square error up to the longest horizon.
        free: Field -> root mean square error where the part is simulated in one go; empty where it was not.
    """

    name: str
    terms: tuple[str, ...]
    values: Mapping[str, Any]
    share: Mapping[str, float]
    ahead: Mapping[str, float | None]
    free: Mapping[str, float | None] = field(default_factory=dict)


@dataclass(frozen=True, repr=False)
class Identification(Shown):
    """What identify found.

    Attributes:
        pipeline: The robot.
        logs: The recordings: those that were fitted, then those that were held out whole.
        verdict: Whether it can be used, and why.
        parameters: The estimates.
        search: How they were found.
        covariance: Of the estimates.
        correlation: Of the estimates.
        residual_inflation: Factor on the variance of the estimates, as residuals are correlated in time.
        misfit: Root mean square of the residuals, in deviations of the measurement.
        check: What the data determines.
        prediction: Errors over horizons.
        held_out: Errors of each position on held-out data, the worst first.
        free_run: Errors of the free runs.
        aggregate: Each recording identified by itself, and all combined; empty unless that was asked for.
        left_out: What was identified with one part left out, for each part; empty where that was not asked for.
        terms: Optional terms of the model that were chosen, or given; None where it has none.
        links: How delays are distributed; empty unless that was asked for.
        noise: How measurements scatter around the model; empty in older files.
        widening: Factor on the posterior's deviations that covers the model's own errors; None in older files.
        segments: How many segments were simulated.
        held_out_from_s: Where the first segment that was held out begins [s].
        settle_s: Length of the first part of a held-out segment, to which its initial state was fitted [s].
        sigma: Field -> deviation that a measurement was assumed to have.
        units: Field -> unit.
        world: Name of the world that was identified in; None: the robot's own.
        posterior: What training draws robots from; None where the search was interrupted.
        samples: Columns of the segments ``(N,)``: ``t``, ``into`` (since the segment's start) [s], ``segment``,
            ``recording``, ``held_out``, and ``FIELD_measured`` and ``FIELD_MODEL`` of each field.
        free: The same of the free runs; empty without any.
        timing: Of the first recording: what training draws its timing from; None where only the estimates were copied.
        format: Version of the file.
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
    free_run: tuple[FreeRun, ...] = ()
    aggregate: tuple[Quantity, ...] = ()
    left_out: tuple[Left, ...] = ()
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
    timing: Timing | None = None
    format: int = FORMAT

    def about(self) -> Mapping[str, Any]:
        """Return what to say about it: name -> value."""
        found = {"pipeline": self.pipeline, "verdict": self.verdict.status, "why": "; ".join(self.verdict.reasons)}
        found |= {"next": self.verdict.next, "parameters": len(self.parameters)}
        return {name: value for name, value in found.items() if value}

    def rows(self) -> Rows:
        """Return a row for each parameter."""
        own = [[p.name, p.estimate, p.low95, p.high95, p.unit, p.verdict] for p in self.parameters]
        return ("parameter", "estimate", "low 95 %", "high 95 %", "unit", "verdict"), own

    @property
    def values(self) -> dict[str, float]:
        """Parameter -> the value found, without derived ones."""
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
        """Return a mask ``(N,)`` of samples in segments that do not overlap: of two that do, the later is left out."""
        t_s, segment, recording = (self.samples[n] for n in ("t", "segment", "recording"))
        chosen, end = np.zeros(len(t_s), bool), {}
        for number in dict.fromkeys(segment.tolist()):
            rows = segment == number
            own = int(recording[rows][0])
            if t_s[rows][0] > end.get(own, -np.inf):
                chosen |= rows
                end[own] = t_s[rows][-1]
        return chosen

    def save(self, folder: Path | str) -> dict[str, str]:
        """Write it into a folder.

        Returns:
            Output -> name of the file in the folder.
        """
        folder = made(folder)
        written = {"parameters": PARAMETERS}
        self.write(folder / PARAMETERS)
        for name, file, columns in (("predictions", PREDICTIONS, self.samples), ("free_runs", FREE_RUNS, self.free)):
            if columns:
                write_arrays(folder / file, columns)
                written[name] = file
        return written if self.timing is None else {**written, **self.timing.save(folder)}

    def write(self, path: Path) -> None:
        """Write the estimates and what is said about them, without samples and timing, as JSON."""
        arrays = ("samples", "free", "timing")
        write_json(path, {f.name: getattr(self, f.name) for f in fields(self) if f.name not in arrays})

    @staticmethod
    def load(path: Path | str) -> Identification:
        """Read what ``save`` wrote.

        Args:
            path: The folder, or its ``parameters.json``: then it may stand alone, without predictions.

        Raises:
            Sim2RealError: When it is missing, of another format, or not as it should be.
        """
        path = Path(path)
        file = path / PARAMETERS if path.is_dir() else path
        with malformed(file, _AGAIN):
            found = read_json(file, Identification)
            if found.format != FORMAT:
                raise Sim2RealError(f"{file} has format {found.format}, this version reads {FORMAT}", hint=_AGAIN)
            check(all(np.isfinite(p.estimate) for p in found.parameters), "an estimate is no number")
        beside: dict[str, Any] = {}
        if file.with_name(TIMING).is_file():
            beside["timing"] = Timing.load(file.with_name(TIMING))
        for name, other in (("samples", PREDICTIONS), ("free", FREE_RUNS)):
            if (there := file.with_name(other)).is_file():
                with malformed(there, _AGAIN):
                    beside[name] = _columns(read_arrays(there))
        return replace(found, **beside)


def _columns(samples: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns after checking that all have one value for each of at least one sample."""
    missing = set(_COLUMNS) - set(samples)
    check(not missing, f"no {', '.join(sorted(missing))}")
    wrong = [n for n, v in samples.items() if v.ndim != 1 or v.shape != samples["t"].shape]
    check(not wrong, f"not one value a sample: {', '.join(wrong)}")
    check(samples["t"].size > 0, "no sample")
    return samples
