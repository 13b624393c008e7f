"""Commands and flags that messages name: the parser of the command takes each."""

import ast
import importlib
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

import sim2real
from sim2real import cli
from sim2real.commands import flags
from sim2real.errors import Sim2RealError
from sim2real.stages.load import available

ROOT = Path(sim2real.__file__).parents[1]
COMMAND = re.compile(rf"(?P<quote>`?)sim2real (?P<name>{'|'.join(cli.COMMANDS)})\b(?P<rest>[^`;\n]*)")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*(?:\.[a-z-]*[a-z])*(?![\w-])")
OTHERS = re.compile(r"(mcap cat|rosbags-convert) [^`]*|--plant(-args)?|var\(--[^)]*\)")
"""Commands of other programs, flags of the emulation's process, and colours of a page."""
TAKE_A_PIPELINE = ("record", "identify", "train", "deploy", "run", "check")


@cache
def options_of(command):
    """Return the flags of a command, of all pipelines: name -> option."""
    found = {}

    def note(default, *_, **__):
        for option in flags._options(default):
            found[option.name] = option
        raise SystemExit

    module, _, name = cli.COMMANDS[command][1].partition(".")
    function = getattr(importlib.import_module(f"sim2real.commands.{module}"), name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flags, "parse", note)
        for pipeline in sorted(available()):
            try:
                function(command, [pipeline])
            except (SystemExit, Sim2RealError):
                continue
    return found


@cache
def names_of(command):
    options = options_of(command).values()
    names = {name for o in options for name in (o.name, o.off, o.mark.also)}
    return names | {"--help", "--help-all"}


def texts(path):
    """Yield line and text of each string that is no docstring; ``X`` is in the place of a value."""
    tree, parts = ast.parse(path.read_text(encoding="utf-8")), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts |= {id(value) for value in node.values}
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            parts.add(id(node.value))
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield node.lineno, "".join(v.value if isinstance(v, ast.Constant) else "X" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.lineno, node.value


@cache
def messages():
    """Return place and text of each string in the package and the pipelines that names a command or a flag."""
    paths = [*(ROOT / "sim2real").rglob("*.py"), *(ROOT / "pipelines").rglob("*.py")]
    every = ((f"{p.relative_to(ROOT)}:{line}", OTHERS.sub("", text)) for p in sorted(paths) for line, text in texts(p))
    return [(place, text) for place, text in every if COMMAND.search(text) or FLAG.search(text)]


def test_a_flag_in_a_message_is_one_of_its_command():
    every, wrong, count = frozenset().union(*map(names_of, cli.COMMANDS)), [], 0
    for place, text in messages():
        commands = list(COMMAND.finditer(text))
        named = [(m["name"], flag) for m in commands for flag in FLAG.findall(m["rest"])]
        if not commands and " " in text.strip():  # a single word may be an argument of another program
            named = [("", flag) for flag in FLAG.findall(text)]
        count += len(named)
        wrong += [f"{place}: {c} {flag}" for c, flag in named if flag not in (names_of(c) if c else every)]
    assert not wrong, "\n".join(wrong)
    assert count > 100


def test_a_command_in_a_message_parses():
    """Those between backticks, and those that are a whole hint; a value of the message stands as ``X``."""
    wrong, count = [], 0
    for place, text in messages():
        for match in COMMAND.finditer(text):
            if not match["quote"] and match[0] != text:
                continue
            parser, options = flags._Parser(prog="", add_help=False, allow_abbrev=False), options_of(match["name"])
            for option in options.values():
                flags._add(parser, option)
            words = shlex.split(match["rest"].partition(", ")[0])
            words = words[1:] if match["name"] in TAKE_A_PIPELINE else words
            words = [word for word in words if word not in ("--help", "--help-all")]
            count += 1
            try:
                unknown = parser.parse_known_intermixed_args(words)[1]
            except Sim2RealError as error:
                unknown = error.args[0]
            wrong += [f"{place}: {match[0]}: {unknown}"] if unknown else []
    assert not wrong, "\n".join(wrong)
    assert count > 30
