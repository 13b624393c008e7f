"""The iterations of a run: what each did again, how it went, what it found, and what the next one does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sim2real.artifacts.files import malformed, read_json, write_json

ITERATIONS = "iterations.json"


@dataclass(frozen=True)
class Iteration:
    """One time around the loop.

    Attributes:
        number: Its number, from 1.
        stages: Folder of each stage that ran, in order, relative to the run.
        real: Success on the robot, a mean over episodes; None where the task knows none.
        simulation: The same in simulation.
        verdict: What the deployment said, or that it was refused asks for.
        why: The first reason.
        then: What followed, in words.
    """

    number: int
    stages: tuple[str, ...]
    real: float | None = None
    simulation: float | None = None
    verdict: str = "not judged"
    why: str = ""
    then: str = ""

    @property
    def deployment(self) -> str | None:
        """Folder of the deployment that was judged; None where it was refused."""
        return next((name for name in reversed(self.stages) if name.partition(".")[0] == "deploy"), None)


@dataclass(frozen=True)
class Plan:
    """What an iteration does. It is on disk before the iteration starts, so that an interrupted one can go on.

    Attributes:
        stages: The stages that run, in order; none where the run stops.
        words: That in words.
        log: The logs to identify from, relative to the run folder; none: the newest recording.
        terms: The optional terms to identify with; None: as the flags say.
        seed: The seed of the training; None: as the flags say.
        before: Stage folders that were finished when the iteration started.
    """

    stages: tuple[str, ...]
    words: str
    log: tuple[str, ...] = ()
    terms: str | None = None
    seed: int | None = None
    before: tuple[str, ...] = ()


@dataclass(frozen=True)
class Iterations:
    """All iterations of a run, the oldest first.

    Attributes:
        rows: Those that ended.
        plan: What the next one does; None where none is to come.
    """

    rows: tuple[Iteration, ...] = ()
    plan: Plan | None = None

    def save(self, run_dir: Path) -> Path:
        """Write them into the run folder; return the file."""
        write_json(run_dir / ITERATIONS, self)
        return run_dir / ITERATIONS

    @staticmethod
    def load(run_dir: Path) -> Iterations:
        """Read those of a run; none where it has not gone around.

        Raises:
            Sim2RealError: When the file is malformed.
        """
        file = run_dir / ITERATIONS
        if not file.is_file():
            return Iterations()
        with malformed(file, "remove it: the run then judges its newest deployment again"):
            return read_json(file, Iterations)
