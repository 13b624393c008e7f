"""Several runs of one robot side by side, and the parameters whose intervals do not overlap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import Estimate, Identification
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.types import Json


@dataclass(frozen=True)
class ComparedRun:
    """What one run contributes; None where its stage is not finished."""

    name: str
    started: str
    identification: Identification | None = None
    deployment: Deployment | None = None


@dataclass(frozen=True)
class ComparedParameter:
    """One parameter in all runs; an estimate is None where the run's model has no such parameter."""

    name: str
    unit: str
    estimates: tuple[Estimate | None, ...]

    @property
    def overlap(self) -> bool | None:
        """Whether the 95 % intervals of all runs overlap; None where fewer than two runs have one."""
        ends = [(e.low95, e.high95) for e in self.estimates if e is not None]
        known = [(low, high) for low, high in ends if low is not None and high is not None]
        return max(low for low, _ in known) <= min(high for _, high in known) if len(known) > 1 else None


@dataclass(frozen=True)
class Comparison(Shown):
    """Runs side by side."""

    runs: tuple[ComparedRun, ...]
    parameters: tuple[ComparedParameter, ...]

    @staticmethod
    def of(runs: Sequence[ComparedRun]) -> Comparison:
        """Compare runs; a parameter takes part if at least two runs have it in the same unit."""
        tables = [
            {} if run.identification is None else {(e.name, e.unit): e for e in run.identification.parameters}
            for run in runs
        ]
        names = dict.fromkeys(key for table in tables for key in table)
        shared = [key for key in names if sum(key in table for table in tables) > 1]
        parameters = (ComparedParameter(*key, tuple(table.get(key) for table in tables)) for key in shared)
        return Comparison(tuple(runs), tuple(parameters))

    @property
    def different(self) -> tuple[str, ...]:
        """Names of the parameters whose intervals do not overlap."""
        return tuple(p.name for p in self.parameters if p.overlap is False)

    def about(self) -> Mapping[str, Json]:
        """Return name -> value for a short representation."""
        return {"runs": len(self.runs), "intervals apart": ", ".join(self.different) or "of no parameter"}

    def rows(self) -> ArtifactTable:
        """Return the table of parameters: estimate and half-width of the 95 % interval of each run."""
        headers = ("parameter", "unit", *(run.name for run in self.runs), "intervals overlap")
        words = {None: "", True: "yes", False: "no"}
        rows = [[p.name, p.unit, *map(with_interval, p.estimates), words[p.overlap]] for p in self.parameters]
        return ArtifactTable(headers, rows)

    def figures(self) -> ArtifactTable:
        """Return the table of verdicts, errors and scores: one row a figure, one column a run."""
        columns = [_figures_of(run) for run in self.runs]
        names = dict.fromkeys(name for column in columns for name in column)
        headers = ("figure", *(run.name for run in self.runs))
        return ArtifactTable(headers, [[name, *(column.get(name) for column in columns)] for name in names])


def with_interval(estimate: Estimate | None) -> str:
    """Return an estimate with the half-width of its 95 % interval; a dash where the run has none."""
    if estimate is None:
        return "-"
    if estimate.low95 is None or estimate.high95 is None:
        return f"{estimate.estimate:.4g}"
    return f"{estimate.estimate:.4g} ± {(estimate.high95 - estimate.low95) / 2:.2g}"


def _figures_of(run: ComparedRun) -> dict[str, Json]:
    """Return name -> value of one run's verdicts, held-out errors and scores on the robot."""
    figures: dict[str, Json] = {"started": run.started}
    if (identification := run.identification) is not None:
        figures["identification"] = identification.verdict.status
        for row in identification.held_out:
            figures[f"error {row.seconds:g} s ahead, {row.name} [{row.unit}]"] = row.error
    if (deployment := run.deployment) is not None:
        if deployment.verdict is not None:
            figures["deployment"] = deployment.verdict.status
        figures["episodes"] = len(deployment.episodes)
        for gap in deployment.gap:
            figures[gap.quantity] = gap.real
    return figures
