"""Processes of a bench end with it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
BENCH = """
import argparse, os, pathlib, sys, time
from benches import jobs

def work(number, options):
    pathlib.Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep(120)
    return {}

if __name__ == "__main__":
    list(jobs.each(work, [(0,), (1,)], argparse.Namespace(jobs=2)))
"""


def alive(pid):
    """Whether a process runs; one that ended and was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def until(holds, seconds=60.0):
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.05)
    return holds()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")
def test_a_bench_that_is_killed_leaves_nothing_that_computes(tmp_path):
    script, seen = tmp_path / "bench.py", tmp_path / "seen"
    script.write_text(BENCH)
    seen.mkdir()
    path = os.pathsep.join([str(SCRIPTS), os.environ.get("PYTHONPATH", "")])
    bench = subprocess.Popen([sys.executable, str(script), str(seen)], env={**os.environ, "PYTHONPATH": path})
    try:
        assert until(lambda: len(list(seen.iterdir())) == 2)
        pids = [int(file.name) for file in seen.iterdir()]
        assert all(map(alive, pids))
    finally:
        bench.send_signal(signal.SIGKILL)
        bench.wait()
    assert until(lambda: not any(map(alive, pids)))
