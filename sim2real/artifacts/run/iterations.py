"""The iterations of a run: stages, success, verdict and plan of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sim2real.artifacts.files import malformed, read_json, write_json
from sim2real.artifacts.summary import ArtifactTable

ITERATIONS = "iterations.json"


@dataclass(frozen=True)
class Iteration:
    """One time around the loop.

    Attributes:
        stages: Folders of the stages that ran, in order, relative to the run.
        real: Mean success of the episodes on the robot; None if the task has no success.
        simulation: Mean success in simulation.
        verdict: Verdict of the deployment, or the remedy for its refusal.
        why: The first reason.
        then: The next steps, as text.
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
        """Folder of the judged deployment; None if it was refused."""
        return next((name for name in reversed(self.stages) if name.partition(".")[0] == "deploy"), None)


@dataclass(frozen=True)
class Plan:
    """The plan of an iteration. It is on disk before the iteration starts, so that an interrupted one can resume.

    Attributes:
        stages: The stages to run, in order; empty if the run stops.
        log: The logs to identify from, relative to the run folder; empty for the newest recording.
        terms: The optional terms to identify with; None for the flags' value.
        seed: The seed of the training; None for the flags' value.
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
        plan: Plan of the next one; None after the last.
    """

    rows: tuple[Iteration, ...] = ()
    plan: Plan | None = None

    def table(self) -> ArtifactTable:
        """Return a row for each finished iteration."""
        headers = ("iteration", "ran", "success", "in simulation", "verdict", "why", "then")
        rows = [[str(r.number), ", ".join(r.stages), r.real, r.simulation, r.verdict, r.why, r.then] for r in self.rows]
        return ArtifactTable(headers, rows)

    def save(self, run_dir: Path) -> Path:
        """Write the iterations into the run folder, and return the file."""
        write_json(run_dir / ITERATIONS, self)
        return run_dir / ITERATIONS

    @staticmethod
    def load(run_dir: Path) -> Iterations:
        """Read the iterations of a run; empty if it has none.

        Raises:
            Sim2RealError: When the file is malformed.
        """
        file = run_dir / ITERATIONS
        if not file.is_file():
            return Iterations()
        with malformed(file, "remove it: the run then judges its newest deployment again"):
            return read_json(file, Iterations)
