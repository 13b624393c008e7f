"""Emulated servos in a thread, in real time, and in virtual time."""

import os
import threading
import time
from dataclasses import replace

from virtual_bus import PLANTS as PLANTS
from virtual_bus import VirtualBus

from sim2real.hardware.emulation import emulator
from sim2real.hardware.emulation.emulated_bus import truth_header
from sim2real.hardware.emulation.truth import TruthLog, read_truth
from sim2real.hardware.feetech.emulation import StsBus

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


class Bench(VirtualBus):
    """STS servos on it."""

    def __init__(self, *arguments, **plant_args):
        super().__init__(StsBus, *arguments, **plant_args)

    def ask(self, packet, wait_ns=20_000_000):
        """Send a packet and return what is answered until a while later, in one piece."""
        self.send(self.now_ns, packet)
        self.run_until(self.now_ns + wait_ns)
        answers, self.sent = b"".join(answer for _, answer in self.sent), []
        return answers
