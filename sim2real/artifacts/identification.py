"""The artifact of identify: ``parameters.json``, predictions, free runs, and the timing of the recording."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from sim2real.artifacts.files import (
    check,
    make_folder,
    malformed,
    read_arrays,
    read_versioned,
    write_arrays,
    write_json,
)
from sim2real.artifacts.paths import shown
from sim2real.artifacts.posterior import Posterior
from sim2real.artifacts.run import Source
from sim2real.artifacts.summary import ArtifactTable, Interval, Shown
from sim2real.artifacts.timing import TIMING, Timing
from sim2real.errors import Sim2RealError
from sim2real.types import Json

FORMAT = 5
PARAMETERS, PREDICTIONS, FREE_RUNS, REPLAYS = "parameters.json", "predictions.npz", "free_runs.npz", "replays.npz"
ROUND_TRIP = "round_trip_delay"
"""Name of the sum of all delays."""
_COLUMNS = ("t", "into", "segment", "recording", "held_out")
_NO_LIMIT = 1e6
"""Value of an absent limit: ``worlds.drive_terms.NO_LIMIT``, whose module takes a second to import."""
_AGAIN = "run `sim2real identify` again"
_RUN = "{run}"
"""Placeholder for the run's folder in the next command, as the folder may move."""


@dataclass(frozen=True)
class Estimate:
    """One identified parameter; a number is None if it does not apply, is infinite or unknown.

    Attributes:
        name: Its name.
        kind: Kind of the parameter; a ``derived`` one is computed from others.
        nominal: The data sheet's value.
        low95: Lower end of the 95 % interval.
        lower: Lower bound of the search.
        verdict: ``ok``, ``at a bound``, ``not determined`` or ``fixed``; in a fit that is not accepted no parameter is
            ``ok``.
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
    """The verdict on an identification.

    Attributes:
        status: ``accepted``, ``record again``, ``change the model`` or ``not finished``; "" before it is judged.
        reasons: Sentences; the first one decided.
        next: The command to run next, or what else to do; "" before it is judged.
    """

    status: str
    reasons: tuple[str, ...]
    next: str = ""


_COLUMN = re.compile(r"(.+?)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Noise:
    """The differences between one measured quantity and the identified model.

    Attributes:
        column: A field of the sensor's message, with an index ``[i]`` if the field is a vector.
        deviation: Standard deviation of the part that changes from sample to sample; includes jitter of sampling times.
        quantum: Step between neighbouring readings; 0 if readings have no step.
        bias: Standard deviation of the part that is constant over a segment.
    """

    column: str
    unit: str
    deviation: float
    quantum: float
    bias: float

    def __post_init__(self) -> None:
        """Check the numbers, which can come from a file."""
        sizes = (self.deviation, self.quantum, self.bias)
        check(all(math.isfinite(s) and s >= 0.0 for s in sizes), f"{self.column}: noise of {sizes}")

    @property
    def place(self) -> tuple[str, int | None]:
        """The field of the message, and the index in it; None if the field is a number."""
        name, index = _COLUMN.fullmatch(self.column).groups()  # type: ignore[union-attr]  # .+? matches any name
        return name, None if index is None else int(index)


Outcome = Literal["chosen", "mends", "no gain", "not reached", "not fitted"]


@dataclass(frozen=True)
class TriedTerm:
    """Errors on held-out parts without and with a term.

    Attributes:
        without: Root mean square without the term [deviations of a measurement].
        error: The same with the term; None if the set was not fitted, because less than 5 % of gain was predicted.
        outcome: ``chosen``; ``mends`` if the error falls by more than 5 %; ``not reached`` of a limit without effect.
    """

    term: str
    without: float
    error: float | None
    outcome: Outcome

    @property
    def gain(self) -> float | None:
        """By which share the term lowers the error."""
        return None if self.error is None or not self.without > 0.0 else 1.0 - self.error / self.without


def tried_table(rows: Sequence[TriedTerm]) -> ArtifactTable:
    """Return a row for each term."""
    cells = [
        [r.term, r.without, "" if r.error is None else r.error, "" if r.gain is None else f"{r.gain:.0%}", r.outcome]
        for r in rows
    ]
    return ArtifactTable(("term tried", "error without", "error with", "gain", "outcome"), cells)


@dataclass(frozen=True)
class Quantity:
    """The mean of the estimates of one quantity from each recording alone.

    Attributes:
        standard_error: Of the mean.
        between: Deviation between recordings, beyond their standard errors.
        low95: Lower end of the 95 % interval for a further recording.
        agree: Whether the standard errors explain the differences between the estimates.
    """

    name: str
    unit: str
    mean: float
    standard_error: float
    between: float
    low95: float
    high95: float
    agree: bool


ErrorKind = Literal["ahead", "free run"]
AHEAD: ErrorKind = "ahead"
FREE_RUN: ErrorKind = "free run"
HELD_OUT = "held-out data"
"""The held-out data of all recordings together."""
MAX_ERROR_RATIO = 1.25
"""Largest ratio of an error to the expected error that does not count as exceeded."""


@dataclass(frozen=True)
class ExpectedError:
    """The error to expect of a position on later data: 1.25 times its worst error on held-out data.

    Attributes:
        column: The position among the measured fields, such as ``position[1]``.
        name: Its name for people.
        kind: ``ahead``: windows of a horizon, each from a state of its own; ``free run``: one run.
        seconds: The horizon, or the length of the run [s].
        error: Root mean square, for motion like the fitted one.
    """

    column: str
    name: str
    unit: str
    kind: ErrorKind
    seconds: float
    error: float

    @property
    def how(self) -> str:
        """The horizon, or the free run, as text."""
        return _how(self.kind, self.seconds)


@dataclass(frozen=True)
class ComparedError:
    """An error on data that was not fitted, beside the expected one.

    Attributes:
        source: The predicted data: all held-out data, the held-out end of a log, or a log.
        error: Root mean square error; None if the model diverges.
        expected: None if there were too few held-out parts.
        wider: Factor in ``expected`` for a motion that is faster or goes further than the fitted one.
        beaten_by: Baselines with an error that is not larger.
        baselines: Model -> its error; None if it diverges.
    """

    source: str
    column: str
    name: str
    unit: str
    kind: ErrorKind
    seconds: float
    error: float | None
    expected: float | None = None
    wider: float = 1.0
    beaten_by: tuple[str, ...] = ()
    baselines: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def ratio(self) -> float | None:
        """The error over the expected error; None without one."""
        return None if self.expected is None else math.inf if self.error is None else self.error / self.expected

    @property
    def exceeded(self) -> bool:
        """Whether the error is above the expected error by more than ``MAX_ERROR_RATIO``."""
        return self.ratio is not None and self.ratio > MAX_ERROR_RATIO

    def __str__(self) -> str:
        """Return the error and the expected error as a sentence."""
        size = "diverges" if self.error is None else f"is off by {with_small_unit(self.error, self.unit)}"
        text = f"{self.name} {size} {_how(self.kind, self.seconds)} on {self.source}"
        if self.expected is None or self.ratio is None:
            return text
        times = "" if self.error is None else f", {self.ratio:.3g} times as much"
        return f"{text}, where {with_small_unit(self.expected, self.unit)} were expected{times}"


def _how(kind: ErrorKind, seconds: float) -> str:
    return f"{seconds:.3g} s ahead" if kind == AHEAD else f"in a free run of {seconds:.3g} s"


def compared_table(rows: Sequence[ComparedError], source: str) -> ArtifactTable:
    """Return a row for each error, with those of the baselines if there are some; ``source`` heads the data's names."""
    models = list(dict.fromkeys(model for row in rows for model in row.baselines))
    cells = [
        [
            *(r.name, r.source, f"{r.seconds:.3g} s {'ahead' if r.kind == AHEAD else r.kind}", r.unit),
            *(r.baselines.get(m) for m in models),
            *(math.inf if r.error is None else r.error, r.expected, "" if r.ratio is None else f"{r.ratio:.2f}"),
        ]
        for r in rows
    ]
    return ArtifactTable(("joint", source, "predicted", "unit", *models, "error", "expected", "ratio"), cells)


