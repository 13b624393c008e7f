"""Size and wording of the code: ``python scripts/house.py`` prints a table, ``--words`` lists the words to replace.

tests/test_house_figures.py keeps each figure at or below its limit there.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DIALECT = (
    "told", "tell", "tells", "nobody", "anew", "may as well", "whoever", "is said", "left out", "left_out", "once more",
    "once_more", "by itself",
)  # fmt: skip
"""Words of speech for data flow, and adverbs in the place of logic."""
OTHER_DIALECT = (
    # Verbs of speech and knowledge for data flow.
    "said", "says", "(?:is|are|was|were) (?:not )?(?:asked|known|seen)",
    # Pronouns and relative clauses in the place of a noun.
    "whatever", "everybody", "nothing (?:is|was|has|can|may|else)", "all that", "that is none", "what (?:it|they)",
    "what (?:is|was|are|were)(?! the)", "where (?:it|they) stands?", "so many", "so much", "the surest", "one's own",
    # Adverbs and connectives in the place of logic.
    "(?:than|of) which", "but for", "for ever", "as it were", "of itself", "of themselves", "by themselves",
    "thereof", "thereby", "comes? out at", "not so", "in words",
)  # fmt: skip
"""Patterns of the same kind, which have a figure of their own."""
_SPACE = r"(?:[ ]|\n[ #]*)"


def pattern(words: Iterable[str], more: str = "") -> re.Pattern[str]:
    """Return a pattern that finds words and phrases, also across the end of a line, but not in names of flags."""
    choices = "|".join(word.replace(" ", _SPACE) for word in words)
    return re.compile(rf"(?<!-)\b({choices})\b{more}", re.IGNORECASE | re.MULTILINE)


WORDS = pattern(DIALECT)
OTHER_WORDS = pattern(OTHER_DIALECT, more=r"|(?:(?<=[.:] )|^)Of (?:what|those|all)\b")
NAMES = {"found", "own", "kept", "made", "given", "asked", "prepared", "odd", "seen", "known"}
"""Participles and adjectives that name no thing where they are the whole name in code."""
PARTS_OF_NAMES = {"told", "said", "asked", "anew", "again", "prepared", "odd", "nobody", "whoever", "left out"}
"""The same as one part of a longer name in code."""


@dataclass(frozen=True)
class Module:
    """One file of Python.

    Attributes:
        path: Where it is, below the repository.
        text: What it holds.
    """

    path: str
    text: str

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All nodes of its syntax tree."""
        return list(ast.walk(ast.parse(self.text)))

    @cached_property
    def lines(self) -> Counter[str]:
        """Number of lines of each kind: code, docstring, comment, blank; a comment stands on a line of its own."""
        lines = self.text.splitlines()
        kinds = ["code" if line.strip() else "blank" for line in lines]
        for node in self.nodes:
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                kinds[node.lineno - 1 : node.end_lineno] = ["docstring"] * len(kinds[node.lineno - 1 : node.end_lineno])
        for token in tokens(self.text):
            if token.type == tokenize.COMMENT and lines[token.start[0] - 1].strip().startswith("#"):
                kinds[token.start[0] - 1] = "comment"
        return Counter(kinds)

    @cached_property
    def anys(self) -> int:
        """How often the name ``Any`` stands in it, imports apart."""
        names = [node for node in self.nodes if isinstance(node, ast.Name) and node.id == "Any"]
        return len(names)

    @cached_property
    def project_imports(self) -> int:
        """Number of modules of this project that it imports."""
        return len({name for name in imported(self.nodes) if name.startswith("sim2real")})


@cache
def tokens(text: str) -> list[tokenize.TokenInfo]:
    """Return the names and the comments in a file of Python."""
    wanted = (tokenize.NAME, tokenize.COMMENT)
    return [token for token in tokenize.generate_tokens(io.StringIO(text).readline) if token.type in wanted]


