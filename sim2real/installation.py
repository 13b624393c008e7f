"""The installed distribution: ``sim2real`` with everything, or ``sim2real-robot`` for a robot's computer."""

import functools
import importlib.util
import os
import re
from pathlib import Path

from sim2real.errors import UsageError

WHOLE, ROBOT = "sim2real", "sim2real-robot"


def version(name: str = WHOLE) -> str | None:
    """Return the version of a distribution, ``sim2real`` under either name; None: it is not installed."""
    from importlib import metadata  # takes 15 ms

    for distribution in (WHOLE, ROBOT) if name == WHOLE else (name,):
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            continue
    return None


@functools.cache
def has_jax() -> bool:
    """Return whether JAX is installed, without importing it."""
    return importlib.util.find_spec("jax") is not None


def with_extra(extra: str) -> str:
    """Return the command that installs the packages of an extra.

    The command has these packages, and not this distribution: its name is not registered on any index, so a stranger
    may take it.
    """
    from importlib import metadata

    of_extra = re.compile(rf"""extra == ['"]{re.escape(extra)}['"]""")
    required = metadata.requires(ROBOT if version(ROBOT) else WHOLE) or []
    return " ".join(["pip install", *(f"'{r.partition(';')[0].strip()}'" for r in required if of_extra.search(r))])


def require_one(folder: Path = Path(__file__).parents[1]) -> None:
    """Refuse two distributions in one folder: the second has replaced files of the first.

    Raises:
        UsageError: Both are installed.
    """
    files = os.listdir(folder)
    prefixes = [f"{name.replace('-', '_')}-" for name in (WHOLE, ROBOT)]
    if all(any(f.startswith(prefix) and f.endswith(".dist-info") for f in files) for prefix in prefixes):
        raise UsageError(
            f"both {WHOLE} and {ROBOT} are installed in {folder}: each has replaced files of the other",
            hint=f"pip uninstall -y {WHOLE} {ROBOT}, then install one of them; {WHOLE} has everything",
        )
