"""Command-line flags from typed configurations: a field is a flag, its docstring the help, its value the default."""

import contextlib
import difflib
import io
import math
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar, get_type_hints

import tyro

from sim2real.errors import Sim2RealError, UsageError
from sim2real.stages.deploy.config import DeployConfig
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.live.config import WINDOW
from sim2real.stages.record.config import RecordConfig
from sim2real.stages.train.config import TrainConfig

Config = TypeVar("Config")
Folder = Annotated[Path, tyro.conf.arg(metavar="DIR")]
_OF_LOGS = re.compile(r"[-.](log|hold-out)$")
OptionalFolder = Annotated[Path | None, tyro.conf.arg(metavar="DIR")]


@dataclass(frozen=True)
class StageFlags(Generic[Config]):
    """Flags of one stage."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    runs: Folder = Path("runs")
    """Folder of all runs."""
    run: OptionalFolder = None
    """Run folder to add to; default: a new one for record, for the others the newest one with their inputs."""
    cache: Annotated[str | None, tyro.conf.arg(metavar="DIR|off")] = None
    """Folder of compiled programs, or 'off'; default: SIM2REAL_CACHE, otherwise the platform's cache folder."""


@dataclass(frozen=True)
class DemoFlags:
    """Flags of the demo."""

    seed: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Seed of every stage."""
    runs: Folder = Path("runs")
    """Folder of all runs."""
    resume: OptionalFolder = None
    """Run folder to go on with: stages that are finished there, from the newest inputs, are skipped."""
    cache: Annotated[str | None, tyro.conf.arg(metavar="DIR|off")] = None
    """Folder of compiled programs, or 'off'; default: SIM2REAL_CACHE, otherwise the platform's cache folder."""
    verbose: bool = False
    """Print everything that the stages print; default: a few lines for each stage."""


