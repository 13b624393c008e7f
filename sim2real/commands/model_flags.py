"""Flags of the commands for a robot that no pipeline describes. Imports no JAX, so that ``--help`` stays instant."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import UseAppendAction

from sim2real.commands import flags
from sim2real.commands.flags import Folder, OptionalFolder
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.pipeline.robot_flags import MODEL_IDENTIFY, RobotFlags


@dataclass(frozen=True)
class CheckLogFlags:
    """Predict which parameters a log can determine, before a search."""

    log: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Logs to judge."""
    bounds: Annotated[dict[str, tuple[float, float]], UseAppendAction] = field(default_factory=dict)
    """Bounds of a parameter instead of the usual ones: NAME LOW HIGH, one flag a parameter."""
    fix: Annotated[dict[str, float], UseAppendAction] = field(default_factory=dict)
    """Value at which a parameter is fixed: NAME VALUE, one flag a parameter."""
    json: bool = False
    """Print JSON instead of tables."""

    def config(self) -> CheckConfig:
        """Return the stage's configuration: without a pipeline there is nothing to plan, and no folder of runs."""
        return CheckConfig(log=self.log, bounds=self.bounds, fix=self.fix, json=self.json)


@dataclass(frozen=True)
class IdentifyModelFlags:
    """Flags of ``identify --mjcf``."""

    config: Annotated[IdentifyConfig, tyro.conf.arg(name="")] = MODEL_IDENTIFY
    runs: Folder = Path("runs")
    """Folder of all runs."""
    run: OptionalFolder = None
    """Run folder to add to; default: a new one."""
    cache: Annotated[str | None, tyro.conf.arg(metavar="DIR|off")] = None
    """Folder of compiled programs, or 'off'; default: SIM2REAL_CACHE, otherwise the platform's cache folder."""
    robot: Annotated[RobotFlags, tyro.conf.arg(name="")] = field(default_factory=RobotFlags)


@dataclass(frozen=True)
class CheckModelFlags:
    """Flags of ``check --mjcf``."""

    config: Annotated[CheckLogFlags, tyro.conf.arg(name="")] = field(default_factory=CheckLogFlags)
    robot: Annotated[RobotFlags, tyro.conf.arg(name="")] = field(default_factory=RobotFlags)


def by_model(arguments: Sequence[str]) -> bool:
    """Return whether a command is for a robot that is described by its model instead of a pipeline."""
    return any(word.split("=")[0] == "--mjcf" for word in arguments) and arguments[0].startswith("-")


def parse_identify(arguments: Sequence[str], epilog: str) -> IdentifyModelFlags:
    """Return the flags of ``identify`` for a robot that is described by its model."""
    return _parse(IdentifyModelFlags(), IdentifyConfig, arguments, "identify", epilog)


def parse_check(arguments: Sequence[str], epilog: str) -> CheckModelFlags:
    """Return the flags of ``check`` for a robot that is described by its model."""
    return _parse(CheckModelFlags(), CheckLogFlags, arguments, "check", epilog)


def _parse(default: Any, about: type, arguments: Sequence[str], command: str, epilog: str) -> Any:
    prog = f"sim2real {command} --mjcf ROBOT.xml --log FILE"
    examples = f"examples\n  sim2real {command} --mjcf robot.xml --log run.csv\n\n{epilog}"
    return flags.parse(default, arguments, prog, (about.__doc__ or "").strip().splitlines()[0], examples)
