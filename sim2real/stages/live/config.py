"""The flag ``--view`` of several stages."""

from typing import Annotated

import tyro

from sim2real.errors import UsageError

WINDOW = "window"
"""The viewer that ``--view`` without a value opens."""
ViewFlag = Annotated[str | None, tyro.conf.arg(metavar="[web|ADDRESS|FILE.rrd]")]


def check_view(view: str | None) -> None:
    """Refuse a value of ``--view`` that is no viewer.

    Raises:
        UsageError: It is neither ``window`` nor ``web``, an address or a file of Rerun.
    """
    if view is not None and view not in (WINDOW, "web") and "://" not in view and not view.endswith(".rrd"):
        raise UsageError(
            f"--view {view} is no viewer",
            hint="--view alone opens a window, --view web a page for browsers; an address such as "
            "rerun+http://HOST:9876/proxy is a viewer elsewhere, and FILE.rrd a file",
        )
