"""The flag ``--view`` of several stages."""

from typing import Annotated

from sim2real.errors import UsageError
from sim2real.stages.flag import Flag

WINDOW = "window"
"""The viewer that ``--view`` without a value opens."""
ViewFlag = Annotated[str | None, Flag("[web|ADDRESS|FILE.rrd]", alone=WINDOW)]


def check_view(view: str | None) -> None:
    """Refuse a value of ``--view`` that is no viewer.

    Raises:
        UsageError: It is neither ``window`` nor ``web``, an address or a file of Rerun.
    """
    if view is not None and not is_viewer(view):
        raise UsageError(
            f"--view {view} is no viewer",
            hint="--view alone opens a window, --view web a page for browsers of this computer, --view web:0.0.0.0 one "
            "for the network; an address such as rerun+http://HOST:9876/proxy is a viewer elsewhere, and FILE.rrd a "
            "file",
        )


def is_viewer(view: str) -> bool:
    """Return whether a text names a viewer: ``window``, ``web``, an address, or a file of Rerun."""
    return view == WINDOW or view.partition(":")[0] == "web" or "://" in view or view.endswith(".rrd")
