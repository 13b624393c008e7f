"""The artifact of deploy: episodes of a policy on the robot, and of the same policy in simulation."""

from __future__ import annotations

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
from sim2real.artifacts.recording import TRUTH, Recording
from sim2real.artifacts.summary import ArtifactTable, Interval, Shown, words_and_unit
from sim2real.log.schema import unit_of
from sim2real.types import Json

FORMAT = 4
RESULT, SIMULATION = "result.json", "simulation.npz"
PROBE = "probe.mcap"
"""Log of the small steps that measure the delay before the episodes."""
AS_HERE = "as in this log"
"""The model with the parameters fitted to the deployment's own log."""
_AGAIN = "run `sim2real deploy` again"
_RUN = "{run}"
"""Placeholder for the run's folder in the next command, as the folder may move."""


@dataclass(frozen=True)
class Scores:
    """Scores of one episode: name -> value; the value is None if it does not exist, such as the time to a missed goal.

    Attributes:
        simulation: Scores of the same policy in simulation; None without a simulation.
    """

    real: Mapping[str, float | None]
    simulation: Mapping[str, float | None] | None = None


@dataclass(frozen=True)
class Gap:
    """One quantity on the robot and in simulation: means over episodes and over simulations."""

    quantity: str
    real: float | None
    simulation: float | None
    unit: str = ""

    @property
    def gap(self) -> float | None:
        """The robot's value less that in simulation."""
        return None if self.real is None or self.simulation is None else self.real - self.simulation


@dataclass(frozen=True)
class Replay:
    """Prediction errors of models that receive the recorded commands, for one measured position.

    Attributes:
        name: The position's name in tables.
        horizon_s: Time between the last fitted sample and the prediction [s].
        rmse: Model -> root mean square error; None if the model diverged. ``as in this log`` is fitted to this log.
        expected: Expected error of the identified model, scaled up if this log moves more; None if unknown.
        column: The position's name among the columns.
    """

    name: str
    unit: str
    horizon_s: float
    rmse: Mapping[str, float | None]
    expected: float | None = None
    column: str = ""


_MIN_SHARE = 0.5
"""A change can be the cause if it explains this share of the error that the best change explains."""
_MAX_CHANCE = 0.1
"""A single change is reported as likely if its probability by chance is lower."""


