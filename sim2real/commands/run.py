"""``sim2real run`` and ``demo``: the four stages in one run folder, then iterations by the verdicts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.paths import shown
from sim2real.commands import flags
from sim2real.commands.stages import DEMO_PIPELINE, DemoFlags, RunFlags, run_stage, split_pipeline, write_report
from sim2real.errors import UsageError
from sim2real.runtime import compilation_cache
from sim2real.stages.load import defaults_of, load_robot

if TYPE_CHECKING:
    from sim2real.artifacts.run import StageFolder

_FIGURES = {
    "record": ("seconds", "lost replies", "late replies"),
    "identify": ("verdict", "round trip delay"),
    "train": ("success in simulation", "what breaks it"),
    "deploy": ("measured delay",),
}
"""Stage -> figures of its summary that a run prints, in addition to error and success."""


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
    """Run the stages, print the main figures of each, then the verdict and the page."""
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
    from sim2real.artifacts.identification import Identification, with_small_unit

    summary = done.manifest.summary
    figures = {name: summary[name] for name in _FIGURES[done.stage] if name in summary}
    if done.stage == "identify" and (rows := Identification.load(done.output("parameters")).held_out):
        worst, which = rows[0], ", the worst joint" if len(rows) > 1 else ""
        size = "diverges" if worst.error is None else with_small_unit(worst.error, worst.unit)
        figures[f"error {worst.seconds:g} s ahead"] = f"{worst.joint} {size}{which}"
    if done.stage == "deploy":
        real = [e.real["success"] for e in Deployment.read(done.folder).episodes if e.real.get("success") is not None]
        figures |= {"success on the robot": ", ".join(f"{value:.2f}" for value in real)} if real else {}
    return figures
