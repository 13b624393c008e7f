"""Several runs of one robot side by side, and the parameters whose intervals do not overlap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import Estimate, Identification
from sim2real.artifacts.summary import ArtifactTable
from sim2real.types import Json


@dataclass(frozen=True)
class ComparedRun:
    """Results of one run; None for a stage that is not finished."""

    name: str
    started: str
    identification: Identification | None = None
    deployment: Deployment | None = None


@dataclass(frozen=True)
class Comparison:
    """Runs side by side."""

    runs: tuple[ComparedRun, ...]

    @property
    def parameters(self) -> dict[tuple[str, str], list[Estimate | None]]:
        """Name and unit -> each run's estimate or None, for parameters that at least two runs have."""
        found = [run.identification.parameters if run.identification else () for run in self.runs]
        tables = [{(e.name, e.unit): e for e in estimates} for estimates in found]
        rows = {key: [table.get(key) for table in tables] for key in dict.fromkeys(k for t in tables for k in t)}
        return {key: row for key, row in rows.items() if len(row) - row.count(None) > 1}

    @property
    def different(self) -> tuple[str, ...]:
        """Names of the parameters whose intervals do not overlap."""
        return tuple(name for (name, _), row in self.parameters.items() if overlap(row) is False)

    def rows(self) -> ArtifactTable:
        """Return the table of parameters: estimate and half-width of the 95 % interval of each run."""
        headers = ("parameter", "unit", *(run.name for run in self.runs), "intervals overlap")
        words = {None: "", True: "yes", False: "no"}
        rows = [[*key, *map(with_interval, row), words[overlap(row)]] for key, row in self.parameters.items()]
        return ArtifactTable(headers, rows)

    def figures(self) -> ArtifactTable:
        """Return the table of verdicts, errors and scores: a row for each figure, a column for each run."""
        columns = [_figures_of(run) for run in self.runs]
        names = dict.fromkeys(name for column in columns for name in column)
        headers = ("figure", *(run.name for run in self.runs))
        return ArtifactTable(headers, [[name, *(column.get(name) for column in columns)] for name in names])


def overlap(estimates: list[Estimate | None]) -> bool | None:
    """Return whether the 95 % intervals of all runs overlap; None if fewer than two runs have one."""
    ends = [(e.low95, e.high95) for e in estimates if e is not None]
    known = [(low, high) for low, high in ends if low is not None and high is not None]
    return max(low for low, _ in known) <= min(high for _, high in known) if len(known) > 1 else None


def with_interval(estimate: Estimate | None) -> str:
    """Return an estimate with the half-width of its 95 % interval as text; a dash if there is none."""
    if estimate is None:
        return "-"
    if estimate.low95 is None or estimate.high95 is None:
        return f"{estimate.estimate:.4g}"
    return f"{estimate.estimate:.4g} ± {(estimate.high95 - estimate.low95) / 2:.2g}"


def _figures_of(run: ComparedRun) -> Mapping[str, Json]:
    """Return name -> value of one run's verdicts, held-out errors and scores on the robot."""
    figures: dict[str, Json] = {"started": run.started}
    if (identification := run.identification) is not None:
        figures["identification"] = identification.verdict.status
        for row in identification.held_out:
            figures[f"error {row.seconds:g} s ahead, {row.joint} [{row.unit}]"] = row.error
    if (deployment := run.deployment) is not None:
        figures |= {"deployment": deployment.verdict.status} if deployment.verdict else {}
        figures |= {"episodes": len(deployment.episodes), **{g.quantity: g.real for g in deployment.gap}}
    return figures
