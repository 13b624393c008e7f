"""MJCF into an ``MjSpec``, by MuJoCo's own parser."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.composer.models.given import Document
from sim2real.composer.models.translate import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    import os

    from sim2real.composer.types import MjSpec

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_INCLUDE = re.compile(r"""<include\s+file\s*=\s*["']([^"']*)["']\s*(?:/>|>\s*</include>)""")
_ROOT = re.compile(r"<(mujoco\w*)[^>]*>(.*)</\1\s*>", re.DOTALL)
_BETWEEN = re.compile(r">\s*<(?!!)")


def from_string(text: str | bytes, assets: dict[str, bytes] | None = None) -> tuple[MjSpec, Document]:
    """Return the ``MjSpec`` of an MJCF document, and the document as it was read.

    Every element is put on a line of its own: the line that MuJoCo notes then gives the order of the document, which
    decides what elements without a name are called.

    Raises:
        ValueError: MuJoCo's own message, when the document cannot be parsed.
    """
    text = text.decode() if isinstance(text, bytes) else text
    spread = _BETWEEN.sub(">\n<", text)
    try:
        return _named(mj.MjSpec.from_string(spread, assets=assets or {}), text), Document(spread)
    except ValueError:
        mj.MjSpec.from_string(text, assets=assets or {})  # raises with the lines of the document as it is
        raise


def from_path(path: str | os.PathLike[str], assets: dict[str, bytes] | None = None) -> tuple[MjSpec, Document]:
    """Return the ``MjSpec`` of an MJCF file, and the document as it was read, with those that it includes.

    Raises:
        UsageError: When there is no such file, or none that it includes.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"there is no MJCF file {str(path)!r}", hint="give the path of a file that exists")
    spec, document = from_string(_read(path, path.parent, assets or {}), assets)
    spec.modelfiledir = str(path.parent.resolve())
    return spec, document


def _read(path: Path, folder: Path, assets: dict[str, bytes]) -> str:
    """Return the text of a document with what it includes in its place."""
    name = str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)
    text = assets[name].decode() if name in assets else path.read_text(encoding="utf-8")

    def included(match: re.Match[str]) -> str:
        candidates = [folder / match[1], path.parent / match[1]]
        found = next((c for c in candidates if c.is_file() or match[1] in assets), None)
        if found is None:
            raise UsageError(f"{path} includes {match[1]!r}, which is not there", hint=f"looked for {candidates[0]}")
        body = _ROOT.search(_read(found, folder, assets))
        return body[2] if body else ""

    return _INCLUDE.sub(included, _COMMENT.sub("", text)) if "<include" in text else text


def _named(spec: MjSpec, text: str) -> MjSpec:
    if not re.search(r"<mujoco[^>]*\smodel\s*=", text):
        spec.modelname = "unnamed_model"
    return spec
