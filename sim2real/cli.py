"""The command line: arguments in, a stage called, an exit code out."""

from __future__ import annotations

import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.errors import ERROR, OK, Sim2RealError, UsageError
from sim2real.runtime import compilation_cache
from sim2real.stages import ending
from sim2real.stages.interruption import SignalHandling

if TYPE_CHECKING:
    from sim2real.artifacts.run_folder import StageFolder
    from sim2real.stages.pipeline import Pipeline

DEMO_PIPELINE = "pendulum"
_WORSE = " Ends with code 1 where a baseline predicts as well."

EXIT_CODES = """\
exit codes
  0  finished                    4  hardware lost: a port or a device does not answer
  1  error                       5  deadlines missed (with --strict-timing)
  2  wrong command or flag       130, 143  ended by Ctrl-C, by SIGTERM; the robot is switched off first
  3  safety stop"""

HELP = f"""\
From a robot's log to a policy that works on that robot

usage: sim2real COMMAND [PIPELINE] [FLAGS]

  record    record the robot under an excitation
  identify  identify dynamics, delays and initial states from the log
  train     train a policy on the identified model with the robot's timing
  deploy    run the policy on the robot and compare with the simulation
  run       all four, one after the other; --resume RUN goes on where it ended
  demo      run on the embedded {DEMO_PIPELINE}, with its defaults
  view      open a run in the Rerun viewer, or save it as a recording
  report    write a run's report as one HTML page
  info      about the installation, a pipeline, a log or a run
  check     judge what a recording, or a planned one, can tell about the parameters
  validate  score what was identified on a later log
  latency   where the milliseconds go between motion and motion: host, bus and device
  import    turn files of other recorders into logs, and say what is what in them
  new       write the files of a pipeline for a robot of which there is a model
  export    write what was identified for MuJoCo, mjlab, Isaac Lab, or as JSON; or a policy for a bare machine
  log       recover what is readable of a damaged log into a new one

examples
  sim2real demo --seed 1
  sim2real record {DEMO_PIPELINE} --duration-s 20 --amplitude 1.5
  sim2real train {DEMO_PIPELINE} --help
  sim2real run {DEMO_PIPELINE} --train.episode-s 4
  sim2real report {DEMO_PIPELINE}
  sim2real info runs/{DEMO_PIPELINE}/TIME/record/session.mcap

Results go to stdout, progress and errors to stderr. Every stage writes into runs/PIPELINE/TIME/STAGE.
SIM2REAL_DEBUG=1 shows the traceback of an error.

{EXIT_CODES}"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    Args:
        argv: Arguments without the program's name; None takes the process's own.
    """
    with SignalHandling() as signals:
        code = _run_command(list(sys.argv[1:] if argv is None else argv), signals)
        compilation_cache.release()
        if argv is None and code != OK:
            ending.leave(code)
    return code


def _run_command(arguments: list[str], signals: SignalHandling) -> int:
    """Run a command; say what went wrong, and return the exit code that stands for it."""
    try:
        _dispatch(arguments)
        sys.stdout.flush()
    except Sim2RealError as error:
        return ending.failed(error)
    except BrokenPipeError:  # the reader of our output has closed it, as `head` does: no error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ERROR
    except KeyboardInterrupt:
        return ending.ended_by(signal.SIGINT)
    except SystemExit as end:
        if isinstance(end.code, int) and end.code > 128:
            return ending.ended_by(end.code - 128)
        return end.code if isinstance(end.code, int) else OK if end.code is None else ERROR
    except OSError as error:
        return ending.ended_by(signals.received) if signals.received else ending.refused(error)
    except Exception as error:
        if signals.received:  # an extension that is interrupted while it is imported raises ImportError
            return ending.ended_by(signals.received)
        return ending.unexpected(error)
    return OK


def _dispatch(arguments: list[str]) -> None:
    """Find the command and call it."""
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if command in ("-h", "--help", "help"):
        print(HELP)
    elif command in ("-V", "--version"):
        import sim2real

        print(f"sim2real {sim2real.__version__}")
    elif command in COMMANDS:
        COMMANDS[command](command, rest)
    else:
        kind = "flag" if command.startswith("-") else "command"
        available = ", ".join([*COMMANDS, "--help", "--version"] if kind == "flag" else COMMANDS)
        raise UsageError(f"unknown {kind} {command!r}. Available: {available}", hint="see `sim2real --help`")


