"""Makes command-line flags from configurations: a field is a flag, its docstring the help, its value the default."""

import argparse
import ast
import difflib
import inspect
import shutil
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

from sim2real.errors import EXIT_CODES, UsageError
from sim2real.stages.flag import Flag

Config = TypeVar("Config")
_SHOWN: Mapping[str, str] = {
    "StageFlags": "config runs run",
    "DemoFlags": "seed runs resume",
    "PlayConfig": "source command duration_s seed view runs",
    "RunFlags.record": "port duration_s excitation amplitude dry_run",
    "RunFlags.identify": "log terms max_delay_s",
    "RunFlags.train": "ppo",
    "RunFlags.deploy": "port episodes duration_s dry_run",
    "RunFlags": "seed runs resume iterations record identify train deploy",
    "RecordConfig": "port duration_s excitation amplitude seed dry_run view",
    "IdentifyConfig": "log hold_out terms bounds fix max_delay_s seed",
    "TrainConfig": "model resume seed ppo",
    "PPOConfig": "total_steps",
    "DeployConfig": "port bundle episodes duration_s command dry_run force seed view",
    "NewConfig": "name robot log drive like port",
    "RobotFlags": "mjcf joints mapping unit rate_hz",
    "DoctorConfig": "policy log mjcf contract sim out bundle json",
    "CheckConfig": "log plan bounds fix json runs",
    "ValidateConfig": "parameters log json",
    "ImportConfig": "files mapping pipeline mjcf joints unit calibration rate_hz out",
    "ReportConfig": "targets rerun out json runs",
}
"""Configuration, or the field that holds it -> the fields that ``--help`` shows; ``--help-all`` shows all."""
_WIDTH, _COLUMN = 110, 28
"""Largest width of the help, and the column where its texts begin."""
_MAX_LISTED_FLAGS = 20
"""Most flags that an error lists."""


@dataclass(frozen=True)
class _Option:
    """A flag, or a value without a flag.

    Attributes:
        name: ``--record.duration-s``.
        path: Names of the nested fields: ``("record", "duration_s")``.
    """

    name: str
    path: tuple[str, ...]
    kind: Any
    default: Any
    text: str
    mark: Flag
    shown: bool

    @property
    def off(self) -> str:
        """The flag that switches the option off: ``--record.no-dry-run``."""
        prefix, dot, last = self.name[2:].rpartition(".")
        return f"--{prefix}{dot}no-{last}"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(message.removeprefix("argument "), hint=f"see `{self.prog} --help`")


def parse(default: Config, arguments: Sequence[str], prog: str, *examples: str, text: str = "") -> Config:
    """Return a configuration with the fields that the arguments name replaced.

    Args:
        default: A dataclass; its values are the defaults.
        examples: Example commands without ``sim2real``, for the end of the help.
        text: Description of the command; default: the first line of the configuration's docstring.

    Raises:
        UsageError: A flag is unknown, a value does not fit, or one is missing.
        SystemExit: With code 0 after ``--help``.
    """
    options = list(_options(default))
    if {"-h", "--help", "--help-all"} & set(arguments):
        text = text or (type(default).__doc__ or "").strip().splitlines()[0]
        print(_help(options, prog, text, examples, "--help-all" in arguments), flush=True)
        raise SystemExit(0)
    # Let argparse assign the words to the flags.
    parser = _Parser(prog=prog, add_help=False, allow_abbrev=False, argument_default=argparse.SUPPRESS)
    for option in options:
        _add(parser, option)
    given, unknown = parser.parse_known_intermixed_args([_with_hyphens(word) for word in arguments])
    if unknown:
        raise _unknown(unknown, options, prog)
    # Convert the words, and put the values into the configuration.
    values: dict[tuple[str, ...], Any] = {}
    for option in options:
        words = vars(given).get(".".join(option.path))
        if isinstance(words, bool):
            values[option.path] = words
        elif words:
            values[option.path] = _value(option, words, prog)
    config = _replaced(default, values, ())
    if missing := next((o for o in options if o.mark.needed and o.path not in values), None):
        flag = "" if missing.mark.positional else f"{missing.name} "
        what = f"{flag}{_placeholder(missing)}"
        raise UsageError(f"{prog.removeprefix('sim2real ')} needs {what}", hint=f"sim2real {examples[0]}")
    return config


