"""The kinds of commands: a stage of a pipeline, a command with its own configuration, a group of those, a function.

A command is called with its name and the arguments after the name. It holds the names of its modules and imports them
when it runs, so that ``--help`` stays instant.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sim2real.errors import ERROR, UsageError
from sim2real.runtime import compilation_cache

if TYPE_CHECKING:
    from sim2real.artifacts.run.run_folder import StageFolder
    from sim2real.stages.pipeline.pipeline import Pipeline

DEMO_PIPELINE = "pendulum"
EXIT_CODES = """\
exit codes
  0  finished                    4  hardware lost: a port or a device does not answer
  1  error                       5  deadlines missed (with --strict-timing)
  2  wrong command or flag       130, 143  ended by Ctrl-C, by SIGTERM; the robot is switched off first
  3  safety stop"""


class Command(Protocol):
    """A row of the table of commands."""

    @property
    def help(self) -> str:
        """The command's line in ``sim2real --help``."""
        ...

    def __call__(self, command: str, arguments: list[str]) -> None:
        """Run the command with the arguments after its name."""
        ...


@dataclass(frozen=True)
class PipelineStage:
    """``sim2real STAGE PIPELINE [FLAGS]``: a stage that writes an artifact into a run folder.

    ``sim2real.stages.FOLDER.stage`` defines ``run(pipeline, config, runs, run_dir)``.
    """

    help: str
    config: str
    """``FOLDER.CLASS`` of the configuration, whose fields are the flags: ``record.RecordConfig``."""

    def __call__(self, command: str, arguments: list[str]) -> None:
        """Parse the flags, with the pipeline's defaults of this stage, and run the stage."""
        from sim2real.commands import flags
        from sim2real.stages.pipeline import find_run

        # The defaults are the pipeline's field with the name of the stage; without such a field, those of the class.
        pipeline, rest = split_pipeline(command, arguments)
        folder, _, name = self.config.partition(".")
        config_class = load(f"stages.{folder}.config.{name}")
        default = getattr(pipeline, command, None)
        default = default if isinstance(default, config_class) else config_class()
        # Parse the flags, then run the stage in its run folder.
        parsed = flags.parse(
            flags.StageFlags(default),
            rest,
            prog=f"sim2real {command} {pipeline.name}",
            description=summary_of(default),
            epilog=epilog(f"sim2real {command} {pipeline.name} --runs /data/runs", f"sim2real report {pipeline.name}"),
            kind=flags.StageFlags[type(default)],
        )
        compilation_cache.enable(parsed.cache)
        run_dir = find_run.find_run(parsed.runs, parsed.run, pipeline.name) if parsed.run else None
        run_stage(folder, pipeline, parsed.config, parsed.runs, run_dir)


@dataclass(frozen=True)
class ConfigCommand:
    """``sim2real COMMAND [FILES] [FLAGS]``: a module with ``run(config)``; its result False ends with code 1."""

    help: str
    module: str
    config: str
    """``MODULE.CLASS`` of the configuration, below ``sim2real``."""
    examples: tuple[str, ...]
    """Arguments after ``sim2real``."""
    note: str = ""
    """Sentence that ``--help`` adds to the summary of the configuration."""

    def __call__(self, command: str, arguments: list[str]) -> None:
        """Parse the flags and run the module."""
        from sim2real.commands import flags

        default = load(self.config)()
        description = f"{summary_of(default)} {self.note}".rstrip()
        examples = epilog(*(f"sim2real {example}" for example in self.examples))
        parsed = flags.parse(default, arguments, f"sim2real {command}", description, examples)
        compilation_cache.enable()
        if load(f"{self.module}.run")(parsed) is False:  # imports JAX
            sys.exit(ERROR)


@dataclass(frozen=True)
class CommandGroup:
    """``sim2real GROUP ACTION [FILES] [FLAGS]``: several commands behind one name."""

    help: str
    actions: Mapping[str, ConfigCommand]

    def __call__(self, command: str, arguments: list[str]) -> None:
        """Run the action that the first argument names; ``--help`` alone lists the actions."""
        action, *rest = arguments or [""]
        if action in ("-h", "--help"):
            print(f"usage: sim2real {command} ACTION\n\nActions:")
            for name, kind in self.actions.items():
                print(f"  sim2real {command} {name} {kind.help}\n      {summary_of(load(kind.config)())}")
            print(f"\nsim2real {command} ACTION --help lists its flags.")
            return
        if action not in self.actions:
            problem = f"there is no `{command} {action}`" if action else f"{command} needs an action"
            raise UsageError(
                f"{problem}. Available: {', '.join(self.actions)}",
                hint=" or ".join(f"sim2real {command} {name} {a.help}" for name, a in self.actions.items()),
            )
        self.actions[action](f"{command} {action}", rest)


@dataclass(frozen=True)
class FunctionCommand:
    """A command that parses its arguments in a function of its own."""

    help: str
    function: str
    """``MODULE.FUNCTION`` below ``sim2real``."""

    def __call__(self, command: str, arguments: list[str]) -> None:
        """Call the function with the command's name and its arguments."""
        load(self.function)(command, arguments)


def load(name: str) -> Any:
    """Import a module below ``sim2real`` and return a member of it, given as ``MODULE.MEMBER``."""
    module, _, member = name.rpartition(".")
    return getattr(importlib.import_module(f"sim2real.{module}"), member)


def run_stage(stage: str, pipeline: Pipeline, config: Any, runs: Path, run_dir: Path | None) -> StageFolder | None:
    """Run a stage, then print its summary and the names of its files.

    Returns:
        The stage's folder; None in a training of several processes, where another process writes it.
    """
    from sim2real.stages.terminal import console

    folder: StageFolder | None = load(f"stages.{stage}.stage.run")(pipeline, config, runs, run_dir)
    if folder is None:
        return None
    if folder.manifest["summary"]:
        print(console.pairs(folder.manifest["summary"]))
    for path in [*folder.outputs.values(), folder.folder / "manifest.json"]:
        console.wrote(path)
    return folder


def split_pipeline(command: str, arguments: list[str]) -> tuple[Pipeline, list[str]]:
    """Return the pipeline, which the first argument names, and the other arguments.

    ``--help`` without a pipeline shows the flags of the demo's pipeline.
    """
    from sim2real.stages.pipeline.pipeline import available, load_pipeline

    if arguments and arguments[0] in ("-h", "--help"):
        return load_pipeline(DEMO_PIPELINE), ["--help"]
    if not arguments or arguments[0].startswith("-"):
        raise UsageError(
            f"{command} needs a pipeline before its flags. Available: {', '.join(sorted(available())) or 'none'}",
            hint=f"sim2real {command} PIPELINE [FLAGS]; see `sim2real {command} --help`",
        )
    return load_pipeline(arguments[0]), arguments[1:]


def summary_of(config: object) -> str:
    """Return the first line of the docstring of a configuration's class."""
    return (type(config).__doc__ or "").strip().splitlines()[0]


def epilog(*examples: str) -> str:
    """Return the text below the flags in ``--help``: examples and exit codes."""
    return "\n".join(["examples", *(f"  {example}" for example in examples), "", EXIT_CODES])
