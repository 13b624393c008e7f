"""Limits, and how to wait for a process, on a machine that may be busy."""

import time
from pathlib import Path

PATIENT = ["--gate.servo-watchdog-s", "1.0", "--gate.command-timeout-s", "1.0", "--gate.max-sample-age-s", "3"]
"""A busy machine may hold up the process for most of a second."""


def wait_until_running(root, pattern, process):
    """Wait until a log has been flushed twice, which is when the motor turns; return the log."""
    sizes = set()
    while len(sizes) < 4:
        assert process.poll() is None, process.communicate()
        logs = list(Path(root).glob(pattern))
        sizes |= {log.stat().st_size for log in logs}
        time.sleep(0.02)
    return logs[0]
