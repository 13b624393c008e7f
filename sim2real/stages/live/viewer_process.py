"""The process of a live view: it reads what a stage writes, and feeds the viewer, until its standard input closes.

It runs at low priority. It shares no lock, no queue and no memory with the stage, so it cannot slow a control loop down
except by the processor time that it takes.
"""

import contextlib
import json
import os
import select
import sys
from pathlib import Path

from sim2real.errors import Sim2RealError
from sim2real.stages.live.scene import drawn
from sim2real.types import Json
from sim2real.view.live.follower import PERIOD_S, Follower
from sim2real.view.rerun_viewer import open_viewer, rerun_module

NICENESS = 10


def main() -> None:
    """Follow the folders that the first line of the standard input names."""
    # The viewer inherits the priority: every other program comes first. Only Linux has the second one.
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    order = json.loads(sys.stdin.readline())
    try:
        recording = rerun_module().RecordingStream(f"sim2real {order['name']}")
        line = open_viewer(recording, order["target"])
        follower = Follower(recording, lambda: [Path(order["folder"])], drawn(order))
    except Sim2RealError as error:
        _report(error=error.args[0], hint=error.hint)
        return
    _report(line=line)
    try:
        while not select.select([sys.stdin], [], [], PERIOD_S)[0]:
            follower.poll()
        follower.poll()
        _report(dropped=follower.close())
    except Sim2RealError as error:
        _report(error=error.args[0], hint=error.hint)


def _report(**message: Json) -> None:
    print(json.dumps(message), flush=True)


if __name__ == "__main__":
    main()