@dataclass(frozen=True)
class RunFlags(DemoFlags):
    """Flags of all four stages."""

    iterations: int = 1
    """Largest number of iterations of a run; the verdict on a deployment chooses the stages that run again."""
    until: Annotated[str | None, tyro.conf.arg(metavar="QUANTITY=VALUE")] = None
    """Go around until a quantity of the gap report is at least so large on the robot, such as success=0.95; default:
    until the verdict is 'fine'."""
    record: RecordConfig = field(default_factory=RecordConfig)
    identify: IdentifyConfig = field(default_factory=IdentifyConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    deploy: DeployConfig = field(default_factory=DeployConfig)

    def __post_init__(self) -> None:
        """Check what can be checked before anything moves."""
        if self.train.hosts.several:
            raise UsageError(
                "only training is divided among processes: each of them would record and deploy",
                hint="record and identify in one, then `sim2real train PIPELINE --hosts...` in all",
            )
        if self.iterations < 1 or (self.until and self.iterations == 1):
            raise UsageError(
                f"a run goes around at least once, and more often to reach a goal; got {self.iterations}",
                hint="--iterations 5 --until success=0.95",
            )
        _ = self.goal

    @property
    def goal(self) -> tuple[str, float] | None:
        """The quantity to reach, and its least value; None: no goal."""
        if self.until is None:
            return None
        name, _, value = self.until.partition("=")
        try:
            least = float(value)
        except ValueError:
            least = math.nan
        if not name or not math.isfinite(least):
            raise UsageError(f"until must be QUANTITY=VALUE, got {self.until!r}", hint="--until success=0.95")
        return name, least


@dataclass(frozen=True)
class TargetFlags:
    """Flags of the commands that look at a run."""

    runs: Folder = Path("runs")
    """Folder of all runs."""


@dataclass(frozen=True)
class InfoFlags(TargetFlags):
    """Flags of info."""

    verbose: bool = False
    """Print the default of every flag of a pipeline's stages."""


@dataclass(frozen=True)
class ViewFlags(TargetFlags):
    """Flags of view."""

    save: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd")] = None
    """Write a recording for the Rerun viewer instead of opening the viewer."""
    web: bool = False
    """Serve a page for browsers, until Ctrl-C, instead of opening the viewer."""
    follow: bool = False
    """Join a run whose stages are still running, and show their new rows, until Ctrl-C."""


def parse(
    default: Config, arguments: Sequence[str], prog: str, description: str, epilog: str = "", kind: Any = None
) -> Config:
    """Return a configuration with the fields that the arguments name replaced.

    Args:
        default: A dataclass; its values are the defaults.
        kind: Type to parse into where it is more than the default's class (a generic class with its argument).

    Raises:
        UsageError: When a flag is unknown or a value does not fit.
        SystemExit: With code 0 after ``--help``.
    """
    # Hide tyro's own messages: an error here has a hint.
    talk = io.StringIO()
    try:
        with _plain_if_requested(), contextlib.redirect_stderr(talk):
            parsed, unknown = tyro.cli(
                kind or type(default),
                default=_without_tables(default),
                args=_completed(arguments, default),
                prog=prog,
                description=description,
                return_unknown_args=True,
            )
    except SystemExit as end:
        if not end.code:
            print(f"\n{epilog}" if epilog else "", flush=True)
            raise
        raise _usage_error(end, talk.getvalue(), prog, default, arguments) from None
    if unknown:
        raise _unknown(unknown, default, prog)
    return _with_tables(parsed, default)


def _without_tables(config: Any) -> Any:
    """Return a configuration with empty tables, such as ranges: the parser adds no names to tables with entries."""
    changed = {}
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            changed[item.name] = _without_tables(value)
        elif isinstance(value, dict):
            changed[item.name] = {}
    return replace(config, **changed) if changed else config


def _with_tables(parsed: Any, default: Any) -> Any:
    """Return the parsed configuration with the default's tables, in which the parsed names replace or add entries."""
    changed = {}
    for item in fields(parsed):
        value, before = getattr(parsed, item.name), getattr(default, item.name)
        if is_dataclass(value) and type(value) is type(before):
            changed[item.name] = _with_tables(value, before)
        elif isinstance(value, dict) and isinstance(before, dict):
            changed[item.name] = {**before, **value}
    return replace(parsed, **changed) if changed else parsed


def _completed(arguments: Sequence[str], default: Any) -> list[str]:
    """Return the arguments with a window for each ``--view`` that has no value, and a flag for each of several logs."""
    logs = {name for name, value in flags_of(default) if _OF_LOGS.search(name) and isinstance(value, tuple)}
    words, flag = list[str](), ""
    for word, following in zip(arguments, [*arguments[1:], "-"], strict=False):
        # A shell makes several files of `--log *.csv`: those of one kind follow the flag.
        last = Path(words[-1]) if flag and words[-1] != flag else None
        if last and not word.startswith("-") and _is_log(Path(word), last):
            words.append(flag)
        elif last or word.startswith("-"):
            flag = word if word.replace("_", "-") in logs else ""
        words.append(word)
        if re.fullmatch(r"--(\w+\.)?view", word) and following.startswith("-"):
            words.append(WINDOW)
    return words


def _is_log(path: Path, last: Path) -> bool:
    """Return whether an argument after a log is one, too, and not an identification."""
    return path.suffix == last.suffix and path.name != "parameters.json" and not path.is_dir()


def flags_of(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the flags of a configuration and their values, nested ones with their prefix."""
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            # The flags of StageFlags.config and of a robot have no prefix.
            yield from flags_of(value, prefix if item.name in ("config", "robot") else f"{prefix}{item.name}.")
        else:
            yield f"--{prefix}{item.name}".replace("_", "-"), value


_MAX_LISTED_FLAGS = 20
"""A refusal lists at most this many flags; ``run`` has 120."""


def _unknown(unknown: Sequence[str], default: Any, prog: str) -> UsageError:
    """Return the error for arguments that no flag took."""
    names, alone = _names(default)
    flags = [word.split("=")[0] for word in unknown if word.startswith("-")]
    if not flags:
        return UsageError(f"unexpected argument {unknown[0]!r}", hint=f"see `{prog} --help`")
    first = flags[0].replace("_", "-")
    close = difflib.get_close_matches(first, names, n=1)
    available = f". Available: {', '.join(names)}" if len(names) <= _MAX_LISTED_FLAGS else ""
    guess = f"did you mean {close[0]}? " if close else ""
    guess = f"write its value without {first}. " if first in alone else guess
    return UsageError(f"unknown flag {', '.join(flags)}{available}", hint=f"{guess}`{prog} --help` lists all flags")


def _names(default: Any) -> tuple[list[str], list[str]]:
    """Return the names of all flags, and of the arguments whose value stands without a flag."""
    hints = get_type_hints(type(default), include_extras=True)
    marks = {f"--{name}".replace("_", "-"): getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    alone = [name for name, _ in flags_of(default) if tyro.conf.Positional in marks.get(name, ())]
    return [name for name, _ in flags_of(default) if name not in alone], alone


def _usage_error(end: BaseException, talk: str, prog: str, default: Any, arguments: Sequence[str]) -> Sim2RealError:
    """Return why the parser gave up: the configuration's own error, or the text that the parser printed in a box."""
    cause: BaseException | None = end
    while cause is not None:
        if isinstance(cause, Sim2RealError):
            return cause
        cause = cause.__context__
    # The reason stands between the first two rules of the box, which has other characters where the output is ASCII.
    lines = [line.strip("│| ") for line in talk.splitlines()]
    rules = [i for i, line in enumerate(lines) if re.match("╭|╰|[─-]{4}", line)]
    body = " ".join(lines[rules[0] + 1 : rules[1]]) if len(rules) > 1 else talk.strip()
    # With an unknown flag, the parser calls a missing value that stands without a flag a list.
    taken = [*(names := _names(default)[0]), *(f"--no-{name[2:]}" for name in names)]
    flags = [word for word in arguments if word.startswith("--") and word.split("=")[0].replace("_", "-") not in taken]
    if flags and body.endswith("not list"):
        return _unknown(flags, default, prog)
    return UsageError(body, hint=f"see `{prog} --help`")


@contextlib.contextmanager
def _plain_if_requested() -> Iterator[None]:
    """Print the help without colour where NO_COLOR is set, which the parser itself ignores."""
    options = tyro._experimental_options
    before = options["ansi_codes"]
    options["ansi_codes"] = before and not os.environ.get("NO_COLOR") and sys.stdout.isatty()
    try:
        yield
    finally:
        options["ansi_codes"] = before
