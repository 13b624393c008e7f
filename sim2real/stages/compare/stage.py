"""Compare runs: read their artifacts, test which parameters differ, print tables and write a page."""

from collections.abc import Sequence
from pathlib import Path

from sim2real.artifacts.comparison import ComparedRun, Comparison
from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.manifest import read_manifest
from sim2real.artifacts.run.run_folder import StageFolder, finished_stages, open_folder, pipeline_of
from sim2real.errors import UsageError
from sim2real.stages.compare.config import CompareConfig
from sim2real.stages.compare.show import show
from sim2real.stages.pipeline.find_run import find_run
from sim2real.stages.terminal.console import note, wrote

PAGE = "compare.html"


def run(config: CompareConfig) -> Comparison:
    """Compare the runs of a command, print the tables, and write the page.

    Raises:
        UsageError: Fewer than two runs, or runs of different robots.
        Sim2RealError: An artifact is missing or malformed.
    """
    folders = [_stages_of(target, config.runs) for target in config.targets]
    comparison = Comparison.of([_read(name, stages) for name, stages in zip(_names(folders), folders, strict=True)])
    if not comparison.parameters and not all(r.deployment for r in comparison.runs):
        pipelines = dict.fromkeys(str(next(iter(stages.values())).manifest["pipeline"]) for stages in folders)
        raise UsageError(
            f"nothing to compare: the runs of {', '.join(pipelines)} share no identified parameter and no deployment",
            hint="compare runs of one robot whose stage identify or deploy is finished",
        )
    show(comparison, config.json)
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
        UsageError: There is no such run, or none of its stages is finished.
    """
    run_dir = find_run(root, target)
    stages = finished_stages(run_dir)
    if (manifest := read_manifest(Path(target))) is not None:
        attempt = open_folder(Path(target), str(manifest["stage"]))
        stages |= {attempt.stage: attempt}
    if not stages:
        raise UsageError(f"no stage of {run_dir} is finished", hint=f"sim2real run {pipeline_of(run_dir)}")
    return stages


def _names(folders: Sequence[dict[str, StageFolder]]) -> list[str]:
    """Return a name for each run: its folder's, with the pipeline's and a number where two are the same."""
    run_dirs = [next(iter(stages.values())).run_dir.resolve() for stages in folders]
    names = [path.name for path in run_dirs]
    if len(set(names)) < len(names):
        names = [f"{path.parent.name}/{path.name}" for path in run_dirs]
    return [name if names.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(names)]


def _read(name: str, stages: dict[str, StageFolder]) -> ComparedRun:
    """Read what a comparison needs of one run."""
    started = min(str(stage.manifest.get("started", "")) for stage in stages.values())
    identify, deploy = stages.get("identify"), stages.get("deploy")
    return ComparedRun(
        name,
        started.replace("T", " ")[:16],
        None if identify is None else Identification.load(identify.folder),
        None if deploy is None else Deployment.read(deploy.folder),
    )
