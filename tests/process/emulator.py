"""An emulated robot in a process of its own and in real time: servos behind a pseudo-terminal, legs behind DDS.

    python tests/process/emulator.py '{"emulation": "sim2real.emulation.dynamixel:EmulatorConfig",
        "settings": {"sensing_latency_s": 0.004}, "plant": "my_robot/plant.py:Plant", "truth": "truth.bin"}'

prints one line of JSON with the port when it is ready, and runs until SIGTERM.
"""

import ctypes
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import time
import tty
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from sim2real.emulation.bus import BusEmulation
from sim2real.emulation.robot import truth_header
from sim2real.emulation.truth import TruthLog, read_truth


class EmulatedProcess:
    """An emulated robot on `port`, from construction until `stop`, which also outlives its host."""

    def __init__(self, plant, config, plant_args, truth_path):
        self._truth_path = truth_path
        task = {"emulation": f"{type(config).__module__}:{type(config).__qualname__}", "settings": asdict(config)}
        task |= {"plant": plant, "plant_args": plant_args, "truth": str(truth_path)}
        command = [sys.executable, "-P", __file__, json.dumps(task)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.port = json.loads(self._process.stdout.readline())["port"]

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.stop()

    def stop(self):
        """End the process, after which its truth is complete. May be called twice."""
        self._process.terminate()
        self._process.communicate(timeout=60)

    def truth(self):
        """Read the truth; while the robot runs, the last 0.1 s may be missing."""
        return read_truth(self._truth_path)


class Pty:
    """A raw pseudo-terminal: the host opens `port`, the emulator has the other end.

    The host's end is kept open here too, so that hosts may open and close it.
    """

    idle_ns = 2_000_000  # without stepping the plant: catching up with more would delay answers

    def __init__(self):
        self.fd, self._host_fd = os.openpty()
        tty.setraw(self._host_fd)
        os.set_blocking(self.fd, False)
        self.port, self.inputs = os.ttyname(self._host_fd), [self.fd]

    def exchange(self, robot, now_ns):
        with suppress(BlockingIOError):
            robot.feed(os.read(self.fd, 4096), now_ns)

    def send(self, answer):
        try:
            return os.write(self.fd, answer) == len(answer)
        except BlockingIOError:
            return False


class Dds:
    """The topics of a robot's low-level interface, on this machine alone."""

    idle_ns, inputs = 1_000_000, ()

    def __init__(self):
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        from sim2real.hardware.unitree.dds import Address
        from sim2real.hardware.unitree.messages import COMMAND_TOPIC, STATE_TOPIC, LowCmd, LowState

        self._lock, domain = free_domain()
        address = Address("lo", domain)
        self.port, self._network = str(address), Domain(domain, address.config)
        participant = DomainParticipant(domain)
        self._reader = DataReader(participant, Topic(participant, COMMAND_TOPIC, LowCmd))
        self.send = DataWriter(participant, Topic(participant, STATE_TOPIC, LowState)).write

    def exchange(self, robot, now_ns):
        """Pass the host's commands on; they count from the time at which they were written."""
        for message in self._reader.take(16):
            if hasattr(message, "record") and not robot.is_silent(now_ns):
                age_ns = time.time_ns() - message.sample_info.source_timestamp
                robot.receive(message, now_ns - max(0, age_ns))


def free_domain():
    """Return a domain that no program of this machine uses, not even an earlier robot's guardian, and its socket.

    A domain belongs to the process that has the UDP port 29000 plus the domain's number. Every program in a domain
    hears on the port 7400 plus 250 for each domain (DDSI-RTPS, section 9.6). A real robot has domain 0.
    """
    for domain in range(50, 230):
        lock, heard = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        try:
            lock.bind(("127.0.0.1", 29_000 + domain))
            heard.bind(("", 7400 + 250 * domain))
        except OSError:
            lock.close()
            continue
        finally:
            heard.close()
        return lock, domain
    raise RuntimeError("all DDS domains of this machine have an emulator")


def keep_time():
    """Reduce the lateness of this process as far as the operating system allows."""
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(29, 1_000, 0, 0, 0)  # PR_SET_TIMERSLACK: sleeps end within 1 us instead of 50 us
    with suppress(AttributeError, OSError):  # above the threads of the controlling process: a servo does not wait
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
    gc.collect()
    gc.disable()


class LiveTruth(TruthLog):
    """A truth whose times are those of CLOCK_MONOTONIC, which all processes of a machine share."""

    def write(self, kind, servo_id, t_host_ns, t_ns, t_done_ns, late_ns, values=()):
        t_host_ns = t_host_ns and t_host_ns + self.start_ns  # 0: a command of the servo itself
        super().write(kind, servo_id, t_host_ns, t_ns + self.start_ns, t_done_ns + self.start_ns, late_ns, values)


def load(spec):
    """Return what ``package.module:Name`` or ``path/to/file.py:Name`` names."""
    place, _, name = spec.rpartition(":")
    return runpy.run_path(place)[name] if place.endswith(".py") else getattr(importlib.import_module(place), name)


def main(task):
    ends = []
    signal.signal(signal.SIGTERM, lambda *_: ends.append(True))
    config, plant = load(task["emulation"])(**task["settings"]), load(task["plant"])(**task["plant_args"])
    connection = Pty() if isinstance(config, BusEmulation) else Dds()
    keep_time()
    start_ns = time.monotonic_ns()
    now = lambda: time.monotonic_ns() - start_ns  # noqa: E731 - the robot's time
    truth = LiveTruth(Path(task["truth"]), truth_header(plant, config))
    truth.start_ns = start_ns
    robot = config.planned(plant, truth, connection.send)
    print(json.dumps({"port": connection.port}), flush=True)
    flushed_ns = 0
    while not ends:
        # Sleep until the host has sent something, or the next event is due.
        now_ns = now()
        due_ns = robot.next_due_ns() or now_ns + connection.idle_ns
        wait_ns = min(connection.idle_ns, max(0, due_ns - now_ns))
        select.select(connection.inputs, [], [], 1e-9 * wait_ns)
        # Pass on what was sent, then compute all events up to now.
        now_ns = now()
        connection.exchange(robot, now_ns)
        robot.run_until(now_ns)
        if now_ns > flushed_ns + 100_000_000:
            flushed_ns = now_ns
            truth.flush()
    truth.close()


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
