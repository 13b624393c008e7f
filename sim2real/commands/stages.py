"""Commands that call one stage or one function: parse the flags, run, print the written files."""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar

from sim2real.artifacts.paths import shown
from sim2real.commands import flags
from sim2real.errors import ERROR, UsageError
from sim2real.installation import has_jax
from sim2real.runtime import compilation_cache
from sim2real.stages.config import DeployConfig, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.stages.flag import Flag
from sim2real.stages.load import available, defaults_of, load_robot

if TYPE_CHECKING:
    from sim2real.artifacts.run import StageFolder
    from sim2real.robots.robot import RecordedRobot

DEMO_PIPELINE = "pendulum"
Config = TypeVar("Config")


@dataclass(frozen=True)
class StageFlags(Generic[Config]):
    """Flags of one stage."""

    config: Annotated[Config, Flag(flat=True)]
    runs: Path = Path("runs")
    """Folder of all runs."""
    run: Annotated[Path | None, Flag("DIR")] = None
    """Run folder to add to; default: a new one for record, otherwise the newest one with the inputs."""


@dataclass(frozen=True)
class DemoFlags:
    """Record, identify, train and deploy an emulated robot, with its defaults."""

    seed: int | None = None
    """Seed of every stage."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    resume: Annotated[Path | None, Flag("DIR")] = None
    """Run folder to continue; stages that are finished there, from the newest inputs, are skipped."""
    verbose: bool = False
    """Print all output of the stages; default: a few lines for each stage."""


@dataclass(frozen=True)
class RunFlags(DemoFlags):
    """Record, identify, train and deploy, one after the other."""

    iterations: int = 1
    """Most iterations: the verdict on a deployment chooses the stages that run again, until it is 'fine'."""
    record: RecordConfig = field(default_factory=RecordConfig)
    identify: IdentifyConfig = field(default_factory=IdentifyConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    deploy: DeployConfig = field(default_factory=DeployConfig)

    def __post_init__(self) -> None:
        """Check what can be checked before anything moves."""
        if self.train.hosts.several:
            raise UsageError(
                "only training can be divided among processes: here each process would record and deploy",
                hint="record and identify in one, then `sim2real train PIPELINE --hosts.found` in all",
            )
        if self.iterations < 1:
            raise UsageError(f"iterations must be at least 1, got {self.iterations}", hint="--iterations 5")

    def with_seed(self, seed: int | None) -> RunFlags:
        """Return the flags with one seed in every stage; None changes nothing."""
        if seed is None:
            return self
        stages: dict[str, Any] = {s: getattr(self, s) for s in ("record", "identify", "train", "deploy")}
        return replace(self, **{stage: replace(config, seed=seed) for stage, config in stages.items()})


def stage(command: str, arguments: list[str]) -> None:
    """``sim2real record|identify|train|deploy PIPELINE [FLAGS]``."""
    name, rest = split_pipeline(command, arguments)
    default = getattr(defaults_of(name), command)
    examples = (f"{command} {name} --runs /data/runs", f"report {name}")
    text = (type(default).__doc__ or "").strip().splitlines()[0]
    parsed = flags.parse(StageFlags(default), rest, f"sim2real {command} {name}", *examples, text=text)
    compilation_cache.enable()
    run_dir = None
    if parsed.run:
        from sim2real.stages.shared.find_run import find_run

        run_dir = find_run(parsed.runs, parsed.run, name)
    run_stage(command, load_robot(name), parsed.config, parsed.runs, run_dir, page=command in ("identify", "deploy"))


def check(command: str, arguments: list[str]) -> None:
    """``sim2real check PIPELINE [FLAGS]``."""
    from sim2real.stages.check.config import CheckConfig

    name, rest = split_pipeline(command, arguments)
    default = CheckConfig(record=defaults_of(name).record)
    examples = (f"check {name} --log session.mcap", f"check {name} --plan --record.duration-s 60")
    text = f"{(CheckConfig.__doc__ or '').splitlines()[0]} Ends with code 1 if a parameter is not determined."
    config = flags.parse(default, rest, f"sim2real check {name}", *examples, text=text)
    compilation_cache.enable()
    _end(_imported("check").run(load_robot(name), config))


def validate(command: str, arguments: list[str]) -> None:
    """``sim2real validate PARAMETERS --log FILE [FLAGS]``."""
    from sim2real.stages.validate.config import ValidateConfig

    text = (
        f"{(ValidateConfig.__doc__ or '').splitlines()[0]} Ends with code 1 if an error exceeds the expected one, a "
        "baseline predicts as well, or a log is not scored."
    )
    example = "validate runs/NAME/TIME/identify --log b.mcap"
    config = flags.parse(ValidateConfig(), arguments, f"sim2real {command}", example, text=text)
    compilation_cache.enable()
    _end(_imported("validate").run(config))


def import_files(command: str, arguments: list[str]) -> None:
    """``sim2real import FILE... [FLAGS]``."""
    from sim2real.stages.import_logs.config import ImportConfig

    examples = ("import run.csv --mjcf robot.xml", "import DATASET --like so101", "info LOG")
    config = flags.parse(ImportConfig(), arguments, f"sim2real {command}", *examples)
    _imported("import_logs").run(config)


def run_stage(
    name: str, robot: RecordedRobot, config: Any, runs: Path, run_dir: Path | None, page: bool = True
) -> StageFolder | None:
    """Run a stage, print its summary and the names of its files, and write the run's page.

    Args:
        page: Whether to write the page; otherwise a later stage of the same command writes it.

    Returns:
        The stage's folder; None in a training of several processes, where another process writes it.
    """
    from sim2real.stages.terminal import console

    folder: StageFolder | None = _imported(name).run(robot, config, runs, run_dir)
    if folder is None:
        return None
    if folder.manifest.summary:
        print(console.pairs(folder.manifest.summary))
    for path in [*folder.outputs.values(), folder.folder / "manifest.json"]:
        console.wrote(path)
    if page:
        write_report(folder.run_dir)
    return folder


def write_report(run_dir: Path) -> Path | None:
    """Write the page of a run and print its name; None, with a note, on a robot's computer without JAX."""
    from sim2real.stages.terminal import console

    if not has_jax():
        console.note(f"no page: `sim2real report {shown(run_dir)}` writes it on a computer with sim2real")
        return None
    with console.progress(None, "report"):
        from sim2real.view.page import report  # matplotlib and jinja2 take 0.5 s to import

        page = report(run_dir)
    console.wrote(page)
    return page


