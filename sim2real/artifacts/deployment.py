"""The result of deploy: a row for each episode on the robot, tests of the model on the logs, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Literal, TypeAlias

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
from sim2real.artifacts.identification import ComparedError
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.summary import ArtifactTable, Interval, Shown, words_and_unit
from sim2real.types import Json

FORMAT = 5
RESULT, SIMULATION = "result.json", "simulation.npz"
PROBE = "probe.mcap"
"""Log of the small steps that measure the delay before the episodes."""
AS_HERE = "as in this log"
"""Name of the model whose parameters were fitted to the deployment's logs."""
_AGAIN = "run `sim2real deploy` again"
_RUN = "{run}"
"""Placeholder for the run's folder in the next command, because the folder may move."""


# -- the episodes on the robot and in simulation


@dataclass(frozen=True)
class EpisodeRow:
    """One episode on the robot. A score is None if it does not exist, such as the time to a missed goal.

    Attributes:
        real: Scores on the robot: name -> value.
        simulation: Scores of the same episode in simulation, means over its simulations; empty without simulations.
        late: Node -> share of the steps that take longer than in training.
        paused_s: Time that the slowest node lost in steps of two periods or more [s].
    """

    real: Mapping[str, float | None]
    simulation: Mapping[str, float | None] = field(default_factory=dict)
    late: Mapping[str, float] = field(default_factory=dict)
    paused_s: float = 0.0


@dataclass(frozen=True)
class Gap:
    """One score on the robot and in simulation; its name ends with its unit."""

    quantity: str
    real: float | None
    simulation: float | None

    @property
    def gap(self) -> float | None:
        """The robot's value minus the value in simulation."""
        return None if self.real is None or self.simulation is None else self.real - self.simulation


# -- the tests of the model


_MIN_SHARE = 0.5
"""A change may be the cause if it explains at least this share of what the best change explains."""
_MAX_CHANCE = 0.1
"""A single change is reported as likely if its probability by chance is lower."""


@dataclass(frozen=True)
class Changed:
    """A possible change of a robot: of a parameter, of the sum of the delays, or of a cause that changes several.

    Attributes:
        unit: Unit of ``before`` and ``now``; "" for a cause, for which they are factors.
        before: The estimate.
        now: The value that fits the later log best if nothing else has changed.
        low95: Lower end of the 95 % interval of ``now``; it includes the uncertainty of the estimate.
        explains: Share of the error that the change removes, beyond the uncertainty of the estimate.
        p: Probability of such a share by chance; not corrected for several tests.
    """

    name: str
    unit: str
    before: float
    now: float
    low95: float
    high95: float
    explains: float
    p: float

    def __str__(self) -> str:
        if self.unit == "":
            return f"{self.name} is {self.now:.2f} times its former value [{self.low95:.2f}, {self.high95:.2f}]"
        now, ends = f"{self.now:.4g} {self.unit}", f"[{self.low95:.4g}, {self.high95:.4g}]"
        return f"{self.name} is {now} {ends}, identified were {self.before:.4g}"


@dataclass(frozen=True)
class Drift:
    """The result of the drift test on a later log.

    Attributes:
        changes: Possible changes, the largest ``explains`` first.
        level: False-alarm rate of all tests together, per log.
        alarms: Names of the changes that are significant at this level (Holm) and explain at least 0.1 of the error,
            the smallest ``p`` first.
        seconds: Length of the tested part of the log, in which the robot moves [s].
    """

    changes: tuple[Changed, ...]
    level: float
    alarms: tuple[str, ...]
    seconds: float

    @property
    def named(self) -> Changed | None:
        """The change with the smallest ``p``, of the significant changes that explain much; None without an alarm.

        The largest ``explains`` may belong to another parameter: if the model lacks a part of the friction, more
        friction explains some of the error of every motion.
        """
        significant = [c for c in self.changes if c.name in self.alarms]
        largest = max((c.explains for c in significant), default=0.0)
        return min((c for c in significant if c.explains >= _MIN_SHARE * largest), key=lambda c: c.p, default=None)

    @property
    def likely(self) -> Changed | None:
        """The likely change if no test raises an alarm; None if no change explains half of the error."""
        if self.alarms or not self.changes:
            return None
        best = self.changes[0]
        return best if best.explains > _MIN_SHARE and best.p < _MAX_CHANCE else None

    def rows(self) -> ArtifactTable:
        """Return a row for each possible change."""
        headers = ("changed alone", "identified", "now", "95 % interval", "unit", "explains", "alarm")
        rows = [
            [
                c.name,
                c.before,
                c.now,
                Interval(c.low95, c.high95),
                c.unit or "factor",
                f"{100 * c.explains:.1f} %",  # as text, because the number is not in the row's unit
                c.name in self.alarms,
            ]
            for c in self.changes
        ]
        return ArtifactTable(headers, rows)


