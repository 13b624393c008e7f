"""The commands by name: each parses its flags and calls a stage or another command."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.errors import ERROR, UsageError
from sim2real.runtime import compilation_cache

if TYPE_CHECKING:
    from sim2real.artifacts.run.run_folder import StageFolder
    from sim2real.stages.pipeline.pipeline import Pipeline

DEMO_PIPELINE = "pendulum"
_WORSE = " Ends with code 1 where a baseline predicts as well."

EXIT_CODES = """\
exit codes
  0  finished                    4  hardware lost: a port or a device does not answer
  1  error                       5  deadlines missed (with --strict-timing)
  2  wrong command or flag       130, 143  ended by Ctrl-C, by SIGTERM; the robot is switched off first
  3  safety stop"""


def _stage(stage: str, arguments: list[str]) -> None:
    """``sim2real STAGE PIPELINE [flags]``."""
    from sim2real.commands import flags, model_flags
    from sim2real.stages.pipeline import find_run

    if stage == "identify" and model_flags.by_model(arguments):
        told = model_flags.parse_identify(arguments, EXIT_CODES)
        compilation_cache.enable(told.cache)
        from sim2real.stages.pipeline import from_model  # imports JAX

        _call_stage(stage, from_model.from_flags(told.robot, told.config.log), told.config, told.runs, told.run)
        return
    pipeline, rest = _pipeline_first(stage, arguments)
    config = getattr(pipeline, stage)
    parsed = flags.parse(
        flags.StageFlags(config),
        rest,
        prog=f"sim2real {stage} {pipeline.name}",
        description=_summary(config),
        epilog=_epilog(f"sim2real {stage} {pipeline.name} --runs /data/runs", f"sim2real report {pipeline.name}"),
        kind=flags.StageFlags[type(config)],
    )
    compilation_cache.enable(parsed.cache)
    run_dir = find_run.find_run(parsed.runs, parsed.run, pipeline.name) if parsed.run else None
    _call_stage(stage, pipeline, parsed.config, parsed.runs, run_dir)


def _run(command: str, arguments: list[str]) -> None:
    """``sim2real run PIPELINE [flags]``."""
    from sim2real.artifacts.run.run_folder import STAGES
    from sim2real.commands import flags

    pipeline, rest = _pipeline_first(command, arguments)
    default = flags.RunFlags(**{stage: getattr(pipeline, stage) for stage in STAGES})
    texts = {
        "prog": f"sim2real run {pipeline.name}",
        "description": "Record, identify, train and deploy, one after the other.",
        "epilog": _epilog(
            f"sim2real run {pipeline.name} --seed 3 --record.duration-s 20",
            f"sim2real run {pipeline.name} --resume runs/{pipeline.name}/TIME",
            f"sim2real run {pipeline.name} --iterations 5 --until success=0.95",
        ),
    }
    parsed = flags.parse(default, rest, **texts)
    if parsed.seed is not None:
        # The seed becomes the stages' default and the flags are read again: a stage's own seed flag wins.
        parsed = flags.parse(_seeded(default, parsed.seed), rest, **texts)
    _run_all(pipeline, parsed)


def _demo(command: str, arguments: list[str]) -> None:
    """``sim2real demo [flags]``."""
    from sim2real.artifacts.run.run_folder import STAGES
    from sim2real.commands import flags
    from sim2real.stages.pipeline.pipeline import load_pipeline

    parsed = flags.parse(
        flags.DemoFlags(),
        arguments,
        prog=f"sim2real {command}",
        description=f"Record, identify, train and deploy the embedded {DEMO_PIPELINE}, with its defaults.",
        epilog=_epilog("sim2real demo --seed 1", f"sim2real run {DEMO_PIPELINE} --help"),
    )
    pipeline = load_pipeline(DEMO_PIPELINE)
    stages = {stage: getattr(pipeline, stage) for stage in STAGES}
    everything = flags.RunFlags(parsed.seed, parsed.runs, parsed.resume, parsed.cache, parsed.verbose, **stages)
    _run_all(pipeline, everything if parsed.seed is None else _seeded(everything, parsed.seed))


def _view(command: str, arguments: list[str]) -> None:
    """``sim2real view RUN|PIPELINE [--save FILE.rrd]`` and ``sim2real report RUN|PIPELINE``."""
    from sim2real.commands import flags
    from sim2real.stages.pipeline import find_run
    from sim2real.stages.pipeline.pipeline import available
    from sim2real.stages.terminal import console

    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help")):
        names = ", ".join(sorted(available())) or "none"
        raise UsageError(
            f"{command} needs a run folder or a pipeline before its flags. Pipelines: {names}",
            hint=f"see `sim2real {command} --help`",
        )
    target, rest = ("RUN|PIPELINE", arguments) if arguments[0].startswith("-") else (arguments[0], arguments[1:])
    looks = {
        "view": (flags.ViewFlags(), "Open a run in the Rerun viewer: a run folder, or a pipeline's newest run."),
        "report": (
            flags.TargetFlags(),
            "Write a run's report as one HTML page: of a run folder, or a pipeline's newest.",
        ),
    }
    default, description = looks[command]
    epilog = _epilog(f"sim2real {command} {DEMO_PIPELINE}", f"sim2real {command} runs/{DEMO_PIPELINE}/TIME")
    parsed = flags.parse(default, rest, f"sim2real {command} {target}", description, epilog)
    run_dir = find_run.find_run(parsed.runs, target)
    if isinstance(parsed, flags.ViewFlags):
        from sim2real.artifacts.run.run_folder import pipeline_of
        from sim2real.stages.pipeline.pipeline import load_pipeline
        from sim2real.view.rerun_recording import view

        pipeline = load_pipeline(pipeline_of(run_dir))
        view(run_dir, parsed.save, pipeline.load(pipeline.scene).log_scene if pipeline.scene else None)
        if parsed.save is not None:
            console.wrote(parsed.save)
    else:
        from sim2real.view.page.page import report

        console.wrote(report(run_dir))


def _info(command: str, arguments: list[str]) -> None:
    """``sim2real info [PIPELINE|LOG|RUN]``."""
    from sim2real.commands import flags, info
    from sim2real.stages.pipeline import find_run
    from sim2real.stages.pipeline.pipeline import available

    named = bool(arguments) and not arguments[0].startswith("-")
    target, rest = (arguments[0], arguments[1:]) if named else (None, arguments)
    description = "About the installation; or about a pipeline, an MCAP log, a run folder."
    epilog = _epilog("sim2real info", f"sim2real info {DEMO_PIPELINE}", f"sim2real info runs/{DEMO_PIPELINE}/TIME")
    parsed = flags.parse(flags.TargetFlags(), rest, f"sim2real {command} [PIPELINE|LOG|RUN]", description, epilog)
    if target is None:
        print(info.installation())
    elif Path(target).is_file():
        print(info.log(Path(target)))
    elif target in available():
        print(info.pipeline(target, parsed.runs))
    else:
        print(info.run(find_run.find_run(parsed.runs, target)))


def _files(command: str, arguments: list[str]) -> None:
    """``sim2real import FILE...``, ``validate PARAMETERS --log NEW`` and ``new NAME ROBOT.xml``."""
    from sim2real.commands import flags
    from sim2real.commands.config import NewConfig
    from sim2real.stages.compare.config import CompareConfig
    from sim2real.stages.import_logs.config import ImportConfig
    from sim2real.stages.validate.config import ValidateConfig

    kind, stage, text, *examples = {
        "import": (ImportConfig, "stages.import_logs.stage", "", "import data.npz --mjcf robot.xml", "info LOG"),
        "validate": (ValidateConfig, "stages.validate.stage", _WORSE, "validate runs/NAME/TIME/identify --log b.mcap"),
        "compare": (CompareConfig, "stages.compare.stage", "", "compare runs/NAME/MONDAY runs/NAME/FRIDAY"),
        "new": (NewConfig, "commands.new", "", "new go2 go2.xml --log run.csv", "identify go2"),
    }[command]
    own, epilog = kind(), _epilog(*(f"sim2real {example}" for example in examples))
    asked = flags.parse(own, arguments, f"sim2real {command}", _summary(own) + text, epilog)
    compilation_cache.enable()
    if importlib.import_module(f"sim2real.{stage}").run(asked) is False:  # imports JAX
        sys.exit(ERROR)


_ACTIONS = {
    "log": {"recover": ("Recover", "recover_log", "FILE", "session.mcap", "session.mcap --out saved.mcap")},
    "export": {
        "identified": (
            *("Export", "export_model", "RUN|PIPELINE|FILE --to mjcf|mjlab|isaaclab|json"),
            *(f"{DEMO_PIPELINE} --to json", "runs/arm/TIME --to mjcf --out arm.xml"),
        ),
        "policy": ("Ship", "export_policy", "RUN|PIPELINE|BUNDLE --to DIR", f"{DEMO_PIPELINE} --to policy"),
    },
}
"""Command -> what it can do -> configuration, stage, what comes behind it, and examples of that."""


def _act(command: str, arguments: list[str]) -> None:
    """``sim2real log recover FILE``, ``sim2real export identified`` and ``sim2real export policy``."""
    from sim2real.commands import config, flags

    actions, (action, *rest) = _ACTIONS[command], arguments or [""]
    if action in ("-h", "--help"):
        action, rest = next(iter(actions)), ["--help"]
    if action not in actions:
        said = f"there is no `{command} {action}`" if action else f"{command} needs to be told what to do"
        uses = " or ".join(f"sim2real {command} {name} {about[2]}" for name, about in actions.items())
        raise UsageError(f"{said}. Available: {', '.join(actions)}", hint=uses)
    kind, stage, _, *examples = actions[action]
    prog = f"sim2real {command} {action}"
    own, epilog = getattr(config, f"{kind}Config")(), _epilog(*(f"{prog} {example}" for example in examples))
    asked = flags.parse(own, rest, prog, _summary(own), epilog)
    importlib.import_module(f"sim2real.commands.{stage}").run(asked)  # imports JAX


def _check(command: str, arguments: list[str]) -> None:
    """``sim2real check PIPELINE [flags]``."""
    if not {"-h", "--help"} & set(arguments):
        compilation_cache.enable()
    from sim2real.commands import flags, model_flags
    from sim2real.stages.check.config import CheckConfig

    if model_flags.by_model(arguments):
        told = model_flags.parse_check(arguments, EXIT_CODES)
        from sim2real.stages.check import stage as check_stage
        from sim2real.stages.pipeline import from_model  # imports JAX

        if not check_stage.run(from_model.from_flags(told.robot, told.config.log), told.config.config()):
            sys.exit(ERROR)
        return
    pipeline, rest = _pipeline_first(command, arguments)
    prog = f"sim2real {command} {pipeline.name}"
    own = CheckConfig(record=pipeline.record)
    text = f"{_summary(own)} Ends with code 1 when something is not determined."
    epilog = _epilog(f"{prog} --log session.mcap", f"{prog} --plan --record.duration-s 60")
    asked = flags.parse(own, rest, prog, text, epilog)
    from sim2real.stages.check import stage as check_stage  # imports JAX

    if not check_stage.run(pipeline, asked):
        sys.exit(ERROR)


COMMANDS: dict[str, Callable[[str, list[str]], None]] = {
    "record": _stage,
    "identify": _stage,
    "train": _stage,
    "deploy": _stage,
    "run": _run,
    "demo": _demo,
    "view": _view,
    "report": _view,
    "info": _info,
    "latency": _stage,
    "check": _check,
    **dict.fromkeys(("import", "validate", "compare", "new"), _files),
    **dict.fromkeys(("log", "export"), _act),
}


def _run_all(pipeline: Pipeline, flags: Any) -> None:
    """Run the four stages in one run folder, and around again where that was asked for."""
    compilation_cache.enable(flags.cache)
    from sim2real.commands.in_brief import conclude, in_brief
    from sim2real.commands.run_loop import run_all

    def call(stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        done = _call_stage(stage, pipeline, config, flags.runs, run_dir)
        assert done is not None, "RunFlags refuses several processes"
        return done

    conclude(run_all(pipeline, flags, call if flags.verbose else in_brief(call)))


def _call_stage(stage: str, pipeline: Pipeline, config: Any, root: Path, run_dir: Path | None) -> StageFolder | None:
    """Call a stage's entry point, print its summary and what it wrote, and return what it left."""
    from sim2real.stages.terminal import console

    if (done := importlib.import_module(f"sim2real.stages.{stage}.stage").run(pipeline, config, root, run_dir)) is None:
        return None  # another process writes
    if done.manifest["summary"]:
        print(console.pairs(done.manifest["summary"]))
    for path in [*done.outputs.values(), done.folder / "manifest.json"]:
        console.wrote(path)
    return done


def _pipeline_first(command: str, arguments: list[str]) -> tuple[Pipeline, list[str]]:
    """Take the pipeline off the arguments; without one, ``--help`` shows the demo's."""
    from sim2real.stages.pipeline.pipeline import available, load_pipeline

    if arguments and arguments[0] in ("-h", "--help"):
        return load_pipeline(DEMO_PIPELINE), ["--help"]
    if not arguments or arguments[0].startswith("-"):
        raise UsageError(
            f"{command} needs a pipeline before its flags. Available: {', '.join(sorted(available())) or 'none'}",
            hint=f"sim2real {command} PIPELINE [FLAGS]; see `sim2real {command} --help`",
        )
    return load_pipeline(arguments[0]), arguments[1:]


def _seeded(flags: Any, seed: int) -> Any:
    """Return the flags of a run with one seed in every stage."""
    from sim2real.artifacts.run.run_folder import STAGES

    return replace(flags, **{stage: replace(getattr(flags, stage), seed=seed) for stage in STAGES})


def _summary(config: Any) -> str:
    return (type(config).__doc__ or "").strip().splitlines()[0]


def _epilog(*examples: str) -> str:
    return "\n".join(["examples", *(f"  {example}" for example in examples), "", EXIT_CODES])
