"""The iterations of a run: what ran before each deployment, and what the deployment showed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.run import STAGES, StageFolder, attempts
from sim2real.artifacts.summary import ArtifactTable
from sim2real.errors import DelayChanged


@dataclass(frozen=True)
class Iteration:
    """One iteration, which ends with a deployment.

    Attributes:
        stages: Folders of the stages that ran, in order, relative to the run.
        deployment: The deployment's folder; unfinished if the policy was refused.
        real: Mean success of the episodes on the robot; None if the task has no success.
        simulation: Mean success in simulation.
        verdict: Verdict of the deployment; ``re-identify`` if the policy was refused.
        why: The first reason.
    """

    stages: tuple[str, ...]
    deployment: StageFolder
    real: float | None = None
    simulation: float | None = None
    verdict: str = "not judged"
    why: str = ""

    @property
    def refused(self) -> bool:
        """Whether the policy was refused because the robot's delay has changed."""
        return not self.deployment.finished


def iterations(run_dir: Path) -> list[Iteration]:
    """Return the iterations of a run, the oldest first, from its stages' folders.

    Raises:
        Sim2RealError: When a deployment's file is malformed.
    """
    made = [a for stage in STAGES for a in attempts(run_dir, stage) if a.finished or _was_refused(a)]
    made = sorted(made, key=lambda a: a.manifest.started)
    rows, stages = list[Iteration](), list[str]()
    for attempt in made:
        stages.append(attempt.folder.name)
        if attempt.stage == "deploy":
            rows.append(_judged(tuple(stages), attempt))
            stages = []
    return rows


def iterations_table(rows: Sequence[Iteration]) -> ArtifactTable:
    """Return a row for each iteration."""
    headers = ("iteration", "ran", "success", "in simulation", "verdict", "why")
    cells = [[str(i), ", ".join(r.stages), r.real, r.simulation, r.verdict, r.why] for i, r in enumerate(rows, 1)]
    return ArtifactTable(headers, cells)


def _was_refused(attempt: StageFolder) -> bool:
    return attempt.stage == "deploy" and attempt.manifest.error.startswith(f"{DelayChanged.__name__}:")


def _judged(stages: tuple[str, ...], folder: StageFolder) -> Iteration:
    if not folder.finished:
        why = folder.manifest.error.splitlines()[0].partition(": ")[2]
        return Iteration(stages, folder, verdict="re-identify", why=why)
    deployment = Deployment.read(folder.folder)
    success, verdict = deployment.score("success"), deployment.verdict
    status = "not judged" if verdict is None else verdict.status
    return Iteration(stages, folder, success.real, success.simulation, status, next(iter(deployment.reasons), ""))
