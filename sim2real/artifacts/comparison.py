"""Several runs of one robot side by side, and a test for parameters that differ beyond chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import Estimate, Identification
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.types import Json

LEVEL = 0.01
"""Chance that a comparison of runs of one unchanged robot names any parameter as different."""


@dataclass(frozen=True)
class ComparedRun:
    """What one run contributes; None where its stage is not finished."""

    name: str
    started: str
    identification: Identification | None = None
    deployment: Deployment | None = None


@dataclass(frozen=True)
class ComparedParameter:
    """One parameter in all runs.

    Attributes:
        estimates: Of each run; None where the run's model has no such parameter.
        p_value: Chance of estimates this far apart if the parameter is the same in all runs; None where fewer than two
            runs have a standard error.
        differs: Whether the estimates differ beyond chance, over all parameters together.
    """

    name: str
    unit: str
    estimates: tuple[Estimate | None, ...]
    p_value: float | None
    differs: bool


@dataclass(frozen=True)
class Comparison(Shown):
    """Runs side by side."""

    runs: tuple[ComparedRun, ...]
    parameters: tuple[ComparedParameter, ...]

    @staticmethod
    def of(runs: Sequence[ComparedRun]) -> Comparison:
        """Compare runs; a parameter takes part if at least two runs have it in the same unit."""
        tables = [_by_name(run) for run in runs]
        names = dict.fromkeys(key for table in tables for key in table)
        shared = [key for key in names if sum(key in table for table in tables) > 1]
        estimates = [tuple(table.get(key) for table in tables) for key in shared]
        p_values = [_homogeneity(row) for row in estimates]
        differs = _holm(p_values)
        parameters = zip(shared, estimates, p_values, differs, strict=True)
        return Comparison(tuple(runs), tuple(ComparedParameter(*key, row, p, d) for key, row, p, d in parameters))

    @property
    def different(self) -> tuple[str, ...]:
        """Names of the parameters that differ beyond chance."""
        return tuple(p.name for p in self.parameters if p.differs)

    def about(self) -> Mapping[str, Json]:
        """Return name -> value for a short representation."""
        return {"runs": len(self.runs), "differ": ", ".join(self.different) or "no parameter"}

    def rows(self) -> ArtifactTable:
        """Return the table of parameters: estimate and half-width of the 95 % interval of each run."""
        headers = ("parameter", "unit", *(run.name for run in self.runs), "differs beyond chance")
        rows = [
            [p.name, p.unit, *map(with_interval, p.estimates), "not tested" if p.p_value is None else _verdict(p)]
            for p in self.parameters
        ]
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
    if estimate.standard_error is None:
        return f"{estimate.estimate:.4g}"
    return f"{estimate.estimate:.4g} ± {1.96 * estimate.standard_error:.2g}"


def _by_name(run: ComparedRun) -> dict[tuple[str, str], Estimate]:
    estimates = () if run.identification is None else run.identification.parameters
    return {(e.name, e.unit): e for e in estimates}


def _homogeneity(estimates: Sequence[Estimate | None]) -> float | None:
    """Return the p-value of Cochran's Q: squared distances from the weighted mean, in standard errors."""
    pairs = [(e.estimate, e.standard_error) for e in estimates if e is not None and e.standard_error]
    if len(pairs) < 2:
        return None
    values, errors = np.array(pairs).T
    weights = errors**-2.0
    mean = np.average(values, weights=weights)
    return float(chi2.sf((weights * (values - mean) ** 2).sum(), len(pairs) - 1))


def _holm(p_values: Sequence[float | None]) -> list[bool]:
    """Return which tests reject at ``LEVEL`` over all of them (Holm's step-down procedure)."""
    tested = sorted((p, i) for i, p in enumerate(p_values) if p is not None)
    rejected = [False] * len(p_values)
    for rank, (p, i) in enumerate(tested):
        if p > LEVEL / (len(tested) - rank):
            break
        rejected[i] = True
    return rejected


def _verdict(parameter: ComparedParameter) -> str:
    return f"{'yes' if parameter.differs else 'no'}, p = {parameter.p_value:.2g}"


def _figures_of(run: ComparedRun) -> dict[str, Json]:
    """Return name -> value of one run's verdicts, held-out errors and scores on the robot."""
    # Figures of the identification, then those of the deployment.
    figures: dict[str, Json] = {"started": run.started}
    if (identification := run.identification) is not None:
        figures["identification"] = identification.verdict.status
        for row in identification.held_out:
            figures[f"error {row.horizon_s:g} s ahead, {row.name} [{row.unit}]"] = row.rmse.get("identified")
    if (deployment := run.deployment) is not None:
        if deployment.advice is not None:
            figures["deployment"] = deployment.advice.status
        figures["episodes"] = len(deployment.episodes)
        for gap in deployment.gap:
            unit = f" [{gap.unit}]" if gap.unit else ""
            figures[f"{gap.quantity}{unit}"] = gap.real
    return figures