@dataclass(frozen=True)
class Changed:
    """A possible change of a robot: of a parameter, of the sum of the delays, or of a cause of several changes.

    Attributes:
        unit: Unit of ``before`` and ``now``; "" for a cause, as they are factors.
        before: The estimate.
        now: The value that fits the later log best if only this has changed.
        low95: Lower end of the 95 % interval of ``now``; it includes the uncertainty of the estimate.
        explains: Share of the error that the change removes, beyond the uncertainty of the estimate.
        p: Probability of such a share by chance, or by a factor below 1/20; not corrected for several tests.
    """

    name: str
    unit: str
    before: float
    now: float
    low95: float
    high95: float
    explains: float
    p: float


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
        """The smallest ``p`` of the significant changes that explain much; None without alarm.

        The largest ``explains`` can belong to another parameter: if the model lacks a part of the friction, more
        friction explains some error of every motion.
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
                f"{100 * c.explains:.1f} %",  # a text: the number is not in the row's unit
                c.name in self.alarms,
            ]
            for c in self.changes
        ]
        return ArtifactTable(headers, rows)


@dataclass(frozen=True)
class Advice:
    """The verdict on a deployment, and the next command.

    Attributes:
        next: The command to type; "" if none is needed.
        joint: The joint to look at; "" for none.
    """

    status: Literal["fine", "re-identify", "re-train", "look at this joint", "not judged"]
    reasons: tuple[str, ...]
    next: str = ""
    joint: str = ""


@dataclass(frozen=True, repr=False)
class Deployment(Shown):
    """Episodes on the robot, and the same policy in simulation.

    Attributes:
        simulated: Columns of each episode's simulation: ``t`` [s] and a field's values ``(N,)``; a field with its own
            times has them as ``t_FIELD``. Empty without a simulation.
        probe: Log of the small steps that measure the delay; None if the delay was not measured.
        trained: Times on the robot, and the times that the policy was trained with.
        replay: Prediction errors of the identified and of the nominal model on the recorded commands.
        drift: Test for parameters that have changed since the identification; None if it did not run.
        advice: The verdict; None in older files and after a dry run.
        dry_run: Whether commands were not sent: then there are no scores, no simulation and no gap.
        summary: Summary of each episode's session; empty for a loaded artifact.
    """

    episodes: tuple[Scores, ...]
    gap: tuple[Gap, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    simulated: tuple[Mapping[str, np.ndarray], ...] = ()
    recordings: tuple[Recording, ...] = ()
    probe: Recording | None = None
    trained: tuple[Gap, ...] = ()
    replay: tuple[Replay, ...] = ()
    drift: Drift | None = None
    advice: Advice | None = None
    dry_run: bool = False
    format: int = FORMAT
    summary: tuple[Mapping[str, Json], ...] = ()

    def __post_init__(self) -> None:
        check(bool(self.episodes), "no episode")

    def about(self) -> Mapping[str, Json]:
        """Return episodes, verdict, reasons and the next command, by name."""
        advice = self.advice
        facts: dict[str, Json] = {"episodes": len(self.episodes), "dry run": self.dry_run or ""}
        if advice is not None:
            facts |= {"verdict": advice.status, "why": "; ".join(advice.reasons), "next": advice.next}
        return {name: value for name, value in facts.items() if value}

    def rows(self) -> ArtifactTable:
        """Return the gap: a row for each quantity."""
        return _gap_table(("quantity", "robot", "simulation", "gap", "unit"), self.gap, self.units)

    def times_table(self) -> ArtifactTable:
        """Return the times on the robot and in training: a row for each."""
        return _gap_table(("times", "robot", "in training", "gap", "unit"), self.trained, {})

    def replay_table(self) -> ArtifactTable:
        """Return the prediction errors of each model on the recorded commands: a row for each position."""
        models = list(self.replay[0].rmse) if self.replay else []
        horizon = f"commands played again, RMSE {self.replay[0].horizon_s:g} s ahead" if self.replay else ""
        rows = [[r.name, *(r.rmse.get(m) for m in models), r.expected, r.unit] for r in self.replay]
        return ArtifactTable((horizon, *models, "expected", "unit"), rows)

    def save(self, folder: Path | str) -> dict[str, str]:
        """Write scores and simulation into a folder; the logs are in it already.

        Returns:
            Output -> name of the file in the folder.
        """
        folder, advice = make_folder(folder), self.advice
        if advice is not None:
            advice = replace(advice, next=advice.next.replace(shown(folder.parent), _RUN))
        document = replace(self, advice=advice)
        write_json(folder / RESULT, document, without=("simulated", "recordings", "probe", "summary"))
        if self.dry_run:
            return {"result": RESULT}
        columns = {f"{n}_{i}": v for i, episode in enumerate(self.simulated) for n, v in episode.items()}
        write_arrays(folder / SIMULATION, columns)
        return {"result": RESULT, "simulation": SIMULATION}

    @property
    def logs(self) -> tuple[Recording, ...]:
        """The logs of this deployment: its episodes, then the small steps before them."""
        return self.recordings if self.probe is None else (*self.recordings, self.probe)

    @staticmethod
    def read(folder: Path) -> Deployment:
        """Read scores and verdict, without simulations and logs.

        Raises:
            Sim2RealError: When the file is missing, malformed, or of another format.
        """
        deployment = read_versioned(folder / RESULT, Deployment, _AGAIN, FORMAT)
        if deployment.advice is None:
            return deployment
        return replace(
            deployment,
            advice=replace(deployment.advice, next=deployment.advice.next.replace(_RUN, shown(folder.parent))),
        )

    @staticmethod
    def load(folder: Path | str) -> Deployment:
        """Read what ``save`` wrote, and the logs beside it.

        Raises:
            Sim2RealError: When a file is missing, malformed, or of another format.
        """
        folder = Path(folder)
        deployment = Deployment.read(folder)
        arrays: dict[str, np.ndarray] = {}
        if not deployment.dry_run:
            with malformed(folder / SIMULATION, _AGAIN):
                arrays = read_arrays(folder / SIMULATION)
        numbers = range(len(deployment.episodes))
        # An embedded robot that runs on from one episode to the next writes a single file of true states.
        truths = [p if (p := folder / f"truth_{i}.bin").is_file() else folder / TRUTH for i in numbers]
        recordings = tuple(Recording.load(log_of(folder, i), truths[i]) for i in numbers)
        probe = Recording.load(folder / PROBE) if (folder / PROBE).is_file() else None
        simulated = tuple(_of_episode(arrays, i) for i in numbers)
        return replace(deployment, simulated=simulated, recordings=recordings, probe=probe)


def _gap_table(headers: Sequence[str], gaps: Sequence[Gap], units: Mapping[str, str]) -> ArtifactTable:
    """Return a row for each quantity; its unit is the gap's, the field's, or the end of its name."""
    rows = []
    for gap in gaps:
        words, unit = words_and_unit(gap.quantity)
        unit = gap.unit or unit_of(gap.quantity, units) or unit
        rows.append([words, gap.real, gap.simulation, gap.gap, unit])
    return ArtifactTable(headers, rows)


def log_of(folder: Path, number: int) -> Path:
    """Return the path of an episode's log."""
    return folder / f"episode_{number}.mcap"


def _of_episode(arrays: Mapping[str, np.ndarray], number: int) -> dict[str, np.ndarray]:
    """Return the columns of one episode's simulation, whose names end with its number."""
    suffix = f"_{number}"
    return {n.removesuffix(suffix): v for n, v in arrays.items() if n.endswith(suffix)}
