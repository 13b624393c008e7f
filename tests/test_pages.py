"""Files, modules and links that the pages name exist; tables that people extend stay well formed."""

import ast
import contextlib
import functools
import importlib
import io
import itertools
import re
import shlex
from pathlib import Path

import pytest

from sim2real import cli
from sim2real.commands.table import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
GROUPS = {"sim2real.pipelines", "sim2real.devices", "sim2real.worlds"}
"""Groups of entry points, which are named like modules."""
EXAMPLE_STAGE = "sim2real.stages.count."
"""The stage that CONTRIBUTING.md writes; tests/stages/test_new_stage.py runs it."""
PACKAGES = (
    "errors|graph|runtime|policy|composer|worlds|hardware|log|artifacts|identify|train|robots|view|stages|interop|"
    "commands"
)
"""Packages whose constants choices.md may name."""


def without_code(text: str) -> str:
    """Return a page without its blocks of code."""
    return re.sub(r"^(`{3,}).*?^\1$", "", text, flags=re.DOTALL | re.MULTILINE)


def rows(text: str, header: str) -> list[list[str]]:
    """Return the cells of the rows of the table with a header, in their order."""
    lines = text.splitlines()
    start = lines.index(header) + 2
    end = next((i for i, line in enumerate(lines[start:], start) if not line.startswith("|")), len(lines))
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[start:end]]


def resolve(name: str) -> object:
    """Return the module, class or function of a dotted name; old names of modules do not count."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        path = ROOT.joinpath(*parts[:length])
        if path.with_suffix(".py").is_file() or (path / "__init__.py").is_file():
            value = importlib.import_module(".".join(parts[:length]))
            for part in parts[length:]:
                value = getattr(value, part)
            return value
    raise ModuleNotFoundError(name)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as MyST and GitHub make them."""
    headings = re.findall(r"^#+ (.+)$", without_code(page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(page: Path, text: str) -> list[str]:
    """Return the targets of a page's links to files or headings that do not exist."""
    wrong = []
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(text)):
        name, _, anchor = target.partition("#")
        path = page.parent / name if name else page
        if not target.startswith("https://") and (
            not path.exists() or (anchor and path.suffix == ".md" and anchor not in anchors(path))
        ):
            wrong.append(target)
    return wrong


def test_links_lead_to_files_and_headings():
    assert {p.name: wrong for p in PAGES if (wrong := broken_links(p, p.read_text()))} == {}


def test_broken_links_are_seen():
    page = ROOT / "docs" / "index.md"
    text = "[a](timing.md) [b](none.md) [c](graph.md#no-such-heading) [d](https://example.com) [e](#sim2real)"
    assert broken_links(page, text) == ["none.md", "graph.md#no-such-heading"]


def test_modules_named_on_pages_exist():
    names = {m[0]: p.name for p in PAGES for m in re.finditer(r"\bsim2real(?:\.[A-Za-z_]\w*)+", p.read_text())}
    wrong = {}
    for name in sorted(name for name in names.keys() - GROUPS if not name.startswith(EXAMPLE_STAGE)):
        try:
            resolve(name)
        except (ModuleNotFoundError, AttributeError):
            wrong[name] = names[name]
    assert len(names) > 30
    assert wrong == {}


@pytest.mark.parametrize("name", ["sim2real.hardware.gate", "sim2real.graph.rules.no_such_rule", "sim2real.nothing"])
def test_old_and_wrong_names_of_modules_are_seen(name):
    with pytest.raises((ModuleNotFoundError, AttributeError)):
        resolve(name)


def test_paths_of_source_files_on_pages_exist():
    pattern = r"`((?:sim2real|pipelines|scripts|tests|datasets|reports)/[\w/.*-]+\.\w+)`"
    paths = {(page.name, m[1]) for page in PAGES for m in re.finditer(pattern, without_code(page.read_text()))}
    paths = {(page, path) for page, path in paths if not page.startswith("tutorial")}  # they name the reader's files
    assert len(paths) > 40
    assert [found for found in paths if not list(ROOT.glob(found[1]))] == []


def test_the_map_of_behaviours_names_files_that_exist():
    table = rows((ROOT / "CONTRIBUTING.md").read_text(), "| To change | open |")
    assert len(table) >= 30
    assert len({behaviour for behaviour, _ in table}) == len(table)
    assert [file for _, file in table if not (ROOT / file.strip("`")).is_file()] == []


def test_every_noun_stands_in_the_glossary_once():
    text = (ROOT / "docs" / "reference" / "glossary.md").read_text()
    nouns = re.findall(r"^\| ([a-z][\w -]+) \| \S", text, re.MULTILINE)
    nouns = [noun for noun in nouns if noun != "noun"]
    assert len(nouns) == len(set(nouns)) == 65
    assert {"log", "estimate", "held-out part", "false-alarm rate", "stale command", "bundle"} <= set(nouns)


def malformed(table: list[list[str]]) -> list[str]:
    """Return the rows of choices.md that lack a cell, or whose constant stands without its module."""
    module = re.compile(rf"`(?:sim2real[./])?(?:{PACKAGES}|pipelines)[./]")
    return [" | ".join(row) for row in table if len(row) != 4 or not all(row) or not module.search(row[0])]


def test_rows_of_choices_are_complete():
    text = (ROOT / "docs" / "reference" / "choices.md").read_text()
    lines = rows(text, "| constant | value | what was measured | commit or report |")
    assert malformed(lines) == []
    constants = [re.findall(r"^\| (.*?) \|", line)[0] for line in text.splitlines() if line.startswith("| `")]
    assert constants == sorted(set(constants)), "one row for each constant, in order"


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("| `sim2real.graph.node.B` | 2 s | x |", 1),
        ("| `A` | 2 s | x | y |", 1),
        ("| `sim2real.graph.node.B` | 2 s | | y |", 1),
        ("| `sim2real.graph.node.B` | 2 s | a \\| b | y |", 0),
        ("| `stages/check/stage.py`: `_LIMIT` | 2 s | x | y |", 0),
    ],
)
def test_wrong_rows_of_choices_are_seen(line, wrong):
    assert len(malformed(rows(f"| a |\n|---|\n{line}", "| a |"))) == wrong


