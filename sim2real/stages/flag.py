"""How a field of a configuration appears on the command line, and checks of common flags. Imports no JAX."""

import math
from dataclasses import dataclass
from typing import Annotated

from sim2real.errors import UsageError


@dataclass(frozen=True)
class Flag:
    """Marks a field: ``port: Annotated[str | None, Flag("PORT")] = None``.

    Attributes:
        metavar: Placeholder of the value in ``--help``; "": the type's.
        positional: Whether the value stands without a flag.
        needed: Whether the flag is required.
        flat: Whether the flags of a nested configuration have no prefix.
        also: A second name, such as ``--like``.
        alone: Value of the flag if it is given without a value; None: a value is required.
    """

    metavar: str = ""
    positional: bool = False
    needed: bool = False
    flat: bool = False
    also: str = ""
    alone: str | None = None


WINDOW = "window"
"""The viewer that ``--view`` without a value opens."""
ViewFlag = Annotated[str | None, Flag("[web|ADDRESS|FILE.rrd]", alone=WINDOW)]


def is_viewer(view: str) -> bool:
    """Return whether a text is a viewer: ``window``, ``web``, an address, or a file of Rerun."""
    return view == WINDOW or view.partition(":")[0] == "web" or "://" in view or view.endswith(".rrd")


def check_view(view: str | None) -> None:
    """Refuse a value of ``--view`` that is no viewer."""
    if view is not None and not is_viewer(view):
        raise UsageError(
            f"--view {view} is no viewer",
            hint="--view alone opens a window, --view web a page for browsers of this computer, --view web:0.0.0.0 one "
            "for the network; an address such as rerun+http://HOST:9876/proxy is a viewer elsewhere, and FILE.rrd a "
            "file",
        )


def check_seed(seed: int) -> None:
    """Refuse a value that is no seed."""
    if not 0 <= seed < 2**31:
        raise UsageError(f"seed must lie in [0, 2**31), got {seed}")


def check_rate(rate_hz: float | None) -> None:
    """Refuse a value that is no rate."""
    if rate_hz is not None and not 0.0 < rate_hz < math.inf:
        raise UsageError(f"a rate must lie above 0, in samples per second, got {rate_hz}", hint="--rate-hz 100")
