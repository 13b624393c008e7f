"""The result of identify: ``parameters.json``, predictions, free runs, and the timing of the recording."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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

FORMAT = 6
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
    """One identified parameter; a number is None if it does not exist, is infinite or unknown.

    Attributes:
        name: Name of the parameter.
        kind: Kind of the parameter; the round trip is ``derived`` from the delays.
        nominal: The data sheet's value.
        low95: Lower end of the 95 % interval.
        lower: Lower bound of the search.
        state: ``ok``, ``at a bound``, ``not determined`` or ``fixed``; in a fit that is not accepted no parameter is
            ``ok``.
        truth: The value in the embedded robot.
    """

    name: str
    unit: str
    kind: Literal["dynamics", "delay", "measurement", "derived"]
    about: str
    nominal: float | None
    estimate: float
    state: str
    standard_error: float | None = None
    low95: float | None = None
    high95: float | None = None
    lower: float | None = None
    upper: float | None = None
    truth: float | None = None

    @property
    def absent(self) -> bool:
        """Whether it is a limit that the model lacks, because no motion reaches it; tables omit it."""
        return self.state == "fixed" and self.estimate == self.nominal == _NO_LIMIT


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


_USE = {
    "accepted": "these parameters may be used",
    "record again": "this log does not determine all parameters",
    "change the model": "do not use these parameters yet",
    "not finished": "these parameters are no estimates yet",
}
"""Status -> whether the parameters may be used."""
_FIELD = re.compile(r"(.+?)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Noise:
    """The noise of one measured quantity.

    Attributes:
        field: A field of the sensor's message, with an index ``[i]`` if the field is a vector.
        deviation: Standard deviation of noise from sample to sample; includes jitter of sampling times.
        resolution: Step between neighbouring readings; 0 if readings have no step.
        offset: Standard deviation of an error that is constant over a segment.
    """

    field: str
    unit: str
    deviation: float
    resolution: float
    offset: float

    def __post_init__(self) -> None:
        """Check the numbers, because they may come from a file."""
        sizes = (self.deviation, self.resolution, self.offset)
        check(all(math.isfinite(s) and s >= 0.0 for s in sizes), f"{self.field}: noise of {sizes}")

    @property
    def place(self) -> tuple[str, int | None]:
        """The field of the message, and the index in it; None if the field is a number."""
        name, index = _FIELD.fullmatch(self.field).groups()  # type: ignore[union-attr]  # .+? matches any name
        return name, None if index is None else int(index)


@dataclass(frozen=True)
class Term:
    """An optional term of the model.

    Attributes:
        used: Whether the model has it.
        gain: By which share it lowers the errors on held-out parts, together with the other used terms; negative if it
            harms; None if it was not tried.
    """

    name: str
    used: bool
    gain: float | None = None


def terms_table(terms: Sequence[Term]) -> ArtifactTable:
    """Return a row for each optional term."""
    cells = [[t.name, t.used, "" if t.gain is None else f"{t.gain:.0%}"] for t in terms]
    return ArtifactTable(("term", "used", "gain"), cells)


@dataclass(frozen=True)
class OverLogs:
    """The mean of the estimates of one parameter from each log alone.

    Attributes:
        standard_error: Standard error of the mean.
        spread: Standard deviation between logs, in addition to their standard errors.
        low95: Lower end of the 95 % interval for a further log.
    """

    name: str
    unit: str
    mean: float
    standard_error: float
    spread: float
    low95: float
    high95: float


WITHOUT_DELAYS, STANDING_STILL, GOAL = "without delays", "standing still", "goal"
"""Further baselines: the model fitted without delays, the last measurement, and the joint's goal."""


@dataclass(frozen=True)
class ExpectedError:
    """The error to expect of a joint on later data: 1.25 times its worst error on held-out parts.

    Attributes:
        seconds: Horizon of the prediction, or length of the free run [s].
        error: Root mean square error, for motion like the fitted one.
        free_run: Whether the log is predicted from one state; otherwise in windows, each from its own state.
    """

    joint: str
    unit: str
    seconds: float
    error: float
    free_run: bool = False

    @property
    def how(self) -> str:
        """The horizon, or the free run, as text."""
        return _how(self.seconds, self.free_run)


def _how(seconds: float, free_run: bool) -> str:
    return f"in a free run of {seconds:.3g} s" if free_run else f"{seconds:.3g} s ahead"