# -- the verdict


class Finding(StrEnum):
    """Reasons of a verdict; ``Deployment.sentence`` has their texts."""

    SUCCESS = "success"
    LATE = "late steps"
    PAUSED = "pauses"
    UNEXPLAINED = "unexplained motion"
    CHANGED = "change"
    LIKELY = "likely change"
    WRONG = "wrong prediction"
    HOLDS = "model holds"
    NO_MODEL = "no model"
    OTHER_MOTION = "other motion"
    UNTESTED = "model not tested"


Status: TypeAlias = Literal["fine", "re-identify", "re-train", "look at this joint", "not judged"]


@dataclass(frozen=True)
class Reason:
    """A finding, and its subject: a joint, a node, a parameter, or why the model was not tested."""

    finding: Finding
    about: str = ""


@dataclass(frozen=True)
class Verdict:
    """The verdict on a deployment.

    Attributes:
        reasons: The reasons; the first one decided.
        stages: The stages to run next; empty if none helps, or none is needed.
        terms: The optional terms to identify with next: those of the identification, and the term of the parameter that
            changed, without which other estimates would be wrong; "" without an identification.
        next: The next command; "" if none is needed.
    """

    status: Status
    reasons: tuple[Reason, ...]
    stages: tuple[str, ...] = ()
    terms: str = ""
    next: str = ""


