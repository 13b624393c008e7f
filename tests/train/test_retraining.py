"""A training after another recording of a robot: the numbers change, the program does not."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.night  # `make test` checks the reason: the test above
def test_a_second_recording_compiles_nothing(tmp_path):
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, str(Path(__file__).with_name("retraining.py")), "0", "1"]
    done = subprocess.run(command, env={**os.environ, **cache}, capture_output=True, text=True, check=True)
    counts = [[int(n) for n in line.split()] for line in done.stdout.splitlines()]
    assert counts[0][0] > 0
    assert counts[1][0] == 0, counts
    assert counts[1][1] >= counts[0][0]
