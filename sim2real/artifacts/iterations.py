"""The iterations of a run: what each did again, how it went, and what it found."""

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


@dataclass(frozen=True)
class Iterations:
    """All iterations of a run, the oldest first."""

    rows: tuple[Iteration, ...] = ()

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
        with malformed(file, "remove it: it only tells what was done"):
            return read_json(file, Iterations)
