"""MJCF into an ``MjSpec``, by MuJoCo's own parser."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from sim2real.composer.models.mjcf.explicit_values import Document
from sim2real.composer.models.mjcf.translate import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjSpec

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_INCLUDE = re.compile(r"""<include\s+file\s*=\s*["']([^"']*)["']\s*(?:/>|>\s*</include>)""")
_ROOT = re.compile(r"<(mujoco\w*)[^>]*>(.*)</\1\s*>", re.DOTALL)
_MOST_INCLUDES = 50
"""Largest number of documents that include each other in a row."""
_BETWEEN = re.compile(r">\s*<(?!!)")


def from_string(
    text: str | bytes, assets: dict[str, bytes] | None = None, folder: str | os.PathLike[str] = ""
) -> tuple[MjSpec, Document]:
    """Return the ``MjSpec`` of an MJCF document, and the document as it was read, with those that it includes.

    Every element is put on a line of its own: the line that MuJoCo notes then gives the order of the document, which
    decides what elements without a name are called.

    Args:
        assets: Contents of files by name: they are looked for there first.
        folder: Where relative paths of files begin; default: the working directory.

    Raises:
        ValueError: MuJoCo's own message, when the document cannot be parsed.
        UsageError: When a document that it includes is not there.
    """
    text = _decoded(text, "the document") if isinstance(text, bytes) else text
    whole = _with_included(text, Path(folder), Path(folder), assets or {})
    spec, document = _parse(whole, assets)
    if os.fspath(folder):
        spec.modelfiledir = str(Path(folder).resolve())
    return spec, document


def _parse(text: str, assets: dict[str, bytes] | None) -> tuple[MjSpec, Document]:
    spread = _BETWEEN.sub(">\n<", text)
    try:
        return _named(mj.MjSpec.from_string(spread, assets=assets or {}), text), Document(spread)
    except ValueError:
        mj.MjSpec.from_string(text, assets=assets or {})  # raises with the lines of the document as it is
        raise


def from_path(path: str | os.PathLike[str], assets: dict[str, bytes] | None = None) -> tuple[MjSpec, Document]:
    """Return the ``MjSpec`` of an MJCF file, and the document as it was read, with those that it includes."""
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"there is no MJCF file {str(path)!r}", hint="give the path of a file that exists")
    whole = _read(path, path.parent, assets or {})
    spec, document = _parse(whole, assets)
    spec.modelfiledir = str(path.parent.resolve())
    return spec, document


def _decoded(text: bytes, what: str) -> str:
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(f"{what} is not UTF-8: byte 0x{text[error.start]:02x}", hint="save it as UTF-8") from None


def _read(path: Path, folder: Path, assets: dict[str, bytes], level: int = 0) -> str:
    """Return the text of a document with its included documents in place."""
    name = str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)
    text = _decoded(assets[name] if name in assets else path.read_bytes(), str(path))
    return _with_included(text, path.parent, folder, assets, level)


def _with_included(text: str, beside: Path, folder: Path, assets: dict[str, bytes], level: int = 0) -> str:
    """Return a document with its included documents in place; two folders are searched for them.

    Args:
        level: Number of documents that include this one.
    """
    if level > _MOST_INCLUDES:
        raise UsageError(f"{beside} has documents that include each other", hint="remove the circle")

    def included(match: re.Match[str]) -> str:
        candidates = [folder / match[1], beside / match[1]]
        path = next((c for c in candidates if c.is_file() or match[1] in assets), None)
        if path is None:
            raise UsageError(
                f"the document includes {match[1]!r}, which is not there",
                hint=f"looked for {candidates[0]}; from_xml_string takes model_dir and assets",
            )
        body = _ROOT.search(_read(path, folder, assets, level + 1))
        return body[2] if body else ""

    return _INCLUDE.sub(included, _COMMENT.sub("", text)) if "<include" in text else text


def _named(spec: MjSpec, text: str) -> MjSpec:
    if not re.search(r"<mujoco[^>]*\smodel\s*=", text):
        spec.modelname = "unnamed_model"
    return spec
