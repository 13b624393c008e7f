"""Which state of the code a report is of, and whether what it measured is still the same.

The digest decides: it needs no history, so it holds in a shallow clone and on a machine that got a bare copy. The
commit is there for people, and names the files that have changed since.
"""

from __future__ import annotations

import ast
import hashlib
import io
import subprocess
import tokenize
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def state(paths: Sequence[str], root: Path, commit: str | None = None) -> dict[str, Any]:
    """Return commit, files that differ from it and digest of what is measured; no commit where there is no git."""
    found = _git(root, "rev-parse", "--verify", "HEAD")
    changes = _git(root, "status", "--porcelain") if found else None
    return {
        "commit": found or commit,
        "dirty": [line[3:] for line in (changes or "").splitlines()],
        "measured": digest(paths, root),
    }


def digest(paths: Sequence[str], root: Path) -> str:
    """Return a SHA-256 over the files that are measured: their names, and what of them can change a figure.

    Raises:
        FileNotFoundError: When one of the paths is not there.
    """
    total = hashlib.sha256()
    for file in files(paths, root):
        total.update(f"{file.relative_to(root).as_posix()}\0{essence(file)}\0".encode())
    return total.hexdigest()


def files(paths: Sequence[str], root: Path) -> list[Path]:
    """Return the files below the paths, without those below paths that begin with ``!``."""
    found: set[Path] = set()
    for path in paths:
        at = root / path.lstrip("!")
        if not at.exists():
            raise FileNotFoundError(f"{at} is not there: correct scripts/benches/catalogue.py")
        below = {at} if at.is_file() else {f for f in at.rglob("*") if f.is_file() and "__pycache__" not in f.parts}
        found = found - below if path.startswith("!") else found | below
    return sorted(found)


def essence(file: Path) -> str:
    """Return what of a file can change a figure: of Python, the lines without comments and docstrings."""
    content = file.read_bytes()
    if file.suffix != ".py":
        return hashlib.sha256(content).hexdigest()
    text = content.decode()
    said = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)]
    left_out = {line for n in said if isinstance(n.value.value, str) for line in range(n.lineno, n.end_lineno + 1)}
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    comments = {t.start[0]: t.start[1] for t in tokens if t.type == tokenize.COMMENT}
    lines = [
        line[: comments.get(number)].rstrip()
        for number, line in enumerate(text.splitlines(), 1)
        if number not in left_out
    ]
    return "\n".join(line for line in lines if line)


def why_stale(report: Mapping[str, Any], paths: Sequence[str], root: Path) -> str | None:
    """Return why a report does not speak of the files as they are, in words; None where it does."""
    if "measured" not in report:
        return "it does not say which state of the code it is of"
    if report["quick"]:
        return "it was made with --quick"
    if report["measured"] == digest(paths, root):
        return None
    commit = report["commit"]
    if commit is None:
        return "what it measures has changed; it names no commit"
    listed = _git(root, "diff", "--name-only", commit, "--", *(p.replace("!", ":!") for p in paths))
    if listed is None:
        return (
            f"what it measures has changed since {commit[:7]}, which this clone lacks (git fetch --unshallow gets it)"
        )
    names = listed.splitlines()
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"what it measures has changed since {commit[:7]}: {shown or 'it was made with changes not committed'}"


def _git(root: Path, *arguments: str) -> str | None:
    """Return what a git command prints; None where it fails or there is no git."""
    try:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.rstrip("\n")
