"""``sim2real run`` and ``demo``: the four stages in one run folder, and the iterations that the verdicts ask for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from sim2real.artifacts.paths import shown
from sim2real.commands import flags
from sim2real.commands.stages import DEMO_PIPELINE, run_stage, split_pipeline, write_report
from sim2real.errors import UsageError
from sim2real.runtime import compilation_cache
from sim2real.stages.config import DeployConfig, IdentifyConfig, RecordConfig, TrainConfig
from sim2real.stages.flag import Flag
from sim2real.stages.load import defaults_of, load_robot

if TYPE_CHECKING:
    from sim2real.artifacts.run import StageFolder

_FIGURES = {
    "record": ("seconds", "lost replies", "late replies"),
    "identify": ("verdict", "round trip delay"),
    "train": ("success in simulation", "what breaks it"),
    "deploy": ("measured delay",),
}
"""Stage -> the figures of its summary that a run prints, beside the error and the success."""


@dataclass(frozen=True)
class DemoFlags:
    """Record, identify, train and deploy an emulated robot, with its defaults."""

    seed: int | None = None
    """Seed of every stage."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    resume: Annotated[Path | None, Flag("DIR")] = None
    """Run folder to go on with: stages that are finished there, from the newest inputs, are skipped."""
    verbose: bool = False
    """Print everything that the stages print; default: a few lines for each stage."""


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
                "only training is divided among processes: each of them would record and deploy",
                hint="record and identify in one, then `sim2real train PIPELINE --hosts.found` in all",
            )
        if self.iterations < 1:
            raise UsageError(f"a run iterates at least once, got {self.iterations}", hint="--iterations 5")

    def with_seed(self, seed: int | None) -> RunFlags:
        """Return the flags with one seed in every stage; None changes nothing."""
        if seed is None:
            return self
        stages: dict[str, Any] = {s: getattr(self, s) for s in ("record", "identify", "train", "deploy")}
        return replace(self, **{stage: replace(config, seed=seed) for stage, config in stages.items()})


def run_command(command: str, arguments: list[str]) -> None:
    """``sim2real run PIPELINE [FLAGS]``."""
    name, rest = split_pipeline(command, arguments)
    default = RunFlags(**defaults_of(name).in_a_run)
    examples = ("--seed 3 --record.duration-s 20", f"--resume runs/{name}/TIME", "--iterations 5")
    texts = (f"sim2real run {name}", *(f"run {name} {example}" for example in examples))
    parsed = flags.parse(default, rest, *texts)
    # The seed is the default of every stage: the seed flag of a stage overrides it.
    _run(name, flags.parse(default.with_seed(parsed.seed), rest, *texts))


def demo(command: str, arguments: list[str]) -> None:
    """``sim2real demo [FLAGS]``: ``run`` with the embedded pendulum's defaults."""
    examples = ("demo --seed 1", f"run {DEMO_PIPELINE} --help")
    parsed = flags.parse(DemoFlags(), arguments, f"sim2real {command}", *examples)
    configs = defaults_of(DEMO_PIPELINE).in_a_run
    _run(DEMO_PIPELINE, RunFlags(**{**vars(parsed), **configs}).with_seed(parsed.seed))


def _run(name: str, parsed: RunFlags) -> None:
    """Run the stages, print the main figures of each, and end with the verdict and the page."""
    compilation_cache.enable()
    from sim2real.commands.loop import run_all
    from sim2real.stages.terminal import console

    robot = load_robot(name)

    def call(stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        if parsed.verbose:
            done = run_stage(stage, robot, config, parsed.runs, run_dir, page=stage == "identify")
        else:
            with console.brief():
                done = run_stage(stage, robot, config, parsed.runs, run_dir, page=stage == "identify")
        if done is None:
            raise UsageError(f"{stage} runs in several processes, and this one writes no folder")
        if not parsed.verbose and (figures := main_figures(done)):
            print("\n".join(f"  {line}" for line in console.pairs(figures).splitlines()), flush=True)
        return done

    if (run_dir := run_all(robot, parsed, call)) is not None:
        conclude(run_dir)


def conclude(run_dir: Path) -> None:
    """Write the page of a run; print the verdict and the name of the page."""
    from sim2real.artifacts.deployment import Deployment
    from sim2real.artifacts.run import finished

    page = write_report(run_dir)
    deployed = finished(run_dir, "deploy")
    deployment = None if deployed is None else Deployment.read(deployed.folder)
    result = "the run is finished"
    if deployment is not None and deployment.verdict is not None:
        result = f"{deployment.verdict.status}: {'; '.join(deployment.reasons)}"
    print(f"{result}. {f'Open {shown(page)}' if page else ''}".rstrip(), flush=True)


def main_figures(done: StageFolder) -> dict[str, Any]:
    """Return the figures of a stage that a run prints: name -> value."""
    from sim2real.artifacts.deployment import Deployment
    from sim2real.artifacts.identification import Identification

    summary = done.manifest.summary
    figures = {name: summary[name] for name in _FIGURES[done.stage] if name in summary}
    if done.stage == "identify" and (rows := Identification.load(done.output("parameters")).held_out):
        worst, which = rows[0], ", the worst joint" if len(rows) > 1 else ""
        error = worst.error
        figures[f"error {worst.seconds:g} s ahead"] = (
            "diverges" if error is None else f"{error:.2g} {worst.unit} of {worst.name}{which}"
        )
    if done.stage == "deploy":
        real = [e.real["success"] for e in Deployment.read(done.folder).episodes if e.real.get("success") is not None]
        figures |= {"success on the robot": ", ".join(f"{value:.2f}" for value in real)} if real else {}
    return figures
