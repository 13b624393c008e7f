"""MJCF into an ``MjSpec``, by MuJoCo's own parser."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from sim2real.composer.translate import mj
from sim2real.errors import UsageError

_BETWEEN = re.compile(r">\s*<(?!!)")


def from_string(text: str | bytes, assets: dict[str, bytes] | None = None) -> Any:
    """Return the ``MjSpec`` of an MJCF document.

    Every element is put on a line of its own: the line that MuJoCo notes then gives the order of the document, which
    decides what elements without a name are called.

    Raises:
        ValueError: MuJoCo's own message, when the document cannot be parsed.
    """
    text = text.decode() if isinstance(text, bytes) else text
    try:
        return _named(mj.MjSpec.from_string(_BETWEEN.sub(">\n<", text), assets=assets or {}), text)
    except ValueError:
        mj.MjSpec.from_string(text, assets=assets or {})  # raises with the lines of the document as it is
        raise


def from_path(path: Any, assets: dict[str, bytes] | None = None) -> Any:
    """Return the ``MjSpec`` of an MJCF file.

    Raises:
        UsageError: When there is no such file.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"there is no MJCF file {str(path)!r}", hint="give the path of a file that exists")
    text = path.read_text(encoding="utf-8")
    if "<include" in text:
        return _named(mj.MjSpec.from_file(str(path), assets=assets or {}), text)
    spec = from_string(text, assets)
    spec.modelfiledir = str(path.parent.resolve())
    return spec


def _named(spec: Any, text: str) -> Any:
    if not re.search(r"<mujoco[^>]*\smodel\s*=", text):
        spec.modelname = "unnamed_model"
    return spec