@dataclass(frozen=True)
class ComparedError:
    """The error of a joint on data that was not fitted, with the expected error and the errors of baselines.

    Attributes:
        log: The predicted log; "": all held-out parts together.
        seconds: Horizon of the prediction, or length of the free run [s].
        error: Root mean square error; None if the model diverges.
        expected: The expected error, larger for a motion that is faster or goes further than the fitted one; None if
            there were too few held-out parts.
        baselines: Baseline -> its error; None if it diverges.
        as_good: The baselines that are as good.
        field: The joint's field among the columns of samples.
    """

    log: str
    joint: str
    unit: str
    seconds: float
    error: float | None
    free_run: bool = False
    expected: float | None = None
    baselines: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    as_good: tuple[str, ...] = ()
    field: str = ""

    @property
    def ratio(self) -> float | None:
        """The error divided by the expected error; None without an expected error."""
        return None if self.expected is None else math.inf if self.error is None else self.error / self.expected

    @property
    def exceeded(self) -> bool:
        """Whether the error is above the expected error."""
        return self.ratio is not None and self.ratio > 1.0

    def __str__(self) -> str:
        return self.text(self.log or "held-out parts")

    def text(self, where: str) -> str:
        """Return the error and the expected error as a sentence.

        Args:
            where: The predicted data.
        """
        size = "diverges" if self.error is None else f"is off by {with_small_unit(self.error, self.unit)}"
        text = f"{self.joint} {size} {_how(self.seconds, self.free_run)} on {where}"
        if self.expected is None or self.ratio is None:
            return text
        times = "" if self.error is None else f", {self.ratio:.3g} times as much"
        return f"{text}, where {with_small_unit(self.expected, self.unit)} were expected{times}"


def compared_table(rows: Sequence[ComparedError]) -> ArtifactTable:
    """Return a row for each error, with the errors of the baselines if there are any."""
    models = list(dict.fromkeys(model for row in rows for model in row.baselines))
    cells = [
        [
            *(r.joint, r.log or "all", f"{r.seconds:.3g} s {'free run' if r.free_run else 'ahead'}", r.unit),
            *(r.baselines.get(m) for m in models),
            *(math.inf if r.error is None else r.error, r.expected, "" if r.ratio is None else f"{r.ratio:.2f}"),
        ]
        for r in rows
    ]
    return ArtifactTable(("joint", "log", "predicted", "unit", *models, "error", "expected", "ratio"), cells)


_WINDOW_S = 1.0
_UNEXPLAINED = 0.5
"""The model does not explain a second if its error is at least this share of the joint's motion."""
_SMALLER = {"rad": "mrad", "m": "mm", "s": "ms"}
"""Unit -> its thousandth, for errors below 1."""


@dataclass(frozen=True)
class WorstSecond:
    """The second in which the identified model predicts a joint worst.

    Attributes:
        field: The joint's field among the columns of the samples.
        log: The name of the log.
        begin_s: Start of the second in the log [s].
        end_s: End of the second in the log [s]; in a short segment it is shorter.
        error: Root mean square error in the second; None if the model diverges.
        share_of_motion: The error divided by the standard deviation of the joint's positions in the log; None if the
            model diverges.
    """

    joint: str
    field: str
    unit: str
    log: str
    begin_s: float
    end_s: float
    error: float | None
    share_of_motion: float | None

    @property
    def unexplained(self) -> bool:
        """Whether the model does not explain this second: a fault of the log, of the robot or of the model."""
        return self.share_of_motion is None or self.share_of_motion >= _UNEXPLAINED

    def __str__(self) -> str:
        """Return joint, time and error on one line."""
        size = "the model diverges" if self.error is None else with_small_unit(self.error, self.unit)
        return f"joint {self.joint}, {self.begin_s:.1f} s of {self.log}, {size}"


