"""The command compare: runs of one robot side by side, as tables and as a page. ``--help`` imports no JAX."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.artifacts.comparison import Comparison
    from sim2real.artifacts.run.run_folder import StageFolder

PAGE = "compare.html"


@dataclass(frozen=True)
class CompareConfig:
    """Compare runs of one robot: parameters with intervals, errors and success."""

    runs_to_compare: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN...")] = ()
    """Run folders, their names, stage folders in them, or pipelines, whose newest run is taken; at least two."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """Page to write; default: compare.html in the working directory."""
    json: bool = False
    """Print JSON instead of tables."""


def run(config: CompareConfig) -> Comparison:
    """Compare the runs of a command, print the tables, and write the page.

    Raises:
        UsageError: Fewer than two runs, runs of different robots, or runs with nothing in common.
        Sim2RealError: An artifact is missing or malformed.
    """
    from sim2real.artifacts.comparison import ComparedRun, Comparison
    from sim2real.artifacts.deployment import Deployment
    from sim2real.artifacts.files import to_json
    from sim2real.artifacts.identification import Identification
    from sim2real.stages.terminal.console import artifact_table, note, wrote

    if len(config.runs_to_compare) < 2:
        raise UsageError(
            f"compare needs at least two runs, got {len(config.runs_to_compare)}",
            hint="sim2real compare runs/NAME/FIRST runs/NAME/SECOND",
        )
    # Find the runs, which must be of one robot.
    all_stages = [_stages_of(target, config.runs) for target in config.runs_to_compare]
    robots = list(dict.fromkeys(str(next(iter(stages.values())).manifest["pipeline"]) for stages in all_stages))
    if len(robots) > 1:
        raise UsageError(f"these are runs of different robots: {', '.join(robots)}", hint="compare runs of one robot")
    # Read what each run has, and compare it.
    runs = []
    for name, stages in zip(_names(all_stages), all_stages, strict=True):
        started = min(str(stage.manifest.get("started", "")) for stage in stages.values())
        identify, deploy = stages.get("identify"), stages.get("deploy")
        identification = None if identify is None else Identification.load(identify.folder)
        deployment = None if deploy is None else Deployment.read(deploy.folder)
        runs.append(ComparedRun(name, started.replace("T", " ")[:16], identification, deployment))
    comparison = Comparison.of(runs)
    if not comparison.parameters and not all(r.deployment for r in comparison.runs):
        raise UsageError(
            f"nothing to compare: these runs of {robots[0]} share no identified parameter and no deployment",
            hint="compare runs whose stage identify or deploy is finished",
        )
    # Print the tables, and write the page.
    figures, parameters = comparison.figures(), comparison.rows()
    if config.json:
        print(to_json({"figures": figures.records(), "parameters": parameters.records()}).decode())
    else:
        print(artifact_table(figures))
        if parameters.rows:
            print(artifact_table(parameters))
            note(f"intervals that do not overlap: {', '.join(comparison.different) or 'of no parameter'}")
    from sim2real.view.page.comparison import comparison_page  # imports matplotlib

    page = comparison_page(comparison, config.out or Path(PAGE))
    if config.json:
        note(f"wrote {page}")  # stdout holds JSON alone
    else:
        wrote(page)
    return comparison


def _stages_of(target: str, root: Path) -> dict[str, StageFolder]:
    """Return the finished stages of a run; a stage folder selects its run, with that attempt of the stage.

    Raises:
        UsageError: There is no such run.
        Sim2RealError: None of its stages is finished.
    """
    from sim2real.artifacts.run.manifest import read_manifest
    from sim2real.artifacts.run.run_folder import finished_stages, open_folder
    from sim2real.stages.pipeline.find_run import find_run

    stages = finished_stages(find_run(root, target))
    if (manifest := read_manifest(Path(target))) is not None:
        attempt = open_folder(Path(target), str(manifest["stage"]))
        stages |= {attempt.stage: attempt}
    return stages


def _names(all_stages: Sequence[dict[str, StageFolder]]) -> list[str]:
    """Return a name for each run: its folder's, with a number where two are the same."""
    names = [next(iter(stages.values())).run_dir.resolve().name for stages in all_stages]
    return [name if names.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(names)]
