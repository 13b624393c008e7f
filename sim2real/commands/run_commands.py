"""Commands about whole runs: ``run``, ``demo``, ``view``, ``report`` and ``info``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sim2real.commands.command_kinds import DEMO_PIPELINE, epilog, run_stage, split_pipeline
from sim2real.errors import UsageError
from sim2real.runtime import compilation_cache

if TYPE_CHECKING:
    from sim2real.artifacts.run.run_folder import StageFolder
    from sim2real.commands.flags import RunFlags, TargetFlags
    from sim2real.stages.pipeline.pipeline import Pipeline

F = TypeVar("F", bound="TargetFlags")


def run(command: str, arguments: list[str]) -> None:
    """``sim2real run PIPELINE [FLAGS]``."""
    from sim2real.commands import flags

    # The flags of all stages, with the pipeline's defaults.
    pipeline, rest = split_pipeline(command, arguments)
    default = flags.RunFlags(**pipeline.in_a_run)
    texts = {
        "prog": f"sim2real run {pipeline.name}",
        "description": "Record, identify, train and deploy, one after the other.",
        "epilog": epilog(
            f"sim2real run {pipeline.name} --seed 3 --record.duration-s 20",
            f"sim2real run {pipeline.name} --resume runs/{pipeline.name}/TIME",
            f"sim2real run {pipeline.name} --iterations 5 --until success=0.95",
        ),
    }
    parsed = flags.parse(default, rest, **texts)
    if parsed.seed is not None:
        # Make the seed the default of every stage and parse again, so that the seed flag of one stage overrides it.
        parsed = flags.parse(_with_seed(default, parsed.seed), rest, **texts)
    _run_stages(pipeline, parsed)


def demo(command: str, arguments: list[str]) -> None:
    """``sim2real demo [FLAGS]``."""
    from sim2real.commands import flags
    from sim2real.stages.pipeline.pipeline import load_pipeline

    parsed = flags.parse(
        flags.DemoFlags(),
        arguments,
        prog=f"sim2real {command}",
        description=f"Record, identify, train and deploy the embedded {DEMO_PIPELINE}, with its defaults.",
        epilog=epilog("sim2real demo --seed 1", f"sim2real run {DEMO_PIPELINE} --help"),
    )
    pipeline = load_pipeline(DEMO_PIPELINE)
    common = (parsed.seed, parsed.runs, parsed.resume, parsed.cache, parsed.verbose)
    run_flags = flags.RunFlags(*common, **pipeline.in_a_run)
    _run_stages(pipeline, run_flags if parsed.seed is None else _with_seed(run_flags, parsed.seed))


def view(command: str, arguments: list[str]) -> None:
    """``sim2real view RUN|PIPELINE [--save FILE.rrd | --web] [--follow]``."""
    from sim2real.commands import flags

    description = "Open a run in the Rerun viewer: a run folder, or a pipeline's newest run."
    run_dir, parsed = _find_target(command, arguments, flags.ViewFlags(), description)
    from sim2real.artifacts.run.run_folder import pipeline_of
    from sim2real.stages.live.follow import follow, serve
    from sim2real.stages.live.scene import drawn, scene_of
    from sim2real.stages.pipeline.pipeline import load_pipeline
    from sim2real.stages.terminal.console import wrote
    from sim2real.view.rerun_recording import view as view_run

    if parsed.save is not None and (parsed.web or parsed.follow):
        raise UsageError("--save writes a file: it excludes --web and --follow")
    pipeline = load_pipeline(pipeline_of(run_dir))
    scene = drawn(scene_of(pipeline, None if pipeline.scene else pipeline.load()))
    if parsed.follow:
        follow(run_dir, pipeline.name, "web" if parsed.web else "window", scene)
        return
    view_run(run_dir, parsed.save, scene, serve if parsed.web else None)
    if parsed.save is not None:
        wrote(parsed.save)


def report(command: str, arguments: list[str]) -> None:
    """``sim2real report RUN|PIPELINE``."""
    from sim2real.commands import flags

    description = "Write a run's report as one HTML page: of a run folder, or a pipeline's newest."
    run_dir, _ = _find_target(command, arguments, flags.TargetFlags(), description)
    from sim2real.stages.terminal.console import wrote
    from sim2real.view.page.page import report as write_report

    wrote(write_report(run_dir))


def info(command: str, arguments: list[str]) -> None:
    """``sim2real info [PIPELINE|LOG|RUN]``."""
    from sim2real.commands import flags
    from sim2real.commands import info as texts
    from sim2real.stages.pipeline import find_run
    from sim2real.stages.pipeline.pipeline import available

    # The first word that is no flag is the target.
    has_target = bool(arguments) and not arguments[0].startswith("-")
    target, rest = (arguments[0], arguments[1:]) if has_target else (None, arguments)
    description = "About the installation; or about a pipeline, an MCAP log, a run folder."
    examples = epilog("sim2real info", f"sim2real info {DEMO_PIPELINE}", f"sim2real info runs/{DEMO_PIPELINE}/TIME")
    parsed = flags.parse(flags.InfoFlags(), rest, f"sim2real {command} [PIPELINE|LOG|RUN]", description, examples)
    # The kind of target decides the printed text.
    if target is None:
        print(texts.installation())
    elif Path(target).is_file():
        print(texts.log(Path(target)))
    elif target in available():
        print(texts.pipeline(target, parsed.runs, parsed.verbose))
    else:
        print(texts.run(find_run.find_run(parsed.runs, target)))


def _run_stages(pipeline: Pipeline, flags: RunFlags) -> None:
    """Run the four stages in one run folder, as often as the flags allow."""
    compilation_cache.enable(flags.cache)
    from sim2real.commands.loop.in_brief import conclude, in_brief
    from sim2real.commands.loop.run_loop import run_all

    def call(stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        folder = run_stage(stage, pipeline, config, flags.runs, run_dir)
        if folder is None:
            raise UsageError(f"{stage} runs in several processes, and this one writes no folder")
        return folder

    conclude(run_all(pipeline, flags, call if flags.verbose else in_brief(call)))


def _find_target(command: str, arguments: list[str], default: F, description: str) -> tuple[Path, F]:
    """Return the run folder that the first argument names, and the flags after it."""
    from sim2real.commands import flags
    from sim2real.stages.pipeline.find_run import find_run
    from sim2real.stages.pipeline.pipeline import available

    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help")):
        names = ", ".join(sorted(available())) or "none"
        raise UsageError(
            f"{command} needs a run folder or a pipeline before its flags. Pipelines: {names}",
            hint=f"see `sim2real {command} --help`",
        )
    target, rest = ("RUN|PIPELINE", arguments) if arguments[0].startswith("-") else (arguments[0], arguments[1:])
    examples = epilog(f"sim2real {command} {DEMO_PIPELINE}", f"sim2real {command} runs/{DEMO_PIPELINE}/TIME")
    parsed = flags.parse(default, rest, f"sim2real {command} {target}", description, examples)
    return find_run(parsed.runs, target), parsed


def _with_seed(flags: RunFlags, seed: int) -> RunFlags:
    """Return the flags of a run with one seed in every stage."""
    from sim2real.artifacts.run.run_folder import STAGES

    return replace(flags, **{stage: replace(getattr(flags, stage), seed=seed) for stage in STAGES})
