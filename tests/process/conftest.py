"""The stages for real: robots with faults, and robots that outlive their host."""

import json
import os
import subprocess
import sys
import textwrap
from dataclasses import asdict
from pathlib import Path

import pytest

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.process import EmbeddedRobot
from sim2real.emulation.truth import read_truth
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus
from sim2real.stages.pipeline.pipeline import load_pipeline

PLANTS = Path(__file__).parents[1] / "hardware" / "plants.py"
FAULTY = """
import time
from dataclasses import replace
import numpy as np
from sim2real.robots import nodes as hardware
from sim2real.robots.loop import control_nodes
from sim2real.stages.pipeline.pipeline import load_pipeline

pendulum = load_pipeline("pendulum")
robot = pendulum.load()

def faulty_emulator(**faults):
    return replace(robot.drive.embedded, emulator=replace(robot.drive.embedded.emulator, **faults))

def nodes(session, signal, sensor=hardware.ServoSensor, agent=hardware.Excitation):
    rows, command = np.reshape(signal, (-1, 1)), robot.drive.message
    return control_nodes(
        sensor("sensor", 50.0, session.rig, robot.sensor.read, robot.sensor.at_rest, delay=0.002),
        agent("agent", 50.0, rows, command, delay=0.002),
        hardware.ServoActuator("actuator", 50.0, session.rig, "action", command, delay=0.002),
    )
"""
FAULTS = """
ROBOT = type(robot)()
for part in (None, "drive", "sensor", "agent", "task", "model"):
    kind = type(getattr(robot, part) if part else robot)
    faults = {n: v for n, v in globals().items() if hasattr(kind, n) and not n.startswith("_")}
    faults = {n: staticmethod(f) if callable(f) else f for n, f in faults.items()}
    faulty = type("Faulty", (kind,), faults)
    if part:
        setattr(ROBOT, part, faulty())
    else:
        ROBOT = faulty()
"""


@pytest.fixture
def log(finished_run_dir):
    """A recorded log of the pendulum."""
    return finished_run_dir / "record" / "session.mcap"


@pytest.fixture
def make_pipeline(tmp_path, monkeypatch):
    """Write a pipeline that is the pendulum but for `body` into ./pipelines; names must differ between tests."""
    monkeypatch.chdir(tmp_path)

    def make(name, body):
        folder = tmp_path / "pipelines" / name
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(
            "from sim2real.stages.pipeline.pipeline import Pipeline\n"
            f"PIPELINE = Pipeline(name={name!r}, summary='pendulum with a fault', package=__name__)\n"
        )
        (folder / "robot.py").write_text(FAULTY + textwrap.dedent(body) + FAULTS)
        return name

    return make


@pytest.fixture
def lone_robot(tmp_path):
    """Start an emulated pendulum that does not end with its host; returns its port, its truth file, how to stop it."""
    embedded = load_pipeline("pendulum").load().drive.embedded
    path = tmp_path / "truth.bin"
    command = [sys.executable, "-m", "sim2real.emulation.process", "--plant", embedded.plant]
    command += ["--emulation", "sim2real.emulation.dynamixel:EmulatorConfig", "--truth", str(path)]
    command += [f"--{n.replace('_', '-')}={v!r}" for n, v in asdict(embedded.emulator).items() if v is not None]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    port = json.loads(process.stdout.readline())["port"]

    def end():
        process.terminate()
        process.wait(5)
        return read_truth(path)

    yield port, end
    process.kill()
    process.communicate()


@pytest.fixture
def start_cli():
    """Start the command line as a process of its own."""
    processes = []

    def start(*arguments, cwd=None):
        process = subprocess.Popen(
            [sys.executable, "-m", "sim2real.cli", *map(str, arguments)],
            cwd=cwd,
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


@pytest.fixture
def start_robot(tmp_path):
    """Start emulated servos in a process of their own; stopped at the end of the test."""
    robots = []

    def start(plant="FirstOrder", config=None, **plant_args):
        path = tmp_path / f"truth{len(robots)}.bin"
        robots.append(EmbeddedRobot(f"{PLANTS}:{plant}", config or EmulatorConfig(), plant_args, path))
        return robots[-1]

    yield start
    for robot in robots:
        robot.stop()


@pytest.fixture
def open_bus():
    """Open a bus to a robot and shake hands with the servos given; patient, for the machine may be busy."""
    buses = []

    def open_(robot, ids=(1,), mode=None, **config):
        bus = ServoBus(BusConfig(robot.port, **{"max_silence_s": 1.0, "silence_s": 1.0, **config}))
        buses.append(bus)
        bus.open()
        bus.handshake(dict.fromkeys(ids))
        if mode is not None:
            bus.setup(mode)
            bus.torque(True)
        return bus

    yield open_
    for bus in buses:
        bus.close()