def _options(
    config: Any, prefix: str = "", path: tuple[str, ...] = (), shown: bool = True, place: str = ""
) -> Iterator[_Option]:
    """Yield the flags of a configuration, nested ones with their prefix.

    Args:
        place: Class and field that hold the configuration: ``RunFlags.record``.
    """
    kind = type(config)
    hints, texts = get_type_hints(kind, include_extras=True), _docstrings(kind)
    listed = next((_SHOWN[n] for n in (place, *(c.__name__ for c in kind.__mro__)) if n in _SHOWN), None)
    for item in fields(config):
        marks = [m for m in getattr(hints[item.name], "__metadata__", ()) if isinstance(m, Flag)]
        mark, value = next(iter(marks), Flag()), getattr(config, item.name)
        visible = shown and (listed is None or item.name in listed.split())
        name = f"{prefix}{item.name.replace('_', '-')}"
        if is_dataclass(value):
            inner = prefix if mark.flat else f"{name}."
            yield from _options(value, inner, (*path, item.name), visible, f"{kind.__name__}.{item.name}")
        else:
            text = texts.get(item.name, "")
            yield _Option(f"--{name}", (*path, item.name), hints[item.name], value, text, mark, visible)


@cache
def _docstrings(kind: type) -> dict[str, str]:
    """Return field -> the docstring below it in the source of its class."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        if not is_dataclass(base):
            continue
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for before, after in pairwise(body):
            if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name):
                text = after.value if isinstance(after, ast.Expr) else None
                if isinstance(text, ast.Constant):
                    texts[before.target.id] = " ".join(str(text.value).split())
    return texts


def _add(parser: argparse.ArgumentParser, option: _Option) -> None:
    names, dest = [option.name, *filter(None, [option.mark.also])], ".".join(option.path)
    kind = _bare(option.kind)
    if option.mark.positional:
        parser.add_argument(dest, nargs="*" if get_origin(kind) is tuple else "?", default=[])
    elif kind is bool:
        parser.add_argument(*names, dest=dest, action="store_const", const=True)
        parser.add_argument(option.off, dest=dest, action="store_const", const=False)
    elif get_origin(kind) is dict:
        _, value = get_args(kind)
        parser.add_argument(*names, dest=dest, action="append", nargs=1 + max(1, len(get_args(value))))
    elif get_origin(kind) is tuple and get_args(kind)[-1] is not Ellipsis:
        parser.add_argument(*names, dest=dest, nargs=len(get_args(kind)))
    elif get_origin(kind) is tuple:
        parser.add_argument(*names, dest=dest, nargs="+", action="extend")
    elif option.mark.alone is not None:
        parser.add_argument(*names, dest=dest, nargs="?", const=option.mark.alone)
    else:
        parser.add_argument(*names, dest=dest)


def _value(option: _Option, words: Any, prog: str) -> Any:
    """Return the value that the words of a flag stand for."""
    kind = _bare(option.kind)
    try:
        if get_origin(kind) is dict:
            _, value = get_args(kind)
            entries = {name: _converted(value, rest if get_args(value) else rest[0]) for name, *rest in words}
            return {**option.default, **entries}
        return _converted(option.kind, words)
    except ValueError as error:
        written = " ".join(words) if isinstance(words, list) else words
        raise UsageError(
            f"{option.name} needs {_placeholder(option)}, got {written}", hint=f"see `{prog} --help`"
        ) from error


def _converted(kind: Any, words: Any) -> Any:
    optional, kind = types.NoneType in get_args(_unmarked(kind)), _bare(kind)
    if optional and words == "None":
        return None
    if get_origin(kind) is Literal:
        return next(value for value in get_args(kind) if str(value) == words) if words in _choices(kind) else _refuse()
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        kinds = [inner[0]] * len(words) if inner[-1] is Ellipsis else inner
        return tuple(_converted(k, word) for k, word in zip(kinds, words, strict=True))
    return kind(words)


def _refuse() -> NoReturn:
    raise ValueError


def _replaced(config: Any, values: Mapping[tuple[str, ...], Any], path: tuple[str, ...]) -> Any:
    """Return the configuration with new values of the fields at or below a path; this runs its checks."""
    changed = {}
    for item in fields(config):
        here = (*path, item.name)
        if here in values:
            changed[item.name] = values[here]
        elif is_dataclass(inner := getattr(config, item.name)) and any(p[: len(here)] == here for p in values):
            changed[item.name] = _replaced(inner, values, here)
    return replace(config, **changed) if changed else config


def _unknown(unknown: Sequence[str], options: Sequence[_Option], prog: str) -> UsageError:
    """Return the error for words that belong to no flag."""
    written = [word.split("=")[0] for word in unknown if word.startswith("-")]
    if not written:
        return UsageError(f"unexpected argument {unknown[0]!r}", hint=f"see `{prog} --help`")
    names = [option.name for option in options if not option.mark.positional]
    available = f". Available: {', '.join(names)}" if len(names) <= _MAX_LISTED_FLAGS else ""
    close = difflib.get_close_matches(written[0].lstrip("-"), [name[2:] for name in names], n=1)
    guess = f"did you mean --{close[0]}? " if close else ""
    if written[0] in [option.name for option in options if option.mark.positional]:
        guess = f"write its value without {written[0]}. "
    hint = f"{guess}`{prog} --help-all` lists all flags"
    return UsageError(f"unknown flag {', '.join(written)}{available}", hint=hint)


def _help(options: Sequence[_Option], prog: str, text: str, examples: Sequence[str], everything: bool) -> str:
    """Return the help: one block of flags for each nested configuration."""
    values = [o for o in options if o.mark.positional]
    listed = [o for o in options if o not in values and (o.shown or everything)]
    # Flags without a block come first: otherwise they would seem to belong to the block above.
    listed.sort(key=lambda o: "." in o.name)
    usage = " ".join([prog, *(_placeholder(o) for o in values), "[FLAGS]"])
    lines = [f"usage: {usage}", "", *textwrap.wrap(text, _width()), ""]
    for value in values:
        lines += _entry(_placeholder(value), value.text)
    block = ""
    for option in listed:
        prefix = option.name[2:].partition(".")[0] if "." in option.name else ""
        if prefix != block:
            lines, block = [*lines, "", prefix], prefix
        default = _text(option.default)
        about = f"{option.text} [{default}]" if default else option.text
        lines += _entry(f"{option.name} {_placeholder(option)}".rstrip(), about)
    if hidden := len(options) - len(values) - len(listed):
        lines += ["", f"--help-all lists {hidden} more flag{'s' * (hidden != 1)}."]
    return "\n".join([*lines, "", "examples", *(f"  sim2real {example}" for example in examples), "", EXIT_CODES])


def _entry(head: str, text: str) -> list[str]:
    """Return a flag and its text as lines."""
    body = textwrap.wrap(text, _width() - _COLUMN) or [""]
    head = f"  {head}"
    if len(head) > _COLUMN - 2:
        return [head, *(" " * _COLUMN + line for line in body)]
    return [head.ljust(_COLUMN) + body[0], *(" " * _COLUMN + line for line in body[1:])]


def _width() -> int:
    return min(_WIDTH, shutil.get_terminal_size((_WIDTH, 24)).columns)


def _placeholder(option: _Option) -> str:
    return option.mark.metavar or _placeholder_of(_bare(option.kind))


def _placeholder_of(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "|".join(_choices(kind))
    if get_origin(kind) is dict:
        (_, value) = get_args(kind)
        return "NAME LOW HIGH" if get_args(value) else "NAME VALUE"
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        return f"{_placeholder_of(inner[0])} ..." if inner[-1] is Ellipsis else " ".join(map(_placeholder_of, inner))
    return {bool: "", int: "INT", float: "NUMBER", Path: "PATH"}.get(kind, "TEXT")


def _text(value: Any) -> str:
    """Return a default as text; "" for a default that needs no mention."""
    if value is None or value is False or value in ("", (), {}):
        return ""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(v)}" for name, v in value.items())
    if isinstance(value, tuple):
        return " ".join(map(_text, value))
    return "yes" if value is True else f"{value:g}" if isinstance(value, float) else str(value)


def _unmarked(kind: Any) -> Any:
    """Return a type without its annotations."""
    return get_args(kind)[0] if hasattr(kind, "__metadata__") else kind


def _bare(kind: Any) -> Any:
    """Return a type without annotations and without None."""
    kind = _unmarked(kind)
    if get_origin(kind) in (Union, types.UnionType):
        return next(inner for inner in get_args(kind) if inner is not types.NoneType)
    return kind


def _choices(kind: Any) -> list[str]:
    return [str(value) for value in get_args(kind)]


def _with_hyphens(word: str) -> str:
    """Return a flag with hyphens for underscores; its value is unchanged."""
    name, equals, value = word.partition("=")
    return f"{name.replace('_', '-')}{equals}{value}" if name.startswith("--") else word