def split_pipeline(command: str, arguments: list[str]) -> tuple[str, list[str]]:
    """Return the name of the pipeline, which is the first argument, and the other arguments.

    ``--help`` without a pipeline shows the flags of the demo's pipeline.
    """
    if arguments and arguments[0] in ("-h", "--help", "--help-all"):
        return DEMO_PIPELINE, arguments
    if not arguments or arguments[0].startswith("-"):
        model = next((b for a, b in pairwise(arguments) if a == "--mjcf"), "MODEL")
        raise UsageError(
            f"{command} needs a pipeline before its flags. Available: {', '.join(sorted(available())) or 'none'}",
            hint=f"sim2real {command} PIPELINE [FLAGS]; `sim2real new NAME --mjcf {model}` makes a pipeline of a model",
        )
    return arguments[0], arguments[1:]


def module_of(stage: str) -> str:
    """Return the name of the module whose ``run`` is a stage."""
    return f"sim2real.stages.{'session.record' if stage == 'record' else f'{stage}.stage'}"


def _imported(stage: str) -> Any:
    """Import a stage with JAX, which takes seconds; a terminal shows that they pass."""
    from sim2real.stages.terminal import console

    with console.progress(None, "loading", sys.stderr.isatty()):
        return importlib.import_module(module_of(stage))


def _end(good: bool) -> None:
    if not good:
        sys.exit(ERROR)