_WINDOW_S = 1.0
_UNEXPLAINED = 0.5
"""Share of a joint's motion from which an error means that the model does not explain the second."""
_SMALLER = {"rad": "mrad", "m": "mm", "s": "ms"}
"""Unit -> a thousandth of it, for errors below 1."""


@dataclass(frozen=True)
class WorstSecond:
    """The worst second of the joint that the identified model explains worst.

    Attributes:
        column: Its position's name among the columns of the samples.
        begin_s: Start of the second in the recording [s].
        end_s: Its end [s]; a shorter segment has a shorter one.
        rmse: Root mean square of the residual in it; None if the model diverges.
        of_motion: The same as a share of the motion, the deviation of all measured positions of the joint in the
            recording; None if the model diverges.
    """

    name: str
    column: str
    unit: str
    recording: int
    segment: int
    begin_s: float
    end_s: float
    rmse: float | None
    of_motion: float | None

    @property
    def unexplained(self) -> bool:
        """Whether the model does not explain this second: a fault of the log, of the robot or of the model."""
        return self.of_motion is None or self.of_motion >= _UNEXPLAINED

    @property
    def error(self) -> str:
        """The error with its unit."""
        return "the model diverges" if self.rmse is None else with_small_unit(self.rmse, self.unit)

    def text(self, logs: Sequence[Source]) -> str:
        """Return joint, time and error on one line; of several recordings with the name of its file."""
        log = logs[self.recording].path.replace("\\", "/").rsplit("/", 1)[-1] if len(logs) > 1 else ""
        at = f"{self.begin_s:.1f} s" + (f" of {log}" if log else "")
        return f"joint {self.name}, {at}, {self.error}"