def imported(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the names of modules that the nodes of a syntax tree import, as they are written."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
            files = [ROOT / (name.replace(".", "/") + ".py") for name in modules]
            yield from (name if file.is_file() else node.module for name, file in zip(modules, files, strict=True))


def tracked(*patterns: str) -> list[str]:
    """Return the paths of files that git tracks or would track."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    return [path for path in listed if path and (ROOT / path).is_file()]


def modules() -> list[Module]:
    """Return the modules of sim2real."""
    return [Module(path, (ROOT / path).read_text(encoding="utf-8")) for path in tracked("sim2real/*.py")]


def texts() -> Iterator[tuple[str, str]]:
    """Yield path and text of the code and the documents, without tests and this file."""
    for path in tracked("sim2real", "pipelines", "scripts", "docs", "*.md"):
        if path.endswith((".py", ".md")) and not path.startswith("tests/") and path != "scripts/house.py":
            yield path, (ROOT / path).read_text(encoding="utf-8")


def words(wanted: re.Pattern[str] = WORDS) -> list[tuple[str, int, str]]:
    """Return path, line and word of every match of a pattern in code and documents."""
    return [
        (path, text.count("\n", 0, match.start()) + 1, re.sub(r"\n[ #]*", " ", match[0].lower()))
        for path, text in texts()
        for match in wanted.finditer(text)
    ]


def named_badly(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and name of every name in code that is a participle, or has a word of speech as one of its parts."""
    for token in tokens(text):
        name = token.string.lower().strip("_")
        parts = set(name.replace("left_out", "left out").split("_"))
        if token.type == tokenize.NAME and (name in NAMES or (len(parts) > 1 and parts & PARTS_OF_NAMES)):
            yield token.start[0], token.string


def other_words() -> list[tuple[str, int, str]]:
    """Return path, line and word of the other words of the dialect, and of names in code that are such words."""
    names = [(path, line, name) for path, text in texts() if path.endswith(".py") for line, name in named_badly(text)]
    return sorted(words(OTHER_WORDS) + names)


def robot_classes() -> tuple[int, int]:
    """Return the levels of classes of the SO-101's robot below ``object``, and the number of its public members."""
    sys.path.insert(0, str(ROOT))
    from pipelines.so101.robot import SO101Robot

    ours = [base for base in SO101Robot.__mro__ if base.__module__.startswith(("sim2real", "pipelines"))]
    return len(ours), sum(not name.startswith("_") for name in dir(SO101Robot))


def hardware_of_training() -> int:
    """Return the number of modules of ``sim2real.hardware`` that a training of the arm imports."""
    code = (
        "import sys; from sim2real.stages.pipeline import load_pipeline; import sim2real.stages.train.stage;"
        "load_pipeline('arm').load(); print(sum(m.startswith('sim2real.hardware.') for m in sys.modules))"
    )
    return int(
        subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    )


def figures() -> dict[str, tuple[float, float]]:
    """Return name -> (value, goal) of every figure that is measured on the files alone."""
    every = modules()
    lines = sum((module.lines for module in every), Counter[str]())
    total = sum(lines.values())
    composer = sum(sum(m.lines.values()) for m in every if m.path.startswith("sim2real/composer/"))
    folders = Counter(str(Path(module.path).parent) for module in every)
    return {
        "lines without composer": (total - composer, 40_000),
        "lines of composer": (composer, 11_000),
        "files in the fullest folder": (max(folders.values()), 15),
        "docstring lines [%]": (round(100 * lines["docstring"] / total, 1), 18),
        "comment lines [%]": (round(100 * lines["comment"] / total, 2), 3),
        "Any in 1,000 lines": (round(1000 * sum(module.anys for module in every) / total, 1), 10),
        "words of the dialect": (len(words()), 0),
        "other words of the dialect": (len(other_words()), 0),
        "largest number of project imports": (max(module.project_imports for module in every), 18),
    }


def main() -> None:
    """Print the figures, or the words."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--words", action="store_true", help="list the words to replace, with file and line")
    parser.add_argument("--other-words", action="store_true", help="list the other words of the dialect likewise")
    flags = parser.parse_args()
    if flags.words or flags.other_words:
        for path, line, word in words() if flags.words else other_words():
            print(f"{path}:{line}: {word}")
        return
    levels, members = robot_classes()
    rows = figures() | {
        "levels of robot classes": (levels, 2),
        "public members of SO101Robot": (members, 25),
        "modules of hardware that train imports": (hardware_of_training(), 0),
    }
    print(f"{'':40}{'value':>10}{'goal':>10}")
    for name, (value, goal) in rows.items():
        print(f"{name:40}{value:>10,}{goal:>10,}")


if __name__ == "__main__":
    main()