def _stage(stage: str, arguments: list[str]) -> None:
    """``sim2real STAGE PIPELINE [flags]``."""
    from sim2real.stages import described_flags, flags, targets

    if stage == "identify" and described_flags.by_model(arguments):
        told = described_flags.parse_identify(arguments, EXIT_CODES)
        compilation_cache.enable(told.cache)
        from sim2real.stages import described  # imports JAX

        _call_stage(stage, described.from_flags(told.robot, told.config.log), told.config, told.runs, told.run)
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
    run_dir = targets.find_run(parsed.runs, parsed.run, pipeline.name) if parsed.run else None
    _call_stage(stage, pipeline, parsed.config, parsed.runs, run_dir)


def _run(command: str, arguments: list[str]) -> None:
    """``sim2real run PIPELINE [flags]``."""
    from sim2real.artifacts.run_folder import STAGES
    from sim2real.stages import flags

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
    from sim2real.artifacts.run_folder import STAGES
    from sim2real.stages import flags
    from sim2real.stages.pipeline import load_pipeline

    parsed = flags.parse(
        flags.DemoFlags(),
        arguments,
        prog=f"sim2real {command}",
        description=f"Record, identify, train and deploy the embedded {DEMO_PIPELINE}, with its defaults.",
        epilog=_epilog("sim2real demo --seed 1", f"sim2real run {DEMO_PIPELINE} --help"),
    )
    pipeline = load_pipeline(DEMO_PIPELINE)
    stages = {stage: getattr(pipeline, stage) for stage in STAGES}
    everything = flags.RunFlags(parsed.seed, parsed.runs, parsed.resume, parsed.cache, **stages)
    _run_all(pipeline, everything if parsed.seed is None else _seeded(everything, parsed.seed))


def _view(command: str, arguments: list[str]) -> None:
    """``sim2real view RUN|PIPELINE [--save FILE.rrd]`` and ``sim2real report RUN|PIPELINE``."""
    from sim2real.stages import console, flags, targets
    from sim2real.stages.pipeline import available

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
    run_dir = targets.find_run(parsed.runs, target)
    if isinstance(parsed, flags.ViewFlags):
        from sim2real.artifacts.run_folder import pipeline_of
        from sim2real.stages.pipeline import load_pipeline
        from sim2real.view.recording import view

        pipeline = load_pipeline(pipeline_of(run_dir))
        view(run_dir, parsed.save, pipeline.load(pipeline.scene).log_scene if pipeline.scene else None)
        if parsed.save is not None:
            console.wrote(parsed.save)
    else:
        from sim2real.view.page import report

        console.wrote(report(run_dir))


def _info(command: str, arguments: list[str]) -> None:
    """``sim2real info [PIPELINE|LOG|RUN]``."""
    from sim2real.stages import flags, info, targets
    from sim2real.stages.pipeline import available

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
        print(info.run(targets.find_run(parsed.runs, target)))


def _files(command: str, arguments: list[str]) -> None:
    """``sim2real import FILE...``, ``validate PARAMETERS --log NEW`` and ``new NAME ROBOT.xml``."""
    from sim2real.stages import flags
    from sim2real.stages.config import ImportConfig, NewConfig
    from sim2real.stages.validate_config import ValidateConfig

    kind, stage, text, *examples = {
        "import": (ImportConfig, "importing", "", "import data.npz --mjcf robot.xml", "info LOG"),
        "validate": (ValidateConfig, "validate", _WORSE, "validate runs/NAME/TIME/identify --log new.mcap"),
        "new": (NewConfig, "new", "", "new go2 go2.xml --log run.csv", "identify go2"),
    }[command]
    own, epilog = kind(), _epilog(*(f"sim2real {example}" for example in examples))
    asked = flags.parse(own, arguments, f"sim2real {command}", _summary(own) + text, epilog)
    compilation_cache.enable()
    if importlib.import_module(f"sim2real.stages.{stage}").run(asked) is False:  # imports JAX
        sys.exit(ERROR)


