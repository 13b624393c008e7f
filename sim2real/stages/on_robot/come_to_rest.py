"""The soft end of an episode: the robot comes to rest, and is held where it would fall."""

import select
import sys

from sim2real.hardware.safety.rig import Rig
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.stages.terminal.console import note

_POLL_S = 0.02


def come_to_rest(graph: AsyncGraph, rig: Rig, hold: bool) -> None:
    """Let commands fade, or goals stay, until the robot is at rest; the graph runs on and its log with it.

    Args:
        hold: Whether to hold it then until Enter is pressed; without a terminal, until a signal comes.

    Raises:
        Sim2RealError: What stopped the robot meanwhile.
    """
    if rig.torque_withheld or not graph.running:
        return
    note("coming to rest; Ctrl-C stops at once", urgent=True)
    rig.ease()
    while graph.running and not rig.eased:
        graph.run_for(_POLL_S)
    if hold:
        note("holding: support the robot, then press Enter to take the torque off", urgent=True)
        while graph.running and not _told():
            graph.run_for(_POLL_S)


def _told() -> bool:
    """Return whether Enter was pressed."""
    if not sys.stdin.isatty():  # an input that is closed would let go at once
        return False
    ready = bool(select.select([sys.stdin], [], [], 0.0)[0])
    return ready and bool(sys.stdin.readline())
