"""The state of the code that a report measured, and its comparison with the present state.

The digest decides. It needs no history, so it also works in a shallow clone and in a copy without git. The commit is
for people, and names the files that have changed since.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import io
import subprocess
import tokenize
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
_POSTPONED = "from __future__ import annotations"
"""A line that changes no figure: whether annotations are evaluated."""


def state(paths: Sequence[str], root: Path, commit: str | None = None) -> dict[str, Any]:
    """Return commit, files that differ from it, and digest of the measured paths; the commit is None without git."""
    head = _git(root, "rev-parse", "--verify", "HEAD")
    changes = _git(root, "status", "--porcelain") if head else None
    return {
        "commit": head or commit,
        # A report that was written by the same command is no change of the code.
        "dirty": [line[3:] for line in (changes or "").splitlines() if not line[3:].startswith("reports/")],
        "measured": digest(paths, root),
    }


def digest(paths: Sequence[str], root: Path) -> str:
    """Return a SHA-256 over the names and the essence of the measured files; a path that is absent is an error."""
    total = hashlib.sha256()
    for file in files(paths, root):
        total.update(f"{file.relative_to(root).as_posix()}\0{essence(file)}\0".encode())
    return total.hexdigest()


def files(paths: Sequence[str], root: Path) -> list[Path]:
    """Return the files below the paths, without those below paths that begin with ``!``."""
    selected: set[Path] = set()
    for path in paths:
        at = root / path.lstrip("!")
        if not at.exists():
            raise FileNotFoundError(f"{at} is not there: correct scripts/benches/catalogue.py")
        below = {at} if at.is_file() else {f for f in at.rglob("*") if f.is_file() and "__pycache__" not in f.parts}
        selected = selected - below if path.startswith("!") else selected | below
    return sorted(selected)


def essence(file: Path) -> str:
    """Return the part of a file that can change a figure: of Python, the lines without comments and docstrings."""
    at = file.stat()
    return _essence(file, at.st_mtime_ns, at.st_size)


@functools.cache
def _essence(file: Path, mtime_ns: int, size: int) -> str:
    """Return the essence of a file as it is at a time: the digests of a process share most files."""
    del mtime_ns, size
    content = file.read_bytes()
    if file.suffix != ".py":
        return hashlib.sha256(content).hexdigest()
    text = content.decode()
    constants = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
    docstrings = {
        line for n in constants if isinstance(n.value.value, str) for line in range(n.lineno, n.end_lineno + 1)
    }
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    comments = {t.start[0]: t.start[1] for t in tokens if t.type == tokenize.COMMENT}
    lines = [
        line[: comments.get(number)].rstrip()
        for number, line in enumerate(text.splitlines(), 1)
        if number not in docstrings
    ]
    return "\n".join(line for line in lines if line and line != _POSTPONED)


def why_stale(report: Mapping[str, Any], paths: Sequence[str], root: Path) -> str | None:
    """Return the reason why a report is not of the present files; None if it is."""
    if "measured" not in report:
        return "it has no digest of the state of the code"
    if report["quick"]:
        return "it was made with --quick"
    if report["measured"] == digest(paths, root):
        return None
    commit = report["commit"]
    if commit is None:
        return "the measured files have changed; it names no commit"
    listed = _git(root, "diff", "--name-only", commit, "--", *(p.replace("!", ":!") for p in paths))
    if listed is None:
        return f"the measured files have changed since {commit[:7]}, which this clone lacks: git fetch --unshallow"
    names = listed.splitlines()
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"the measured files have changed since {commit[:7]}: {shown or 'it was made with changes not committed'}"


def _git(root: Path, *arguments: str) -> str | None:
    """Return the output of a git command; None if it fails or there is no git."""
    try:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.rstrip("\n")
