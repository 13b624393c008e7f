"""A bench that is killed leaves none of the processes of its tasks."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [pytest.mark.process, pytest.mark.night]
SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
BENCH = """
import argparse, os, pathlib, sys, time
from benches import jobs

def work(number, options):
    pathlib.Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep(120)

if __name__ == "__main__":
    list(jobs.each(work, [(0,), (1,)], argparse.Namespace(jobs=2)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends a process with its parent")
def test_a_killed_bench_leaves_no_process(tmp_path):
    def until(holds):
        end = time.monotonic() + 60.0
        while not holds() and time.monotonic() < end:
            time.sleep(0.05)
        return holds()

    def alive(pid):
        try:
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
        except FileNotFoundError:
            return False

    (tmp_path / "bench.py").write_text(BENCH)
    (tmp_path / "seen").mkdir()
    environment = {**os.environ, "PYTHONPATH": str(SCRIPTS)}
    bench = subprocess.Popen([sys.executable, tmp_path / "bench.py", tmp_path / "seen"], env=environment)
    try:
        assert until(lambda: len(list((tmp_path / "seen").iterdir())) == 2)
        pids = [int(file.name) for file in (tmp_path / "seen").iterdir()]
    finally:
        bench.send_signal(signal.SIGKILL)
        bench.wait()
    assert until(lambda: not any(map(alive, pids)))
