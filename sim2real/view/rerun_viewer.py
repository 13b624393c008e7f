"""The Rerun viewer: a window, a page for browsers, a viewer at an address, or a file."""

import os
import socket
import subprocess
import sys
import sysconfig
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from sim2real.errors import Sim2RealError
from sim2real.installation import with_extra

_GRPC_PORT, _WEB_PORT = 9876, 9090
"""Rerun's default ports; a port that is in use is replaced by a free one."""
LOCAL = "127.0.0.1"
_START_S = 20.0
"""Longest wait for the server of a page [s]."""
_KEEPER = """
import os, signal, subprocess, sys
server = subprocess.Popen([sys.executable, "-m", "rerun_cli", *sys.argv[1:]], stdin=subprocess.DEVNULL)
sys.stdin.read()
os.killpg(0, signal.SIGTERM)
"""
"""Serves until its standard input closes, at the latest when this process ends for any reason."""
_keepers: list[subprocess.Popen[bytes]] = []
"""Processes whose input stays open as long as this process lives."""


def open_viewer(recording: Any, target: str) -> str:
    """Connect a ``rerun.RecordingStream`` to a viewer; return a line for the user.

    Args:
        target: ``window``; ``web``, a page for browsers of this computer, or ``web:ADDRESS``, a page at the network
            interface with this address; the address of a viewer (``rerun+http://HOST:9876/proxy``); a file (``.rrd``).

    Raises:
        Sim2RealError: There is no screen, or the viewer does not start.
    """
    try:
        if target == "window":
            if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                raise Sim2RealError("this computer has no screen", hint="--view web opens a page for a browser")
            # The viewer of this installation, whose folder of scripts may be missing in PATH.
            os.environ["PATH"] = os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", os.defpath)])
            recording.spawn()
            return "the Rerun viewer shows the robot"
        if target.split(":")[0] == "web":
            interface = target.partition(":")[2] or LOCAL
            port, data_port = _served(interface)
            recording.connect_grpc(f"rerun+http://{_reached(interface)}:{data_port}/proxy")
            host = socket.gethostname() if interface in ("0.0.0.0", "::") else interface
            return f"open http://{host}:{port}/?url=rerun%2Bhttp://{host}:{data_port}/proxy in a browser"
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
        raise Sim2RealError(
            f"{reason}: {error}", hint="give FILE.rrd instead to write a file, which the viewer opens later"
        ) from error


def rerun_module() -> Any:
    """Import Rerun, which is an extra."""
    try:
        import rerun
    except ImportError as error:
        raise Sim2RealError("the Rerun viewer is not installed", hint=with_extra("view")) from error
    return rerun


def _served(interface: str) -> tuple[int, int]:
    """Start Rerun's server of a page, until this process ends; return the ports of the page and of its data.

    Rerun's functions listen at all interfaces; its command has a flag for one.
    """
    data_port, port = (_free_port(wanted, interface) for wanted in (_GRPC_PORT, _WEB_PORT))
    ports = ["--port", str(data_port), "--web-viewer-port", str(port), "--server-memory-limit", "256MB"]
    keeper = subprocess.Popen(
        [sys.executable, "-c", _KEEPER, "--serve-web", "--bind", interface, *ports],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    _keepers.append(keeper)
    end_s = time.monotonic() + _START_S
    for number in (data_port, port):
        while True:
            with suppress(OSError), socket.create_connection((_reached(interface), number), 1.0):
                break
            if keeper.poll() is not None or time.monotonic() > end_s:
                raise RuntimeError(f"its server does not start at {interface}")
            time.sleep(0.05)
    return port, data_port


def _reached(interface: str) -> str:
    """Return the address at which this computer reaches a network interface."""
    return LOCAL if interface in ("0.0.0.0", "::") else interface


def _free_port(wanted: int, interface: str) -> int:
    """Return a port of an interface if it is free, otherwise another one."""
    for port in (wanted, 0):
        with socket.socket() as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                server.bind((interface, port))
            except OSError:
                continue
            return int(server.getsockname()[1])
    return wanted