_ACTIONS = {
    "log": {"recover": ("Recover", "recovering", "FILE", "session.mcap", "session.mcap --out saved.mcap")},
    "export": {
        "identified": (
            *("Export", "exporting", "RUN|PIPELINE|FILE --to mjcf|mjlab|isaaclab|json"),
            *(f"{DEMO_PIPELINE} --to json", "runs/arm/TIME --to mjcf --out arm.xml"),
        ),
        "policy": ("Ship", "shipping", "RUN|PIPELINE|BUNDLE --to DIR", f"{DEMO_PIPELINE} --to policy"),
    },
}
"""Command -> what it can do -> configuration, stage, what comes behind it, and examples of that."""


def _act(command: str, arguments: list[str]) -> None:
    """``sim2real log recover FILE``, ``sim2real export identified`` and ``sim2real export policy``."""
    from sim2real.stages import config, flags

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
    importlib.import_module(f"sim2real.stages.{stage}").run(asked)  # imports JAX


def _check(command: str, arguments: list[str]) -> None:
    """``sim2real check PIPELINE [flags]``."""
    if not {"-h", "--help"} & set(arguments):
        compilation_cache.enable()
    from sim2real.stages import config, described_flags, flags

    if described_flags.by_model(arguments):
        told = described_flags.parse_check(arguments, EXIT_CODES)
        from sim2real.stages import check, described  # imports JAX

        if not check.run(described.from_flags(told.robot, told.config.log), told.config.config()):
            sys.exit(ERROR)
        return
    pipeline, rest = _pipeline_first(command, arguments)
    prog = f"sim2real {command} {pipeline.name}"
    own = config.CheckConfig(record=pipeline.record)
    text = f"{_summary(own)} Ends with code 1 when something is not determined."
    epilog = _epilog(f"{prog} --log session.mcap", f"{prog} --plan --record.duration-s 60")
    asked = flags.parse(own, rest, prog, text, epilog)
    from sim2real.stages import check  # imports JAX

    if not check.run(pipeline, asked):
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
    **dict.fromkeys(("import", "validate", "new"), _files),
    **dict.fromkeys(("log", "export"), _act),
}


def _run_all(pipeline: Pipeline, flags: Any) -> None:
    """Run the four stages in one run folder, and around again where that was asked for."""
    compilation_cache.enable(flags.cache)
    from sim2real.stages.running import run_all

    def call(stage: str, config: Any, run_dir: Path | None) -> StageFolder:
        done = _call_stage(stage, pipeline, config, flags.runs, run_dir)
        assert done is not None, "RunFlags refuses several processes"
        return done

    run_all(pipeline, flags, call)


def _call_stage(stage: str, pipeline: Pipeline, config: Any, root: Path, run_dir: Path | None) -> StageFolder | None:
    """Call a stage's entry point, print its summary and what it wrote, and return what it left."""
    from sim2real.stages import console

    if (done := importlib.import_module(f"sim2real.stages.{stage}").run(pipeline, config, root, run_dir)) is None:
        return None  # another process writes
    if done.manifest["summary"]:
        print(console.pairs(done.manifest["summary"]))
    for path in [*done.outputs.values(), done.folder / "manifest.json"]:
        console.wrote(path)
    return done


def _pipeline_first(command: str, arguments: list[str]) -> tuple[Pipeline, list[str]]:
    """Take the pipeline off the arguments; without one, ``--help`` shows the demo's."""
    from sim2real.stages.pipeline import available, load_pipeline

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
    from sim2real.artifacts.run_folder import STAGES

    return replace(flags, **{stage: replace(getattr(flags, stage), seed=seed) for stage in STAGES})


def _summary(config: Any) -> str:
    return (type(config).__doc__ or "").strip().splitlines()[0]


def _epilog(*examples: str) -> str:
    return "\n".join(["examples", *(f"  {example}" for example in examples), "", EXIT_CODES])


if __name__ == "__main__":
    sys.exit(main())
