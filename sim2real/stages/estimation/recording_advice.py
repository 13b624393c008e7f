"""The commands that identify again."""

import shlex
from collections.abc import Mapping
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.pipeline import Pipeline


def again(pipeline: Pipeline, config: IdentifyConfig, root: Path, flags: str) -> str:
    """Return the command of an identification with the same settings and further flags; "" without flags."""
    return command(pipeline, config, root, flags) if flags else ""


def onward(pipeline: Pipeline, config: IdentifyConfig, root: Path, file: Path) -> str:
    """Return the command that continues an identification that was interrupted or did not converge."""
    usual = pipeline.identify
    effort = {
        "generations": max(config.generations, usual.generations),
        "refine-steps": max(2 * config.refine_steps, usual.refine_steps),
    }
    flags = " ".join(f"--{name} {number}" for name, number in effort.items())
    return command(pipeline, config, root, f"--begin {shlex.quote(str(file))} {flags}")


def command(pipeline: Pipeline, config: IdentifyConfig, root: Path, flags: str = "") -> str:
    """Return the command of an identification.

    Args:
        pipeline: The robot; settings that equal its defaults need no flag.
        flags: Further flags; they replace those of the settings, bounds and fixed values parameter by parameter.
    """
    further = shlex.split(flags)
    if not pipeline.has_commands:
        call = "sim2real.identify(robot, recording, ...)"
        return f"{call} with the settings {flags}" if flags else call
    named = {name for flag, name in pairwise(further) if flag in ("--bounds", "--fix")}
    words = ["sim2real", "identify", *pipeline.words]
    # Add a flag for each setting that differs from the pipeline's default.
    for f in fields(config):
        flag, value = "--" + f.name.replace("_", "-"), getattr(config, f.name)
        if isinstance(value, Mapping):
            for name, numbers in value.items():
                values = numbers if isinstance(numbers, tuple) else (numbers,)
                words += [] if name in named else [flag, name, *(f"{v:g}" for v in values)]
        elif isinstance(value, tuple):
            words += [word for file in value for word in (flag, str(file))]
        elif value != getattr(pipeline.identify, f.name) and flag not in further:
            words += (
                [flag if value else flag.replace("--", "--no-", 1)] if isinstance(value, bool) else [flag, str(value)]
            )
    words += ["--runs", str(root)] if Path(root) != Path("runs") else []
    return shlex.join([*words, *further])
