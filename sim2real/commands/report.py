"""``sim2real report``: shows a run as an HTML page or in the Rerun viewer, or compares runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from sim2real.commands import flags
from sim2real.errors import UsageError
from sim2real.stages.flag import WINDOW, Flag, is_viewer
from sim2real.stages.shared.find_run import find_run

if TYPE_CHECKING:
    from sim2real.artifacts.comparison import Comparison
    from sim2real.artifacts.run import StageFolder
    from sim2real.commands.loop import Run

COMPARISON = "compare.html"


@dataclass(frozen=True)
class ReportConfig:
    """Write a run as one HTML page, show it in the Rerun viewer, or compare runs of one robot."""

    targets: Annotated[tuple[str, ...], Flag("RUN|PIPELINE...", positional=True, needed=True)] = ()
    """A run folder, its name, a stage folder in it, or a pipeline (its newest run). Several are compared: parameters,
    errors and success.
    """
    rerun: Annotated[str | None, Flag("[web|FILE.rrd]", alone=WINDOW)] = None
    """Open the run in the Rerun viewer instead of writing a page; 'web': on a page for browsers, until Ctrl-C;
    FILE.rrd: a recording for the viewer."""
    follow: bool = False
    """With --rerun: follow a run whose stages are still running, until Ctrl-C."""
    out: Annotated[Path | None, Flag("FILE")] = None
    """The page to write; default: report.html in the run's folder, or compare.html in the working directory."""
    json: bool = False
    """Print the comparison of several runs as JSON."""
    runs: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        """Check the flags against each other."""
        if self.rerun is not None and not is_viewer(self.rerun):
            raise UsageError(
                f"--rerun takes 'web', an address or FILE.rrd, got {self.rerun}",
                hint=f"write the run first: sim2real report {self.rerun} --rerun",
            )
        if len(self.targets) > 1 and self.rerun:
            raise UsageError("the viewer shows one run", hint="name one run, or leave out --rerun")
        if self.follow and (self.rerun is None or self.rerun.endswith(".rrd")):
            raise UsageError("--follow shows new rows in a viewer", hint="add --rerun, or --rerun web")
        if self.json and len(self.targets) < 2:
            raise UsageError("--json prints a comparison", hint="name two runs")


def report_command(command: str, arguments: list[str]) -> None:
    """``sim2real report RUN|PIPELINE... [FLAGS]``."""
    examples = ("report pendulum", "report pendulum --rerun", "report runs/NAME/MONDAY runs/NAME/FRIDAY")
    config = flags.parse(ReportConfig(), arguments, f"sim2real {command}", *examples)
    if len(config.targets) > 1:
        compare(config)
        return
    run_dir = find_run(config.runs, *config.targets)
    if config.rerun:
        _show(run_dir, config.rerun, config.follow)
        return
    from sim2real.stages.terminal.console import progress, wrote

    with progress(None, "report"):
        from sim2real.view.page import report as write  # matplotlib and jinja2 take 0.5 s to import

        page = write(run_dir, config.out)
    wrote(page)


def report(run: str | Path | Run, runs: str | Path = "runs") -> Path:
    """Write a run's report as one HTML page.

    Args:
        run: A run, its folder or its name, or a pipeline's name, whose newest run is taken.

    Returns:
        The page.
    """
    from sim2real.stages.shared.arguments import folder_of
    from sim2real.view.page import report as write

    folder = getattr(run, "folder", None)
    return write(folder if isinstance(folder, Path) else find_run(folder_of(runs, "runs"), folder_of(run, "run")))


def _show(run_dir: Path, target: str, follow: bool) -> None:
    """Show a run in the viewer, or write a file for it."""
    from sim2real.artifacts.run import pipeline_of
    from sim2real.stages import live
    from sim2real.stages.load import load_robot
    from sim2real.stages.terminal.console import wrote
    from sim2real.view.rerun_recording import view

    robot = load_robot(pipeline_of(run_dir))
    scene = live.drawn(live.scene_of(robot))
    if follow:
        live.follow(run_dir, robot.name, target, scene)
        return
    save = Path(target) if target.endswith(".rrd") and "://" not in target else None
    view(run_dir, save, scene, live.serve if target != WINDOW and save is None else None)
    if save is not None:
        wrote(save)


def compare(config: ReportConfig) -> Comparison:
    """Print parameters with intervals, errors and success of several runs, and write the page.

    Raises:
        UsageError: The runs are of different robots, or have nothing in common.
        Sim2RealError: An artifact is missing or malformed.
    """
    from sim2real.artifacts.comparison import ComparedRun, Comparison
    from sim2real.artifacts.deployment import Deployment
    from sim2real.artifacts.files import to_json
    from sim2real.artifacts.identification import Identification
    from sim2real.stages.terminal.console import artifact_table, note, wrote

    # Find the runs, which must be of one robot.
    all_stages = [_stages_of(target, config.runs) for target in config.targets]
    robots = list(dict.fromkeys(next(iter(stages.values())).manifest.pipeline for stages in all_stages))
    if len(robots) > 1:
        raise UsageError(f"these are runs of different robots: {', '.join(robots)}", hint="compare runs of one robot")
    # Read the artifacts of each run, and compare them.
    runs = []
    for name, stages in zip(_names(all_stages), all_stages, strict=True):
        started = min(stage.manifest.started for stage in stages.values())
        identify, deploy = stages.get("identify"), stages.get("deploy")
        identification = None if identify is None else Identification.load(identify.folder)
        deployment = None if deploy is None else Deployment.read(deploy.folder)
        runs.append(ComparedRun(name, started.replace("T", " ")[:16], identification, deployment))
    comparison = Comparison(tuple(runs))
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
    from sim2real.view.page import comparison_page  # imports matplotlib

    page = comparison_page(comparison, config.out or Path(COMPARISON))
    if config.json:
        note(f"wrote {page}")  # stdout gets only JSON
    else:
        wrote(page)
    return comparison


def _stages_of(target: str, root: Path) -> dict[str, StageFolder]:
    """Return the finished stages of a run; a stage folder selects its run, and this attempt at the stage."""
    from sim2real.artifacts.run import StageFolder, finished_stages

    stages = finished_stages(find_run(root, target))
    if (attempt := StageFolder.read(Path(target))) is not None:
        stages |= {attempt.stage: attempt}
    return stages


def _names(all_stages: Sequence[dict[str, StageFolder]]) -> list[str]:
    """Return a name for each run: its folder's name, with a number if two are equal."""
    names = [next(iter(stages.values())).run_dir.resolve().name for stages in all_stages]
    return [name if names.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(names)]
