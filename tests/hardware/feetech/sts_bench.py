"""Emulated servos in a thread, in real time, and in virtual time."""

import os
import threading
import time
from dataclasses import replace
from pathlib import Path

from sim2real.hardware.emulation import emulator
from sim2real.hardware.emulation.emulated_bus import truth_header
from sim2real.hardware.emulation.truth import TruthLog, read_truth
from sim2real.hardware.feetech.emulation import StsBus
from sim2real.hardware.plant import load_plant

PLANTS = Path(__file__).parents[1] / "plants.py"
IDS = (1, 2, 3)


class Served:
    """An emulator in a thread: it costs no start of a process, and its faults can begin at any time.

    Attributes:
        is_set: Whether a signal told it to stop: never, it stops at the end of a pipe.
        faulty_ns: When a signal told it to be faulty: never, either.
    """

    is_set = False
    faulty_ns = None

    def __init__(self, path, plant, config):
        self._path = path
        start_ns = time.monotonic_ns()
        self._pty = emulator._Pty()
        self.port = self._pty.port
        self._log = TruthLog(path, truth_header(plant, config, start_ns))
        self.bus = StsBus(plant, config, self._log, self._pty.send, start_ns)
        self._end, self._ending = os.pipe()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        emulator._serve(self.bus, self._pty, self._log, self, self._end)

    def strike(self, **faults):
        """Let faults begin, or end."""
        self.bus._config = self.bus.config = replace(self.bus.config, **faults)

    def stop(self):
        if self._thread.is_alive():
            os.close(self._ending)
            self._thread.join()
            self._log.close()
            os.close(self._end)
            os.close(self._pty.fd)
            os.close(self._pty._host_fd)

    def truth(self):
        self.stop()
        return read_truth(self._path)


class Bench:
    """An emulated bus in virtual time: no process, no waiting, every instant exact."""

    def __init__(self, path, plant, config, **plant_args):
        self.plant = load_plant(f"{PLANTS}:{plant}", plant_args)
        self.now_ns = 0
        self.sent = []
        self._path = path
        self._log = TruthLog(path, truth_header(self.plant, config, 0))
        self.bus = StsBus(self.plant, config, self._log, self._take, 0, lambda: self.now_ns)
        self.servos = self.bus.servos

    def _take(self, answer):
        self.sent.append((self.now_ns, answer))
        return True

    def run_until(self, t_ns):
        while (due_ns := self.bus.next_due_ns()) is not None and due_ns <= t_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.bus.run_until(self.now_ns)
        self.now_ns = t_ns
        self.bus.run_until(t_ns)

    def send(self, t_ns, *packets):
        self.run_until(t_ns)
        self.bus.feed(b"".join(packets), t_ns)
        self.bus.run_until(t_ns)

    def ask(self, packet, wait_ns=20_000_000):
        """Send a packet and return what is answered until a while later, in one piece."""
        self.send(self.now_ns, packet)
        self.run_until(self.now_ns + wait_ns)
        answers, self.sent = b"".join(answer for _, answer in self.sent), []
        return answers

    def close(self):
        self._log.close()

    def truth(self):
        self.close()
        return read_truth(self._path)