def with_small_unit(value: float, unit: str) -> str:
    """Return an error with its unit, below 1 rad, m or s in thousandths."""
    if unit in _SMALLER and abs(value) < 1.0:
        value, unit = 1e3 * value, _SMALLER[unit]
    return f"{value:.{max(2, len(str(int(abs(value)))))}g} {unit}".rstrip()


def worst_window(t_s: np.ndarray, squares: np.ndarray) -> tuple[float, float, float]:
    """Return begin [s], end [s] and root mean square error of the worst second; infinite if an error is not finite.

    Args:
        t_s: Times ``(N,)`` [s].
        squares: Squared errors ``(N,)``.
    """
    if not np.isfinite(squares).all():
        bad = int(np.flatnonzero(~np.isfinite(squares))[0])
        last = np.searchsorted(t_s, t_s[bad] + _WINDOW_S, side="right") - 1
        return float(t_s[bad]), float(t_s[last]), math.inf
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    # Windows begin at each sample that has a whole second after it, and at the first sample of shorter series.
    first = np.flatnonzero(t_s <= max(float(t_s[-1]) - _WINDOW_S, float(t_s[0])) + 1e-9)
    after = np.searchsorted(t_s, t_s[first] + _WINDOW_S + 1e-9, side="right")
    means = (sums[after] - sums[first]) / (after - first)
    worst = int(means.argmax())
    return float(t_s[first[worst]]), float(t_s[after[worst] - 1]), math.sqrt(max(float(means[worst]), 0.0))


@dataclass(frozen=True)
class Ranged:
    """A number with its 95 % interval; None if the log does not determine it."""

    value: float | None
    low95: float | None
    high95: float | None


@dataclass(frozen=True)
class Link:
    """The delay of a link, estimated from the motion.

    Attributes:
        name: The delay's parameter.
        parts: Delays whose sum has this mean and 95th percentile, as a log of motion determines only their sum; the
            link's name alone if the log determines its delay alone.
        mean: Mean of the sum in the middle of a recording [s].
        deviation: Standard deviation of this link's delay alone [s].
        p95: 95th percentile of the sum [s].
        lost: Share of lost messages: their reader uses the previous message again.
        delays: Shape ``(K,)``: values of the sum [s].
        share: Shape ``(K,)``: share of the messages with each of these values.
    """

    name: str
    parts: tuple[str, ...]
    mean: Ranged
    deviation: Ranged
    p95: Ranged
    lost: Ranged
    delays: np.ndarray
    share: np.ndarray


