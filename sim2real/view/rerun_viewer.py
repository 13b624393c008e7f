"""The Rerun viewer: a window, a page for browsers, a viewer at an address, or a file."""

import os
import socket
import sys
import sysconfig
from pathlib import Path
from typing import Any

from sim2real.errors import Sim2RealError
from sim2real.installation import with_extra

_GRPC_PORT, _WEB_PORT = 9876, 9090
"""Rerun's own ports; a port that is in use is replaced by a free one."""


def open_viewer(recording: Any, target: str) -> str:
    """Connect a ``rerun.RecordingStream`` to a viewer; return a line for the user.

    Args:
        target: ``window``, ``web``, the address of a viewer (``rerun+http://HOST:9876/proxy``), or a file (``.rrd``).

    Raises:
        Sim2RealError: There is no screen, or the viewer does not start.
    """
    try:
        if target == "window":
            if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                raise Sim2RealError("this computer has no screen", hint="--view web opens a page for a browser")
            # The viewer of this installation, whose folder of scripts may lack in PATH.
            os.environ["PATH"] = os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", os.defpath)])
            recording.spawn()
            return "the Rerun viewer shows the robot"
        if target == "web":
            address = recording.serve_grpc(grpc_port=_free_port(_GRPC_PORT), server_memory_limit="256MB")
            port = _free_port(_WEB_PORT)
            rerun_module().serve_web_viewer(web_port=port, open_browser=False)
            host = socket.gethostname()
            outside = address.replace("127.0.0.1", host).replace("localhost", host)
            return f"open http://{host}:{port}/?url={outside.replace('+', '%2B')} in a browser"
        if "://" in target:
            recording.connect_grpc(target)
            return f"the viewer at {target} shows the robot"
        Path(target).parent.mkdir(parents=True, exist_ok=True)
        recording.save(target)
        return f"writing {target}"
    except Sim2RealError:
        raise
    except (OSError, RuntimeError, ValueError) as error:
        reason = f"cannot write {target}" if target.endswith(".rrd") else "cannot open the Rerun viewer"
        raise Sim2RealError(f"{reason}: {error}", hint="save it with --save FILE.rrd and open that") from error


def rerun_module() -> Any:
    """Import Rerun, which is an extra."""
    try:
        import rerun
    except ImportError as error:
        raise Sim2RealError("the Rerun viewer is not installed", hint=with_extra("view")) from error
    return rerun


def _free_port(wanted: int) -> int:
    """Return a port if it is free, otherwise another one."""
    for port in (wanted, 0):
        with socket.socket() as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                server.bind(("0.0.0.0", port))
            except OSError:
                continue
            return int(server.getsockname()[1])
    return wanted
