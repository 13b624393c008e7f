"""What deploy leaves: the policy on the robot, beside the same policy in simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sim2real.artifacts.estimation.drift import Drift
from sim2real.artifacts.files import check, made, malformed, read_arrays, read_json, write_arrays, write_json
from sim2real.artifacts.paths import shown
from sim2real.artifacts.recording import TRUTH, Recording
from sim2real.artifacts.summary import Rows, Summed
from sim2real.errors import Sim2RealError

FORMAT = 2
RESULT, SIMULATION = "result.json", "simulation.npz"
PROBE = "probe.mcap"
"""Log of the small steps by which the delay was measured."""
_AGAIN = "run `sim2real deploy` again"
_RUN = "{run}"
"""Stands in the file for the run's folder, which may move, in the command to type next."""


@dataclass(frozen=True)
class Scores:
    """How well one episode went: name -> value, None where there is none, such as for a goal never reached.

    Attributes:
        real: On the robot.
        simulation: Of the same policy in simulation; None where nothing was simulated.
    """

    real: Mapping[str, float | None]
    simulation: Mapping[str, float | None] | None = None


@dataclass(frozen=True)
class Gap:
    """One quantity on the robot and in simulation: means over episodes and over simulations."""

    quantity: str
    real: float | None
    simulation: float | None
    gap: float | None
    unit: str = ""


@dataclass(frozen=True)
class Replay:
    """How far the recorded commands, played to models, are off the measurements of one position.

    Attributes:
        name: What people call the position.
        unit: Its unit.
        horizon_s: How far ahead is predicted [s].
        rmse: Model -> root mean square error; None where it diverged. ``as in this log`` has parameters fitted to it.
        promised: That of the identified model on held-out recordings, more where this log moves more; None where that
            is not known.
        column: The position's name among the columns.
        free_run: Mean error of the identified model in free runs over held-out recordings; None where there was none.
    """

    name: str
    unit: str
    horizon_s: float
    rmse: Mapping[str, float | None]
    promised: float | None = None
    column: str = ""
    free_run: float | None = None


@dataclass(frozen=True)
class Course:
    """One measured column over a whole episode, beside all simulations of the same policy.

    Attributes:
        episode: Number of the episode.
        column: Name of the column.
        beside: For a tenth of the episode it is at least this far outside of what the simulations cover up to 0.1 s
            before and after; angles on the circle.
        moved: Its range in the first and in the second half.
        least: Smallest range of any simulation in each half.
        most: Largest range of any simulation in each half.
    """

    episode: int
    column: str
    beside: float
    moved: tuple[float, ...]
    least: tuple[float, ...]
    most: tuple[float, ...]


@dataclass(frozen=True)
class Advice:
    """What to do after a deployment.

    Attributes:
        status: The verdict.
        reasons: Why, in sentences.
        next: The command to type; "" where there is none.
        joint: The joint to look at; "" for none.
    """

    status: Literal["fine", "re-identify", "re-train", "look at this joint", "not judged"]
    reasons: tuple[str, ...]
    next: str = ""
    joint: str = ""