def links_table(links: Sequence[Link]) -> ArtifactTable:
    """Return a row for each number of a link that the log determines."""
    rows = []
    for link in links:
        total = " + ".join(link.parts)
        numbers = [
            (f"{total}, mean", link.mean, 1e3, "ms"),
            (f"{total}, 95 % of the messages", link.p95, 1e3, "ms"),
            (f"{link.name}, deviation", link.deviation, 1e3, "ms"),
            (f"{link.name}, lost", link.lost, 100.0, "%"),
        ]
        for label, r, factor, unit in numbers:
            if r.value is not None:
                ends = (None if end is None else factor * end for end in (r.low95, r.high95))
                rows.append([label, factor * r.value, Interval(*ends), unit])
    return ArtifactTable(("link", "estimate", "95 % interval", "unit"), rows)


@dataclass(frozen=True, repr=False)
class Identification(Shown):
    """The result of identify.

    Attributes:
        logs: The fitted recordings, then the recordings that are held out whole.
        errors: Errors of each position on held-out data: on all of it, beside baselines, up to each of several
            horizons, the worst joint first; then ahead and in a free run of each recording, beside the expected errors.
        expected_error: The error to expect of each position on later data, ahead and in a free run; the joint with the
            largest one beside its noise comes first.
        worst: The second in which the model explains a joint worst; None without samples.
        aggregate: Quantities estimated from each of several recordings alone; empty for one recording.
        motion: Column -> lowest and highest position, and largest speed, in the fitted segments.
        tried: What optional terms gain on held-out parts; empty if none was tried.
        terms: Optional terms of the model in the fit; None if the model has no optional terms.
        noise: Noise of the sensor.
        widening: Factor on the posterior's deviations that covers errors of the model; None without a posterior.
        settle_s: Length of the first part of a held-out segment, to which its initial state is fitted [s].
        world: Name of the simulated world; None for the robot's own.
        posterior: Distribution from which training draws robots; None after an interrupted search.
        samples: Columns of the segments ``(N,)``: ``t``, ``into`` (since the segment's start) [s], ``segment``,
            ``recording``, ``held_out``, and ``FIELD_measured`` and ``FIELD_MODEL`` of each field, of the
            models ``identified``, ``no delay`` (fitted without delays) and ``nominal``.
        free: The same columns of the free runs; empty without free runs.
        replays: Initial states and commands of held-out segments and free runs.
        timing: Timing of the first recording, from which training draws its delays; None if only the estimates exist.
    """

    pipeline: str
    logs: tuple[Source, ...]
    verdict: Judgement
    parameters: tuple[Estimate, ...]
    errors: tuple[ComparedError, ...] = ()
    expected_error: tuple[ExpectedError, ...] = ()
    worst: WorstSecond | None = None
    aggregate: tuple[Quantity, ...] = ()
    motion: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    tried: tuple[TriedTerm, ...] = ()
    terms: tuple[str, ...] | None = None
    links: tuple[Link, ...] = ()
    noise: tuple[Noise, ...] = ()
    widening: float | None = None
    settle_s: float = 0.0
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
        """Return a row for each parameter; of the delays their sum alone, which is what a log determines.

        Only an embedded robot has the columns of the truth.
        """
        summed = any(p.name == ROUND_TRIP for p in self.parameters)
        known = any(p.truth is not None for p in self.parameters)
        rows = [
            [
                *(p.name, p.estimate, Interval(p.low95, p.high95), p.unit, p.nominal),
                *((p.truth, _off(p)) if known else ()),
                p.verdict,
            ]
            for p in self.parameters
            if not p.absent and not (summed and p.kind == "delay")
        ]
        truth = ("truth", "off by") if known else ()
        return ArtifactTable(("parameter", "estimate", "95 % interval", "unit", "nominal", *truth, "verdict"), rows)

    def recordings_table(self) -> ArtifactTable:
        """Return a row for each quantity that is estimated from each recording alone."""
        rows = [
            [q.name, q.mean, q.standard_error, Interval(q.low95, q.high95), q.unit, q.between, q.agree]
            for q in self.aggregate
        ]
        return ArtifactTable(("over recordings", "mean", "s.e.", "95 % of the next", "unit", "spread", "agree"), rows)

    @property
    def held_out(self) -> tuple[ComparedError, ...]:
        """The errors on all held-out data up to the longest horizon, the worst joint first."""
        rows = [e for e in self.errors if (e.source, e.kind) == (HELD_OUT, AHEAD)]
        longest_s = max((e.seconds for e in rows), default=0.0)
        return tuple(e for e in rows if e.seconds == longest_s)

    @property
    def judged(self) -> tuple[ComparedError, ...]:
        """The errors beside an expected one, the largest ratio first; then those beside baselines alone."""
        compared = sorted((e for e in self.errors if e.ratio is not None), key=lambda e: -(e.ratio or 0.0))
        return (*compared, *(e for e in self.held_out if e.ratio is None))

    def outlook(self) -> str:
        """Return the expected errors of the joint with the largest one beside its noise, as text."""
        if not self.expected_error:
            return "unknown, as there are too few held-out parts, or a prediction of one diverged"
        first, joints = self.expected_error[0], {e.column for e in self.expected_error}
        own = [f"{with_small_unit(e.error, e.unit)} {e.how}" for e in self.expected_error if e.column == first.column]
        which = f", the worst of {len(joints)} joints" if len(joints) > 1 else ""
        return f"{first.name} {', '.join(own)}{which}"

    def expected_of(self, column: str, kind: ErrorKind) -> ExpectedError | None:
        """Return the expected error of a position; None if there is none."""
        return next((e for e in self.expected_error if (e.column, e.kind) == (column, kind)), None)

    def errors_table(self) -> ArtifactTable:
        """Return a row for each error on held-out data that is judged."""
        return compared_table(self.judged, "held out")

    def needed_posterior(self, hint: str = "") -> Posterior:
        """Return the posterior.

        Args:
            hint: Of the error, where the verdict has no next command.

        Raises:
            Sim2RealError: The fit did not finish, so there is none.
        """
        if self.posterior is None:
            ended = "did not finish" if self.verdict.status == "not finished" else "has no intervals"
            raise Sim2RealError(
                f"this identification {ended}: its estimates may be far off", hint=self.verdict.next or hint or None
            )
        return self.posterior

    @property
    def values(self) -> dict[str, float]:
        """Parameter -> estimate, without derived parameters."""
        return {p.name: p.estimate for p in self.parameters if p.kind != "derived"}

    @property
    def intervals(self) -> dict[str, tuple[float | None, float | None]]:
        """Parameter -> its 95 % interval; None where it is unknown."""
        return {p.name: (p.low95, p.high95) for p in self.parameters}

    @property
    def fields(self) -> list[str]:
        """The measured fields."""
        return [n.removesuffix("_measured") for n in self.samples if n.endswith("_measured")]

    @property
    def recordings(self) -> list[int]:
        """Numbers of the recordings in ``samples``."""
        return np.unique(self.samples["recording"]).tolist() if self.samples else []

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
        verdict = replace(self.verdict, next=self.verdict.next.replace(shown(path.parent.parent), _RUN))
        write_json(path, replace(self, verdict=verdict), without=("samples", "free", "replays", "timing"))

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
        if file.is_file() and file.suffix != ".json":
            raise Sim2RealError(
                f"{file} is no identification, which is a {PARAMETERS} or the folder of an identify stage",
                hint="a policy is no identification: sim2real deploy takes its bundle"
                if file.suffix == ".onnx"
                else "name runs/PIPELINE/TIME/identify",
            )
        # Read the estimates, then the samples and the timing if their files exist.
        identification = read_versioned(file, Identification, _AGAIN, FORMAT)
        with malformed(file, _AGAIN):
            check(all(np.isfinite(p.estimate) for p in identification.parameters), "an estimate is no number")
        following = identification.verdict.next.replace(_RUN, shown(file.parent.parent))
        identification = replace(identification, verdict=replace(identification.verdict, next=following))
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
