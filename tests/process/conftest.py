"""Command lines as processes of their own, and robots that outlive their host."""

import json
import os
import subprocess
import sys
from dataclasses import asdict

import pytest

from sim2real.emulation.truth import read_truth
from sim2real.stages.load import load_robot


@pytest.fixture
def lone_robot(tmp_path):
    """Start an emulated pendulum that does not end with its host; returns its port, and how to stop it."""
    embedded = load_robot("pendulum").drive.embedded
    path = tmp_path / "truth.bin"
    task = {"emulation": "sim2real.emulation.dynamixel:EmulatorConfig", "settings": asdict(embedded.emulator)}
    task |= {"plant": embedded.plant, "truth": str(path)}
    command = [sys.executable, "-m", "sim2real.emulation.process", json.dumps(task)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    port = json.loads(process.stdout.readline())["port"]

    def end():
        process.terminate()
        process.wait(60)
        return read_truth(path)

    yield port, end
    process.kill()
    process.communicate()


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