@dataclass(frozen=True, repr=False)
class Deployment(Summed):
    """Episodes on the robot beside the same policy in simulation.

    Attributes:
        episodes: How well each went.
        gap: What differs.
        units: Field -> unit.
        simulated: Columns of each episode's simulation: ``t`` [s] and a field's values ``(N,)``; times of its own as
            ``t_FIELD``. Empty where nothing was simulated.
        recordings: The robot's sessions.
        probe: The small steps by which the delay was measured; None where it was not.
        trained: Times on the robot beside those that the policy was trained with.
        replay: The recorded commands, played to the identified and to the nominal model.
        courses: Measured columns over whole episodes, beside the simulations.
        drift: Which parameters are no longer what was identified; None where that was not tested.
        advice: What to do next; None in older files and after a dry run.
        dry_run: Whether nothing was moved: then there are no scores, no simulation and no gap.
        summary: How the session of each episode went; empty for one that was loaded.
        format: Version of the file.
    """

    episodes: tuple[Scores, ...]
    gap: tuple[Gap, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    simulated: tuple[Mapping[str, np.ndarray], ...] = ()
    recordings: tuple[Recording, ...] = ()
    probe: Recording | None = None
    trained: tuple[Gap, ...] = ()
    replay: tuple[Replay, ...] = ()
    courses: tuple[Course, ...] = ()
    drift: Drift | None = None
    advice: Advice | None = None
    dry_run: bool = False
    format: int = FORMAT
    summary: tuple[Mapping[str, Any], ...] = ()  # pyright: ignore[reportIncompatibleMethodOverride]

    def __post_init__(self) -> None:
        """Check that there is an episode: it may come from a file."""
        check(bool(self.episodes), "no episode")

    def about(self) -> Mapping[str, Any]:
        """Return what to say about it: name -> value."""
        advice = self.advice
        found: dict[str, Any] = {"episodes": len(self.episodes), "dry run": self.dry_run or ""}
        if advice is not None:
            found |= {"verdict": advice.status, "why": "; ".join(advice.reasons), "next": advice.next}
        return {name: value for name, value in found.items() if value}

    def rows(self) -> Rows:
        """Return a row for each quantity."""
        headers = ("quantity", "robot", "simulation", "gap", "unit")
        return headers, [[g.quantity, g.real, g.simulation, g.gap, g.unit] for g in self.gap]

    def save(self, folder: Path | str) -> dict[str, str]:
        """Write scores and simulation into a folder; the sessions' logs stand in it already.

        Returns:
            Output -> name of the file in the folder.
        """
        folder, advice = made(folder), self.advice
        arrays = ("simulated", "recordings", "probe", "summary")
        if advice is not None:
            advice = replace(advice, next=advice.next.replace(shown(folder.parent), _RUN))
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in arrays}
        write_json(folder / RESULT, values | {"advice": advice})
        if self.dry_run:
            return {"result": RESULT}
        columns = {f"{n}_{i}": v for i, own in enumerate(self.simulated) for n, v in own.items()}
        write_arrays(folder / SIMULATION, columns)
        return {"result": RESULT, "simulation": SIMULATION}

    @property
    def logs(self) -> tuple[Recording, ...]:
        """What says how the robot is now: its sessions, and the small steps before them."""
        return self.recordings if self.probe is None else (*self.recordings, self.probe)

    @staticmethod
    def read(folder: Path) -> Deployment:
        """Read scores and verdict alone, without simulations and logs.

        Raises:
            Sim2RealError: When the file is missing, of another format, or not as it should be.
        """
        file = folder / RESULT
        with malformed(file, _AGAIN):
            found = read_json(file, Deployment)
            if found.format != FORMAT:
                raise Sim2RealError(f"{file} has format {found.format}, this version reads {FORMAT}", hint=_AGAIN)
        if found.advice is None:
            return found
        return replace(found, advice=replace(found.advice, next=found.advice.next.replace(_RUN, shown(folder.parent))))

    @staticmethod
    def load(folder: Path | str) -> Deployment:
        """Read what ``save`` wrote, and the logs beside it.

        Raises:
            Sim2RealError: When something is missing, of another format, or not as it should be.
        """
        folder = Path(folder)
        found = Deployment.read(folder)
        arrays: dict[str, np.ndarray] = {}
        if not found.dry_run:
            with malformed(folder / SIMULATION, _AGAIN):
                arrays = read_arrays(folder / SIMULATION)
        numbers = range(len(found.episodes))
        # An embedded robot that runs on from one episode to the next writes a single file of true states.
        truths = [p if (p := folder / f"truth_{i}.bin").is_file() else folder / TRUTH for i in numbers]
        recordings = tuple(Recording.load(log_of(folder, i), truths[i]) for i in numbers)
        probe = Recording.load(folder / PROBE) if (folder / PROBE).is_file() else None
        simulated = tuple(_of_episode(arrays, i) for i in numbers)
        return replace(found, simulated=simulated, recordings=recordings, probe=probe)


def log_of(folder: Path, number: int) -> Path:
    """Return the path of an episode's log."""
    return folder / f"episode_{number}.mcap"


def _of_episode(arrays: Mapping[str, np.ndarray], number: int) -> dict[str, np.ndarray]:
    """Return the columns of one episode's simulation: those whose names end with its number."""
    suffix = f"_{number}"
    return {n.removesuffix(suffix): v for n, v in arrays.items() if n.endswith(suffix)}