PRINTED = {
    "guides/any_robot.md": ["proposed mapping for ", "is measured and ", " commanded, by their names"],
    "guides/check.md": [
        "accept what is determined",
        "nothing in this data determines ",
        "record instead:",
        "round_trip_delay",
    ],
    "guides/deploy.md": [
        "the policy was trained with ",
        "sim2real latency; to deploy all the same: --force",
        "look at this joint",
    ],
    "guides/identify.md": [
        "accepted",
        "no improvement on held-out data",
        "hit a bound",
        "not identifiable",
        "lacks a term",
        "promise broken",
        "not converged",
        "interrupted",
        "negligible",
        "not reached",
        "disagree",
        "residuals of the fit",
        "nothing in this data determines ",
        "no delay",
        "hold",
        "engine:",
        "next:",
    ],
    "guides/latency.md": [
        ", from the sample to its message",
        " on the bus, question and answer",
        " wakes and computes",
        ", from the motion",
        "sum of the medians, without parts in ()",
    ],
    "guides/safety.md": ["the control process is gone"],
    "reference/runs.md": ["died", "dry run"],
}
"""Texts of the console that pages quote: each is part of a string in the code."""


def strings() -> str:
    """Return all strings of the package's code, one after the other; docstrings count too."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in (ROOT / "sim2real").rglob("*.py"))
    values = (n.value for tree in trees for n in ast.walk(tree) if isinstance(n, ast.Constant))
    return "\n".join(value for value in values if isinstance(value, str))


def test_quoted_texts_of_the_console_are_those_of_the_code():
    printed = strings()
    pages = {page: " ".join((ROOT / "docs" / page).read_text().split()) for page in PRINTED}
    assert [(page, text) for page, texts in PRINTED.items() for text in texts if text.strip() not in pages[page]] == []
    assert [(page, text) for page, texts in PRINTED.items() for text in texts if text not in printed] == []


PIPELINES = {"pendulum", "arm", "so101", "disk", "xl330"}
COMMAND = re.compile(r"^(?: *\w*\$ |    )(?:\w+=\S+ )?(sim2real [a-z].*)$", re.MULTILINE)


@functools.cache
def help_of(command: str, *arguments: str) -> str:
    """Return the help of a command with these arguments before ``--help``."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert cli.main([command, *arguments, "--help"]) == 0
    return out.getvalue()


def unknown_flags(line: str) -> list[str]:
    """Return the flags in a command line that the help of its command does not list."""
    words = shlex.split(line.split("&&")[0], comments=True)
    flags = [word for word in words if word.startswith("--")]
    names = [*itertools.takewhile(lambda word: not word.startswith("-"), words[1:])]
    kinds = [name for name in names[1:2] if name in PIPELINES | {"identified", "policy"}]
    text = help_of(names[0], *kinds, *(["--mjcf", "robot.xml"] if "--mjcf" in flags else []))
    return [flag for flag in flags if flag not in ("--help", "--mjcf") and not re.search(rf"{flag}(?![\w-])", text)]


def test_commands_on_pages_have_flags_that_exist():
    lines = {line: page.name for page in PAGES for line in COMMAND.findall(page.read_text().replace("\\\n", " "))}
    commands = {line: page for line, page in lines.items() if line.split()[1] in COMMANDS}
    assert len(commands) > 70
    assert {(page, line): wrong for line, page in commands.items() if (wrong := unknown_flags(line))} == {}


def test_a_flag_that_does_not_exist_is_seen():
    assert unknown_flags("sim2real train pendulum --seed 1 --sead 2  # --none") == ["--sead"]
