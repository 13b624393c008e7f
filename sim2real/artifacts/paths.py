"""Paths in messages; imports no large library, so that the command line starts fast."""

import os
from pathlib import Path


def shown(path: Path | str) -> str:
    """Return a path for messages: relative to the working directory if the path is inside it."""
    absolute = Path(os.path.abspath(path))
    here = Path.cwd()
    return str(absolute.relative_to(here)) if absolute.is_relative_to(here) else str(absolute)