@dataclass(frozen=True, repr=False)
class Deployment(Shown):
    """Episodes on the robot, and the same policy in simulation.

    Attributes:
        measured_delay: The delay before the episodes, as a text; "" if it was not measured.
        replay: Error of the identified model on the recorded commands, for each measured position; with the errors of
            the nominal model, and of the model ``AS_HERE``, whose parameters were fitted to these logs.
        drift: Test for parameters that have changed since the identification; None if it did not run.
        untested: Why the model was not tested on these logs; None if it was.
        verdict: None after a dry run.
        dry_run: Whether commands were not sent: then there are no scores, no simulation and no gap.
        simulated: Columns of each episode's simulation: ``t`` [s] and values ``(N,)`` of each field; a field with other
            times has ``t_FIELD``. Empty without a simulation.
        probe: Log of the small steps that measure the delay; None if the delay was not measured.
    """

    episodes: tuple[EpisodeRow, ...]
    measured_delay: str = ""
    replay: tuple[ComparedError, ...] = ()
    drift: Drift | None = None
    untested: Reason | None = None
    verdict: Verdict | None = None
    dry_run: bool = False
    format: int = FORMAT
    simulated: tuple[Mapping[str, np.ndarray], ...] = ()
    recordings: tuple[Recording, ...] = ()
    probe: Recording | None = None

    def __post_init__(self) -> None:
        check(bool(self.episodes), "no episode")

    @property
    def gap(self) -> tuple[Gap, ...]:
        """The scores on the robot and in simulation, means over the episodes."""
        names = dict.fromkeys(name for episode in self.episodes for name in episode.real)
        return tuple(self.score(name) for name in names)

    def score(self, name: str) -> Gap:
        """Return the mean of a score over the episodes that have it."""
        real = mean([e.real.get(name) for e in self.episodes])
        return Gap(name, real, mean([e.simulation.get(name) for e in self.episodes]))

    def late_share(self, node: str) -> float:
        """Return the share of a node's steps that take longer than in training, over all episodes."""
        return mean([e.late.get(node) for e in self.episodes]) or 0.0

    @property
    def logs(self) -> tuple[Recording, ...]:
        """The logs of this deployment: its episodes, then the small steps before them."""
        return self.recordings if self.probe is None else (*self.recordings, self.probe)

    # -- for pages and the console

    def about(self) -> Mapping[str, Json]:
        """Return episodes, verdict, reasons and the next command, by name."""
        facts: dict[str, Json] = {"episodes": len(self.episodes), "dry run": self.dry_run or ""}
        if self.verdict is not None:
            facts |= {"verdict": self.verdict.status, "why": "; ".join(self.reasons), "next": self.verdict.next}
        return {name: value for name, value in facts.items() if value}

    @property
    def reasons(self) -> tuple[str, ...]:
        """The reasons of the verdict as sentences, the one that decides first."""
        return tuple(self.sentence(reason) for reason in self.verdict.reasons) if self.verdict else ()

    def sentence(self, reason: Reason) -> str:
        """Return a reason as a sentence, with the numbers of this deployment."""
        about, joint = reason.about, next((row for row in self.replay if row.joint == reason.about), None)
        changed = next((c for c in self.drift.changes if c.name == about), about) if self.drift else about
        match reason.finding:
            case Finding.SUCCESS:
                success = self.score("success")
                if success.real is None:
                    return "this task measures no success"
                beside = "" if success.simulation is None else f", in simulation {success.simulation:.2f}"
                return f"success is {success.real:.2f}{beside}"
            case Finding.LATE:
                return f"{self.late_share(about):.1%} of the steps of {about} take longer than in training"
            case Finding.PAUSED:
                most_s = max(e.paused_s for e in self.episodes)
                return f"an episode lost {most_s:.2g} s to pauses of its nodes, and no simulation has such pauses"
            case Finding.UNEXPLAINED:
                fitted = "" if joint is None else f", fitted to these logs {as_here(joint)}"
                return f"no parameters explain how {about} moves{fitted}; it may be loose, blocked, or touch something"
            case Finding.CHANGED:
                others = [name for name in self.drift.alarms if name != about] if self.drift else []
                less = f"; less likely, each alone: {', '.join(others)}" if others else ""
                return f"the robot has changed: {changed}{less}"
            case Finding.LIKELY:
                return f"most likely the robot has changed: {changed}"
            case Finding.WRONG:
                return about if joint is None else str(joint)
            case Finding.HOLDS:
                return "the model holds"
            case Finding.NO_MODEL:
                return "this run has no identification, so there is no model to compare with"
            case Finding.OTHER_MOTION:
                return f"the deployment does not test the model: {about}"
            case Finding.UNTESTED:
                return about

    def rows(self) -> ArtifactTable:
        """Return a row for each score, on the robot and in simulation."""
        words = [words_and_unit(g.quantity) for g in self.gap]
        rows = [[name, g.real, g.simulation, g.gap, unit] for g, (name, unit) in zip(self.gap, words, strict=True)]
        return ArtifactTable(("quantity", "robot", "simulation", "gap", "unit"), rows)

    # -- files

    def save(self, folder: Path | str) -> dict[str, str]:
        """Write the rows, the verdict and the simulation into a folder; the logs are in it already.

        Returns:
            Output -> name of the file in the folder.
        """
        folder = make_folder(folder)
        document = self._next_with(shown(folder.parent), _RUN)
        write_json(folder / RESULT, document, without=("simulated", "recordings", "probe"))
        if self.dry_run:
            return {"result": RESULT}
        columns = {f"{i}/{n}": v for i, episode in enumerate(self.simulated) for n, v in episode.items()}
        write_arrays(folder / SIMULATION, columns)
        return {"result": RESULT, "simulation": SIMULATION}

    def _next_with(self, old: str, new: str) -> Deployment:
        """Return the deployment with another run's folder in its next command."""
        if self.verdict is None:
            return self
        return replace(self, verdict=replace(self.verdict, next=self.verdict.next.replace(old, new)))

    @staticmethod
    def read(folder: Path) -> Deployment:
        """Read rows and verdict, without simulations and logs.

        Raises:
            Sim2RealError: When the file is missing, malformed, or of another format.
        """
        deployment = read_versioned(folder / RESULT, Deployment, _AGAIN, FORMAT)
        return deployment._next_with(_RUN, shown(folder.parent))

    @staticmethod
    def load(folder: Path | str) -> Deployment:
        """Read what ``save`` wrote, and the logs beside it.

        Raises:
            Sim2RealError: When a file is missing, malformed, or of another format.
        """
        folder = Path(folder)
        deployment = Deployment.read(folder)
        numbers = range(len(deployment.episodes))
        simulated: list[dict[str, np.ndarray]] = [{} for _ in numbers]
        if not deployment.dry_run:
            with malformed(folder / SIMULATION, _AGAIN):
                for name, values in read_arrays(folder / SIMULATION).items():
                    number, _, column = name.partition("/")
                    simulated[int(number)][column] = values
        recordings = tuple(Recording.load(log_of(folder, i)) for i in numbers)
        probe = Recording.load(folder / PROBE) if (folder / PROBE).is_file() else None
        return replace(deployment, simulated=tuple(simulated), recordings=recordings, probe=probe)


def as_here(row: ComparedError) -> ComparedError:
    """Return the error of the model whose parameters are fitted to the deployment's own logs."""
    return replace(row, error=row.baselines.get(AS_HERE))


def mean(values: Sequence[float | None]) -> float | None:
    """Return the mean of the values that are not None; None without such values."""
    present = [v for v in values if v is not None]
    return float(np.mean(present)) if present else None


def log_of(folder: Path, number: int) -> Path:
    """Return the path of an episode's log."""
    return folder / f"episode_{number}.mcap"
