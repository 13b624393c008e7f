"""Command lines as processes of their own, and robots that outlive their host."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from emulator import EmulatedProcess

from sim2real.stages.load import load_robot

ROOT = Path(__file__).parents[2]


@pytest.fixture
def lone_robot(tmp_path):
    """An emulated pendulum that does not end with its host."""
    embedded = load_robot("pendulum").drive.embedded()
    plant = f"{ROOT / 'pipelines/pendulum/plant.py'}:PendulumPlant"
    with EmulatedProcess(plant, embedded.emulator, {}, tmp_path / "truth.bin") as robot:
        yield robot


@pytest.fixture
def start_cli():
    """Start the command line as a process of its own."""
    processes = []

    def start(*arguments):
        process = subprocess.Popen(
            [sys.executable, "-m", "sim2real.cli", *map(str, arguments)],
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()
