from functools import cached_property

import plants

from sim2real.emulation.bus import VirtualRobot
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.robot import truth_header
from sim2real.emulation.truth import TruthLog, read_truth
from sim2real.hardware.device import Device


class VirtualBus:
    """An emulated bus in virtual time: no process, no waiting, every instant exact."""

    def __init__(self, path, plant, config, **plant_args):
        self.plant = getattr(plants, plant)(**plant_args)
        self.now_ns = 0
        self.sent = []
        self._path = path
        self._log = TruthLog(path, truth_header(self.plant, config))
        self.bus = config.planned(self.plant, self._log, self._take)
        self.servos = self.bus.servos

    def _take(self, answer):
        self.sent.append((self.now_ns, answer))
        return True

    def run_until(self, t_ns):
        """Go on to a time, stopping at everything that is due on the way."""
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


class IdleDevice(Device):
    """A device without hardware, in virtual time: opening, torque and checks do nothing."""

    @cached_property
    def clock(self):
        return VirtualRobot(plants.Ramp(), EmulatorConfig())

    def open(self): ...
    def close(self): ...
    def enable(self): ...
    def disable(self): ...
    def check(self): ...
    def make_safe(self): ...