def with_small_unit(value: float, unit: str) -> str:
    """Return an error with its unit; below 1 rad, m or s in mrad, mm or ms."""
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
        name: Name of the delay's parameter; or names joined by ``+``, as a log determines only the sum.
        mean: Mean delay [s].
        deviation: Standard deviation [s].
        p95: 95th percentile [s].
        lost: Share of lost messages, in whose place the reader uses the previous message again.
        delays: Shape ``(K,)``: values [s].
        share: Shape ``(K,)``: share of the messages with each of these values.
    """

    name: str
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
        numbers = [
            ("mean", link.mean, 1e3, "ms"),
            ("95 % of the messages", link.p95, 1e3, "ms"),
            ("deviation", link.deviation, 1e3, "ms"),
            ("lost", link.lost, 100.0, "%"),
        ]
        for label, r, factor, unit in numbers:
            if r.value is not None:
                ends = (None if end is None else factor * end for end in (r.low95, r.high95))
                rows.append([f"{link.name}, {label}", factor * r.value, Interval(*ends), unit])
    return ArtifactTable(("link", "estimate", "95 % interval", "unit"), rows)


@dataclass(frozen=True)
class Internal:
    """Numbers with which later stages predict.

    Attributes:
        motion: Joint -> lowest and highest position, and largest speed, in the fitted segments.
        settle_s: Length of the first part of a held-out segment, to which its initial state is fitted [s].
        world: Name of the simulated world; None for the robot's own.
    """

    motion: Mapping[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
    settle_s: float = 0.0
    world: str | None = None


@dataclass(frozen=True, repr=False)
class Identification(Shown):
    """The result of identify.

    Attributes:
        logs: The fitted logs, then the logs that are held out whole.
        errors: Errors of each joint on held-out parts: first on all parts together, with baselines, up to each of
            several horizons, the worst joint first; then on each log, ahead and in a free run, with expected errors.
        expected_error: The error to expect of each joint on later data, ahead and in a free run; the joint with the
            largest error relative to its noise comes first.
        worst: The worst second; None without samples.
        over_logs: Parameters estimated from each of several logs alone; empty for one log.
        terms: The optional terms that the model has, or that were tried; None if there are none.
        noise: Noise of the sensor.
        units: Field -> unit.
        posterior: Distribution from which training draws robots; None after an interrupted search.
        samples: Columns of the segments ``(N,)``: ``t``, ``into`` (since the segment's start) [s], ``segment``,
            ``recording``, ``held_out``, ``worst`` (whether it is in the worst second), and ``FIELD_measured`` and
            ``FIELD_MODEL`` of each field, of the models ``identified``, ``without delays`` and ``nominal``.
        free: The same columns of the free runs; empty without free runs.
        replays: Initial states and commands of held-out segments and free runs.
        timing: Timing of the first log, from which training draws its delays; None if only the estimates exist.
    """

    pipeline: str
    logs: tuple[Source, ...]
    verdict: Judgement
    parameters: tuple[Estimate, ...]
    errors: tuple[ComparedError, ...] = ()
    expected_error: tuple[ExpectedError, ...] = ()
    worst: WorstSecond | None = None
    over_logs: tuple[OverLogs, ...] = ()
    terms: tuple[Term, ...] | None = None
    links: tuple[Link, ...] = ()
    noise: tuple[Noise, ...] = ()
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    posterior: Posterior | None = None
    internal: Internal = Internal()
    samples: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    free: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    replays: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    timing: Timing | None = None
    format: int = FORMAT

    @property
    def headline(self) -> str:
        """The status, and whether the parameters may be used."""
        status = self.verdict.status
        if status == "accepted" and self.worst is not None and self.worst.unexplained:
            return "accepted, but the model does not explain one second: look at it before you use these parameters"
        return f"{status}: {_USE[status]}" if status in _USE else status

    def about(self) -> Mapping[str, Json]:
        """Return pipeline, verdict, reasons, the next command and the number of parameters, by name."""
        facts = {"pipeline": self.pipeline, "verdict": self.verdict.status, "why": "; ".join(self.verdict.reasons)}
        facts |= {"worst": str(self.worst or ""), "next": self.verdict.next, "parameters": len(self.parameters)}
        return {name: value for name, value in facts.items() if value}

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter; for the delays only their sum, which a log determines.

        Only for an embedded robot there are columns with the truth.
        """
        summed = any(p.name == ROUND_TRIP for p in self.parameters)
        known = any(p.truth is not None for p in self.parameters)
        rows = [
            [
                *(p.name, p.estimate, Interval(p.low95, p.high95), p.unit, p.nominal),
                *((p.truth, _from_truth(p)) if known else ()),
                p.state,
            ]
            for p in self.parameters
            if not p.absent and not (summed and p.kind == "delay")
        ]
        truth = ("truth", "from the truth") if known else ()
        return ArtifactTable(("parameter", "estimate", "95 % interval", "unit", "nominal", *truth, "state"), rows)

    def logs_table(self) -> ArtifactTable:
        """Return a row for each parameter that is estimated from each log alone."""
        rows = [[q.name, q.mean, Interval(q.low95, q.high95), q.unit, q.spread] for q in self.over_logs]
        return ArtifactTable(("over the logs", "mean", "95 % of the next", "unit", "spread"), rows)

    @property
    def held_out(self) -> tuple[ComparedError, ...]:
        """The errors on all held-out parts up to the longest horizon, the worst joint first.

        Joints for which a baseline is as good come first, then the others by the ratio of error to expected error.
        """
        rows = [e for e in self.errors if not e.log]
        longest_s = max((e.seconds for e in rows), default=0.0)
        rows = [e for e in rows if e.seconds == longest_s]
        return tuple(sorted(rows, key=lambda e: (not e.as_good, -(e.ratio or 0.0))))

    @property
    def judged(self) -> tuple[ComparedError, ...]:
        """The errors with an expected error, the largest ratio first; then errors with baselines only."""
        compared = sorted((e for e in self.errors if e.ratio is not None), key=lambda e: -(e.ratio or 0.0))
        return (*compared, *(e for e in self.held_out if e.ratio is None))

    def outlook(self) -> str:
        """Return the expected errors of the joint whose expected error is largest relative to its noise, as text."""
        if not self.expected_error:
            return "unknown, as there are too few held-out parts, or a prediction of one diverged"
        first, joints = self.expected_error[0], {e.joint for e in self.expected_error}
        own = [f"{with_small_unit(e.error, e.unit)} {e.how}" for e in self.expected_error if e.joint == first.joint]
        which = f", the worst of {len(joints)} joints" if len(joints) > 1 else ""
        return f"{first.joint} {', '.join(own)}{which}, for motion like the fitted one"

    def expected_of(self, joint: str, free_run: bool = False) -> ExpectedError | None:
        """Return the expected error of a joint; None if there is none."""
        return next((e for e in self.expected_error if (e.joint, e.free_run) == (joint, free_run)), None)

    @property
    def used_terms(self) -> tuple[str, ...] | None:
        """Names of the optional terms that the model has; None if there are no optional terms."""
        return None if self.terms is None else tuple(t.name for t in self.terms if t.used)

    def needed_posterior(self, hint: str = "") -> Posterior:
        """Return the posterior.

        Args:
            hint: Hint of the error, if the verdict has no next command.

        Raises:
            Sim2RealError: The fit did not finish, so there is no posterior.
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
        """Parameter -> its 95 % interval; None at an unknown end."""
        return {p.name: (p.low95, p.high95) for p in self.parameters}

    @property
    def fields(self) -> list[str]:
        """The measured fields."""
        return [n.removesuffix("_measured") for n in self.samples if n.endswith("_measured")]

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
        # The other files may be missing, so that a copy of the estimates alone can be read.
        others: dict[str, Json] = {}
        if file.with_name(TIMING).is_file():
            others["timing"] = Timing.load(file.with_name(TIMING))
        for name, samples_file in (("samples", PREDICTIONS), ("free", FREE_RUNS), ("replays", REPLAYS)):
            if (samples_path := file.with_name(samples_file)).is_file():
                with malformed(samples_path, _AGAIN):
                    others[name] = (dict if name == "replays" else _columns)(read_arrays(samples_path))
        return replace(identification, **others)


def _from_truth(p: Estimate) -> str:
    """Return how far an estimate is from the truth, in percent; in its unit if the truth is 0."""
    if p.truth is None:
        return ""
    return f"{100 * (p.estimate - p.truth) / abs(p.truth):+.1f} %" if p.truth else f"{p.estimate:+.2g} {p.unit}"


def _columns(samples: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns after checking that all have the same number of values, at least one."""
    missing = set(_COLUMNS) - set(samples)
    check(not missing, f"no {', '.join(sorted(missing))}")
    wrong = [n for n, v in samples.items() if v.ndim != 1 or v.shape != samples["t"].shape]
    check(not wrong, f"not one value a sample: {', '.join(wrong)}")
    check(samples["t"].size > 0, "no sample")
    return samples
